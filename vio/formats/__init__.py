"""Readers of recordings on disk: one module per format, listed in `READERS`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from vio.errors import RecordingError
from vio.formats import (
    asl,
    c3vd,
    endoslam,
    image_folder,
    jhu_sinus,
    kitti_odometry,
    scared,
    simcol3d,
    tum_rgbd,
    video,
    vrcaps,
)
from vio.formats.declared import Declared
from vio.recording import Recording


class Reader(NamedTuple):
    """How one format of recordings is told from the others and read."""

    layout: str
    """What is looked for, in words."""
    matches: Callable[[str | Path], bool]
    read: Callable[[str | Path, Declared], Recording]
    accepts: frozenset[str]
    """Fields of `Declared` that the reader can use."""


READERS: dict[str, Reader] = {
    "asl": Reader(asl.LAYOUT, asl.matches, lambda path, declared: asl.read_asl(path), frozenset()),
    "endoslam": Reader(endoslam.LAYOUT, endoslam.matches, endoslam.read_endoslam, endoslam.ACCEPTS),
    "vrcaps": Reader(vrcaps.LAYOUT, vrcaps.matches, vrcaps.read_vrcaps, vrcaps.ACCEPTS),
    "simcol3d": Reader(simcol3d.LAYOUT, simcol3d.matches, simcol3d.read_simcol3d, simcol3d.ACCEPTS),
    "scared": Reader(scared.LAYOUT, scared.matches, scared.read_scared, scared.ACCEPTS),
    "tum-rgbd": Reader(tum_rgbd.LAYOUT, tum_rgbd.matches, tum_rgbd.read_tum_rgbd, tum_rgbd.ACCEPTS),
    "jhu-sinus": Reader(jhu_sinus.LAYOUT, jhu_sinus.matches, jhu_sinus.read_jhu_sinus, jhu_sinus.ACCEPTS),
    "kitti": Reader(kitti_odometry.LAYOUT, kitti_odometry.matches, kitti_odometry.read_kitti_odometry,
                    kitti_odometry.ACCEPTS),
    "c3vd": Reader(c3vd.LAYOUT, c3vd.matches, c3vd.read_c3vd, c3vd.ACCEPTS),
    "video": Reader(video.LAYOUT, video.matches, video.read_video, video.ACCEPTS),
    "images": Reader(image_folder.LAYOUT, image_folder.matches, image_folder.read_image_folder, image_folder.ACCEPTS),
}
"""In the order in which they are tried."""


def open_recording(path: str | Path, format: str | None = None, declared: Declared | None = None) -> Recording:
    """Open a recording in whatever known format it is in (`docs/formats.md`).

    Args:
        path: its folder, or a film.
        format: a key of `READERS`; None recognises the format by what lies in the folder.
        declared: what the files do not say and the user knows.

    Raises:
        RecordingError: no such folder, an unknown format, a folder that no reader recognises, or something declared
            that the format does not take.
        VioError: whatever the reader of that format raises.
    """
    path, declared = Path(path), declared or Declared()
    if not path.exists():
        raise RecordingError(f"{path.name}: no such folder; give the folder of a recording")
    if path.is_file() and not video.matches(path):
        raise RecordingError(f"{path.name}: a file, not a folder; give the folder of a recording, or a film")
    if format is not None and format not in READERS:
        raise RecordingError(f"format {format!r} is unknown; known are {', '.join(READERS)}")
    name = format or next((name for name, reader in READERS.items() if reader.matches(path)), None)
    if name is None:
        known = "; ".join(f"{name} = {reader.layout}" for name, reader in READERS.items())
        raise RecordingError(f"{path.name}: not a recording in a known format; looked for {known}")
    declared.check_accepted(name, READERS[name].accepts)
    recording = READERS[name].read(path, declared)
    return recording if recording.name.strip(".") else replace(recording, name="recording")
