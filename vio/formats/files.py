"""Files of a data set: numbered images, names that must stay inside a folder, times from a declared rate."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio.errors import FormatError, RecordingError
from vio.formats.declared import OPTIONS

NS_PER_S = 1_000_000_000


def numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Files of a folder whose whole name matches `pattern`, by the number in its first group, in order.

    Raises:
        FormatError: two files have one number.
    """
    found: dict[int, Path] = {}
    for file in sorted(entries(folder)):
        match = re.fullmatch(pattern, file.name)
        if match is None:
            continue
        number = int(match.group(1))
        if number in found:
            raise FormatError(f"{folder.name}: {found[number].name} and {file.name} are both number {number}; "
                              "keep one of them")
        found[number] = file
    return dict(sorted(found.items()))


def has_numbered(folder: Path, pattern: str) -> bool:
    """Whether one file at least matches; stops at the first."""
    return any(re.fullmatch(pattern, file.name) for file in entries(folder))


def entries(folder: Path) -> Iterator[Path]:
    """What lies in a folder; nothing where there is none.

    Raises:
        RecordingError: the folder cannot be listed.
    """
    try:
        yield from folder.iterdir() if folder.is_dir() else ()
    except OSError as error:
        raise RecordingError(f"{folder.name}: cannot be listed ({error.strerror}); allow reading it") from None


def inside(folder: Path, name: str, where: str) -> Path:
    """The file `name` below `folder`.

    Raises:
        FormatError: the name is absolute, climbs out of the folder, or leads out of it by a link; `where` is its row.
    """
    path = PurePosixPath(name)
    if not name or path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name or "\0" in name:
        raise FormatError(f"{where}: {name!r} is not a file name below the recording's folder; use plain names")
    file = folder / path
    if not file.resolve().is_relative_to(folder.resolve()):
        raise FormatError(f"{where}: {name!r} leads out of the recording's folder; copy the file into it")
    return file


def stamps_at_rate(numbers: ArrayLike, rate_hz: float | None, format: str) -> NDArray[np.int64]:
    """Frame times (N,) of numbered frames at a constant rate, the first at 0 ns; a missing number leaves a gap.

    Raises:
        RecordingError: no rate was declared.
    """
    if rate_hz is None:
        raise RecordingError(f"format {format}: nothing in these files says when a frame was taken; declare a constant "
                             f"rate with {OPTIONS['rate_hz']}, or list the times in frames.csv (docs/formats.md)")
    k = np.asarray(numbers, np.int64)
    return np.asarray(np.round((k - k[0]) * (NS_PER_S / rate_hz)), np.int64)
