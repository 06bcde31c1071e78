"""The simulated data set on disk: which sequences there are, whether they are whole, and a recording of each."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from learned.errors import BenchmarkError
from vio.formats import open_recording
from vio.formats.asl import MARKER
from vio.recording import Recording
from vio.simulation.dataset import MANIFEST, recording_digest

SCHEMA = 1
REMEDY = "write it with `capsule-vio simulate --dataset mm-wce --out DATA`"
PARTS = ("train", "test")


@dataclass(frozen=True)
class Entry:
    """One sequence as the manifest tells of it."""

    path: str
    """Below DATA, such as `mm-wce-1/train/00`."""
    level: int
    """Of vibration."""
    sha256: str
    """Of the recording's files."""

    def belongs(self, data: str, part: str) -> bool:
        """Whether the sequence is of a data set, such as `mm-wce-1`, and of its part."""
        return self.path.startswith(f"{data}/{part}/")


@dataclass(frozen=True)
class DataSet:
    """All sequences of DATA."""

    folder: Path
    entries: tuple[Entry, ...]
    simulator_version: Any

    def select(self, sets: Sequence[str], part: str, level: int | None = None, most: int | None = None
               ) -> tuple[Entry, ...]:
        """Sequences of some data sets, in order.

        Args:
            sets: such as `mm-wce-1`.
            part: "train" or "test".
            level: of vibration; None = all.
            most: how many of each set, the first ones; None = all.

        Raises:
            BenchmarkError: a set has none.
        """
        chosen: list[Entry] = []
        for data in sets:
            found = [e for e in self.entries if e.belongs(data, part) and level in (None, e.level)]
            if not found:
                which = "" if level is None else f" of vibration level {level}"
                raise BenchmarkError(f"data set {self.folder.name}: no sequence{which} in {data}/{part}; {REMEDY}")
            chosen += found[:most]
        return tuple(chosen)

    def check(self, entries: Sequence[Entry], progress: Callable[[int, int], None] | None = None) -> None:
        """Look whether sequences lie on disk as the manifest says, byte for byte.

        Raises:
            BenchmarkError: one is missing or changed.
        """
        for k, entry in enumerate(entries):
            folder = self.folder / entry.path
            if not (folder / MARKER).is_file():
                raise BenchmarkError(f"data set {self.folder.name}: {entry.path} is missing; {REMEDY}, which adds what "
                                     "is not there")
            if recording_digest(folder) != entry.sha256:
                raise BenchmarkError(f"data set {self.folder.name}: {entry.path} is not what {MANIFEST} says "
                                     f"(SHA-256 {entry.sha256[:12]}…); delete that sequence and {REMEDY}")
            if progress is not None:
                progress(k + 1, len(entries))

    def recording(self, entry: Entry, frames: int | None) -> Recording:
        """A sequence, or its first frames.

        Raises:
            RecordingError: it cannot be read.
        """
        return first_frames(replace(open_recording(self.folder / entry.path), name=entry.path), frames)


def first_frames(recording: Recording, frames: int | None) -> Recording:
    """The same recording up to some frame; the inertial samples and the truth stay whole."""
    if frames is None:
        return recording
    return replace(recording, frame_t_ns=recording.frame_t_ns[:frames], frame_paths=recording.frame_paths[:frames],
                   depth_paths=recording.depth_paths[:frames])


def read_data_set(folder: str | Path) -> DataSet:
    """The data set that `capsule-vio simulate --dataset` wrote; its manifest is written last, when all is there.

    Raises:
        BenchmarkError: no such folder, or a manifest that is missing, damaged or of another schema.
    """
    folder = Path(folder)
    path = folder / MANIFEST
    if not path.is_file():
        what = f"has no {MANIFEST}, so it is not complete" if folder.is_dir() else "does not exist"
        raise BenchmarkError(f"data set {folder.name} {what}; {REMEDY}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["schema"] != SCHEMA:
            raise BenchmarkError(f"data set {folder.name}: {MANIFEST} has schema {content['schema']}, this version "
                                 f"reads {SCHEMA}; {REMEDY}")
        entries = tuple(Entry(str(s["path"]), int(s["level"]), str(s["sha256"])) for s in content["sequences"])
    except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, ValueError):
        raise BenchmarkError(f"data set {folder.name}: {MANIFEST} is damaged or none of ours; {REMEDY}") from None
    return DataSet(folder, entries, content.get("simulator_version"))
