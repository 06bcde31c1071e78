"""EndoSLAM, the UnityCam part (Ozyoruk et al. 2021): rendered capsule images with device depth.

    SEQ/Frames/image_%04d.png (or .jpg)           `frames`, `Frames_jpg` are accepted too
    SEQ/Pixelwise Depths/aov_image_%04d.png       or `depth`; 8-bit grey with alpha, INVERSE depth, near is bright
    SEQ/Poses/*position_rotation.csv              or in SEQ; `vio.formats.unity`

Clock: row i of the pose file belongs to frame i, so its `time(s)` is the frame's time; without the file declare a
rate.

Depth: inverse depth up to an unknown factor (the clip planes of these recordings are not published): `depth_m`
refuses, `relative_inverse_depth` gives it. Declare depth planes and unit to get metres.

Poses are read by `vio.formats.unity.read_unity_poses` and are NOT taken as truth: they belong to the capsule's body,
not to its steered camera (measured on the stomach sequence: constant rotation while the view turns), in Unity units.

Camera: unknown unless declared. The intrinsics in circulation (principal point 178.6, 181.8 in 320 x 320 pixels)
contradict the renderer, which has no lens shift; a centred camera with f about 140 px is inferred, not known.

The real-camera parts have frames named `frameId_*_time_*`: refused, because the unit of that time and the frame of
their poses are not documented.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio.errors import RecordingError
from vio.formats.declared import OPTIONS, Declared
from vio.formats.files import entries, has_numbered, numbered, stamps_at_rate
from vio.formats.unity import read_unity_poses, unity_depth
from vio.imu import ImuSamples
from vio.recording import Recording

LAYOUT = "EndoSLAM UnityCam: Frames/image_0000.png beside Pixelwise Depths or Poses"
ACCEPTS = frozenset({"calibration", "rate_hz", "unit_m", "depth_planes"})
FRAME_FOLDERS = ("frames", "frames_jpg")
DEPTH_FOLDERS = ("pixelwise depths", "depth")
FRAME = r"image_(\d{1,9})\.(?:png|jpg)"
DEPTH = r"aov_image_(\d{1,9})\.png"
REAL_FRAME = r"frameId_(\d{1,9})_time_\d+\.\w+"
POSES = "*position_rotation.csv"


def matches(path: str | Path) -> bool:
    """Whether `path` has a folder of frames in this naming."""
    frames = _subfolder(Path(path), FRAME_FOLDERS)
    return frames is not None and (has_numbered(frames, FRAME) or has_numbered(frames, REAL_FRAME))


def read_endoslam(path: str | Path, declared: Declared | None = None) -> Recording:
    """Read one UnityCam trajectory.

    Raises:
        RecordingError: no frames, frames of a real camera, several pose files, or frames without a time.
        FormatError: an unusable row of the pose file.
    """
    declared, root = declared or Declared(), Path(path)
    folder = _subfolder(root, FRAME_FOLDERS)
    frames = {} if folder is None else numbered(folder, FRAME)
    if not frames:
        if folder is not None and has_numbered(folder, REAL_FRAME):
            raise RecordingError(f"{root.name}: frames of a real camera; the unit of the time in `frameId_*_time_*` is "
                                 "not documented: list the times you know in frames.csv (docs/formats.md)")
        raise RecordingError(f"{root.name}: no Frames/image_0000.png; give the folder of one trajectory")
    numbers = np.array(list(frames))
    depth_folder = _subfolder(root, DEPTH_FOLDERS)
    depths = {} if depth_folder is None else numbered(depth_folder, DEPTH)
    return Recording(
        root.name, _frame_times(root, numbers, declared), ImuSamples.none(), declared.calibration_or(None),
        frame_paths=tuple(frames.values()), depth_paths=tuple(depths.get(k) for k in frames),
        depth_encoding=unity_depth(declared),
        provenance={"format": "endoslam", "truth": "none: the poses belong to the capsule's body, not to its camera"},
    )


def _frame_times(root: Path, numbers: NDArray[np.int64], declared: Declared) -> NDArray[np.int64]:
    if declared.rate_hz is not None:
        return stamps_at_rate(numbers, declared.rate_hz, "endoslam")
    files = [file for folder in (root, _subfolder(root, ("poses",))) if folder for file in sorted(folder.glob(POSES))]
    if not files:
        return stamps_at_rate(numbers, None, "endoslam")
    if len(files) > 1:
        raise RecordingError(f"{root.name}: {len(files)} pose files ({', '.join(file.name for file in files[:3])}); "
                             "keep the one of these frames")
    t_ns = read_unity_poses(files[0]).t_ns
    if numbers[-1] >= len(t_ns):
        raise RecordingError(f"{root.name}: frame {numbers[numbers >= len(t_ns)][0]} has no row in {files[0].name} "
                             f"({len(t_ns)} rows); take the frames after it away, or declare {OPTIONS['rate_hz']}")
    return np.asarray(t_ns[numbers])


def _subfolder(root: Path, names: tuple[str, ...]) -> Path | None:
    """The first folder in `root` with one of the names, whatever the case of its letters."""
    there = {folder.name.lower(): folder for folder in sorted(entries(root)) if folder.is_dir()}
    return next((there[name] for name in names if name in there), None)
