"""A prediction that was stopped: what is measured already lies in a folder and is taken up by the next run.

    DIR/prediction.json   what is predicted, from what, with what; another question empties the folder
    DIR/00000.npz …       measured pairs, a part at a time
    DIR/data/, DIR/sd/    depth maps of those parts, in folders named as in a folder of depth maps
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vio.atomic import atomic_write
from vio.errors import OutputError
from vio.motions import UNREADABLE
from vio.recording import Recording

Array = NDArray[np.float64]

QUESTION = "prediction.json"


@dataclass(frozen=True)
class MeasuredPairs:
    """Motions of some pairs, in numpy; fields as in `learned.PairPrediction`."""

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    T_i_j: Array
    cov: Array
    snr: Array | None


@dataclass(frozen=True)
class Part:
    """One stretch of a prediction."""

    pairs_passed: int
    """Pairs of `pairs_of` that it covers, readable or not."""
    measured: list[MeasuredPairs]
    unreadable: dict[int, str]
    """Reason by frame."""
    maps: list[str]
    """Names of the depth maps written in it."""


class Unfinished:
    """The folder of one prediction.

    Args:
        folder: made when the first part is kept.
        question: all that decides the result, in values that JSON can hold.

    Raises:
        OutputError: `folder` exists and is not ours.
    """

    def __init__(self, folder: str | Path, question: Mapping[str, Any]) -> None:
        self.folder, self._question = Path(folder), json.dumps(question, sort_keys=True, indent=1)
        if self.folder.exists() and not (self.folder / QUESTION).is_file() and any(self.folder.iterdir()):
            raise OutputError(f"{self.folder.name} exists and was not written by capsule-vio (no {QUESTION}); move it")
        self._count = 0

    def taken_up(self) -> list[Part]:
        """Parts that an earlier run kept for the same question, up to the first damaged one."""
        marker = self.folder / QUESTION
        if not marker.is_file() or marker.read_text(encoding="utf-8") != self._question:
            shutil.rmtree(self.folder, ignore_errors=True)
            return []
        parts: list[Part] = []
        while (path := self._path(len(parts))).is_file():
            try:
                parts.append(_read(path))
            except (KeyError, *UNREADABLE):
                break
        self._count = len(parts)
        return parts

    def keep(self, part: Part, maps_at: Sequence[Path]) -> None:
        """Write one more part, and keep its depth maps, which lie in the folders `maps_at`.

        Raises:
            OutputError: the disk is full, or the folder cannot be written.
        """
        if self._count == 0:
            with atomic_write(self.folder / QUESTION) as file:
                file.write(self._question.encode())
        for folder in maps_at:
            _link_all(part.maps, folder, self.folder / folder.name)
        arrays: dict[str, Any] = {"about": np.array(json.dumps({
            "pairs_passed": part.pairs_passed, "batches": len(part.measured), "maps": part.maps,
            "unreadable": {str(k): reason for k, reason in part.unreadable.items()}}))}
        for n, batch in enumerate(part.measured):
            arrays |= {f"{name}_{n}": value for name, value in vars(batch).items() if value is not None}
        with atomic_write(self._path(self._count)) as file:
            np.savez(file, **arrays)
        self._count += 1

    def restore_maps(self, parts: Sequence[Part], maps_at: Sequence[Path]) -> None:
        """Put the depth maps of kept parts where the finished folders are being filled."""
        for part in parts:
            for folder in maps_at:
                _link_all(part.maps, self.folder / folder.name, folder)

    def discard(self) -> None:
        """Remove the folder: the prediction is finished."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, n: int) -> Path:
        return self.folder / f"{n:05d}.npz"


def images_digest(recording: Recording) -> str:
    """Changes when frames come, go, move in time or change their size on disk; images are not read."""
    total = hashlib.sha256(recording.frame_t_ns.tobytes())
    for path in recording.frame_paths:
        size = path.stat().st_size if path is not None and path.is_file() else -1
        total.update(f"{path.name if path is not None else ''}:{size}\n".encode())
    return total.hexdigest()


def _read(path: Path) -> Part:
    with path.open("rb") as file:
        arrays = dict(np.load(file, allow_pickle=False))
    about = json.loads(str(arrays["about"]))
    measured = [MeasuredPairs(arrays[f"i_{n}"], arrays[f"j_{n}"], arrays[f"T_i_j_{n}"], arrays[f"cov_{n}"],
                              arrays.get(f"snr_{n}")) for n in range(about["batches"])]
    return Part(about["pairs_passed"], measured, {int(k): reason for k, reason in about["unreadable"].items()},
                about["maps"])


def _link_all(names: Sequence[str], source: Path, target: Path) -> None:
    """Second names for files, or copies where the disk knows no second names."""
    try:
        target.mkdir(parents=True, exist_ok=True)
        for name in names:
            (target / name).unlink(missing_ok=True)
            try:
                os.link(source / name, target / name)
            except OSError:
                shutil.copyfile(source / name, target / name)
    except OSError as error:
        raise OutputError(f"{target.name}: depth maps cannot be kept ({error.strerror or error}); free some space, or "
                          "choose another place") from None
