"""Readers of recordings on disk: one module per format, listed in `READERS`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from vio.errors import RecordingError
from vio.formats import asl
from vio.recording import Recording


class Reader(NamedTuple):
    """How one format of recordings is told from the others and read."""

    layout: str
    """What is looked for, in words."""
    matches: Callable[[str | Path], bool]
    read: Callable[[str | Path], Recording]


READERS: dict[str, Reader] = {
    "asl": Reader(asl.LAYOUT, asl.matches, asl.read_asl),
}


def open_recording(path: str | Path, format: str | None = None) -> Recording:
    """Open a recording in whatever known format it is in.

    Args:
        path: its folder.
        format: a key of `READERS`; None recognises the format by what lies in the folder.

    Raises:
        RecordingError: no such folder, an unknown format, or a folder that no reader recognises.
        VioError: whatever the reader of that format raises.
    """
    path = Path(path)
    if not path.is_dir():
        raise RecordingError(f"{path.name}: {'a file, not a folder' if path.exists() else 'no such folder'}; "
                             "give the folder of a recording")
    if format is not None:
        if format not in READERS:
            raise RecordingError(f"format {format!r} is unknown; known are {', '.join(READERS)}")
        return READERS[format].read(path)
    for reader in READERS.values():
        if reader.matches(path):
            return reader.read(path)
    known = "; ".join(f"{name} = {reader.layout}" for name, reader in READERS.items())
    raise RecordingError(f"{path.name}: not a recording in a known format; looked for {known}")
