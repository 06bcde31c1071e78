"""Sinus sequences of Johns Hopkins (Liu et al. 2020): in vivo frames with poses from structure from motion.

    SEQ/%08d.jpg (undistorted), camera_intrinsics_per_view (fx, fy, cx, cy), motion.yaml, visible_view_indexes

Clock: none; declare a rate. Frames are numbered as in the film, so a missing number leaves a gap.

Poses: `motion.yaml`, position x, y, z and quaternion x, y, z, w, one per line of `visible_view_indexes`, which names
its frame; CAMERA TO WORLD (measured: tracked points miss their epipolar lines by 1 pixel in the median, by 8 pixels
if the poses are read the other way round, as the published description suggests), right-handed, camera x right, y
down, z forward, scale ARBITRARY. They become truth only when the metres per unit are declared. Camera: the file's
pinhole, no distortion left. No IMU, no depth. `undistorted_mask.jpg` is no frame.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.calibration import Calibration, load_yaml, short_name
from vio.camera import Camera
from vio.errors import CameraError, FormatError, RecordingError
from vio.formats.camera_truth import body_truth
from vio.formats.declared import OPTIONS, Declared
from vio.formats.files import numbered, stamps_at_rate
from vio.formats.table import QUATERNION_TOLERANCE, parse_floats, read_table
from vio.image_files import size_of
from vio.imu import ImuSamples
from vio.recording import Recording

Array = NDArray[np.float64]

LAYOUT = "JHU sinus: 00000000.jpg with motion.yaml and visible_view_indexes"
ACCEPTS = frozenset({"calibration", "rate_hz", "unit_m"})
FRAME = r"(\d{8})\.jpg"
MOTION, VIEWS, INTRINSICS = "motion.yaml", "visible_view_indexes", "camera_intrinsics_per_view"


class SfmPoses(NamedTuple):
    """Poses of a reconstruction, in its own unit."""

    numbers: NDArray[np.int64]
    """(N,) frame numbers."""
    T_world_camera: Array
    """(N, 4, 4), translation in reconstruction units."""


def matches(path: str | Path) -> bool:
    """Whether `path` holds the reconstruction's files."""
    return (Path(path) / MOTION).is_file() and (Path(path) / VIEWS).is_file()


def read_jhu_sinus(path: str | Path, declared: Declared | None = None) -> Recording:
    """Read one sequence.

    Raises:
        RecordingError: no frames, or no declared rate.
        FormatError, CalibrationError: unusable intrinsics, views or poses.
    """
    declared, root = declared or Declared(), Path(path)
    frames = numbered(root, FRAME)
    if not frames:
        raise RecordingError(f"{root.name}: no 00000000.jpg; give the folder of one sequence")
    first = next(iter(frames))
    t_ns = stamps_at_rate(list(frames), declared.rate_hz, "jhu-sinus")
    calibration = declared.calibration or Calibration(_camera(root / INTRINSICS, frames[first]))
    truth = None
    if declared.unit_m is not None:
        poses = read_jhu_poses(root)
        T_world_camera = poses.T_world_camera.copy()
        T_world_camera[:, :3, 3] *= declared.unit_m
        pose_t_ns = np.round((poses.numbers - first) * (1e9 / (declared.rate_hz or 1.0))).astype(np.int64)
        truth = body_truth(T_world_camera, pose_t_ns, 0, calibration)
    return Recording(
        root.name, t_ns, ImuSamples.none(), calibration, truth=truth, frame_paths=tuple(frames.values()),
        provenance={"format": "jhu-sinus", "clock": "constant rate, declared", "truth": "reconstruction, unit declared"
                    if truth else f"none: the reconstruction's scale is arbitrary; declare {OPTIONS['unit_m']}"},
    )


def read_jhu_poses(root: Path) -> SfmPoses:
    """The reconstruction's poses, scale arbitrary.

    Raises:
        FormatError, CalibrationError: files that are missing, malformed or of different lengths.
    """
    table = read_table(root / VIEWS)
    listed = parse_floats(table, range(1), None, FormatError)[:, 0]
    wrong = (listed != np.round(listed)) | (listed < 0) | (listed > 99_999_999) | (np.diff(listed, prepend=-1) <= 0)
    if wrong.any():
        raise FormatError(f"{table.at(int(np.argmax(wrong)))}: view numbers must be whole, of 8 digits at most, and "
                          "increase; restore the file")
    numbers = listed.astype(np.int64)
    name = short_name(root / MOTION)
    poses = load_yaml(root / MOTION).get("poses[]")
    if not isinstance(poses, dict) or len(poses) != len(numbers):
        count = len(poses) if isinstance(poses, dict) else 0
        raise FormatError(f"{name}: {count} poses for {len(numbers)} views in {VIEWS}; restore the file")
    values = np.array([_pose(poses.get(f"poses[{k}]"), f"{name} poses[{k}]") for k in range(len(numbers))])
    return SfmPoses(numbers, se3.transform(se3.matrix_from_quat_xyzw(values[:, 3:]), values[:, :3]))


def _pose(entry: Any, where: str) -> list[float]:
    """Position x, y, z and quaternion x, y, z, w."""
    try:
        values = [float(entry["position"][axis]) for axis in "xyz"]
        values += [float(entry["orientation"][axis]) for axis in "xyzw"]
    except (KeyError, TypeError, ValueError):
        raise FormatError(f"{where}: expected position x, y, z and orientation x, y, z, w") from None
    if not np.isfinite(values).all():
        raise FormatError(f"{where}: a value is not finite; drop the pose and its view")
    length = float(np.linalg.norm(values[3:]))
    if abs(length - 1) > QUATERNION_TOLERANCE:
        raise FormatError(f"{where}: quaternion of length {length:.6g} (limit 1 ± {QUATERNION_TOLERANCE:g}); check the "
                          "order of its parts")
    return values


def _camera(file: Path, image: Path) -> Camera:
    table = read_table(file)
    values = parse_floats(table, range(1), None, FormatError)[:, 0]
    if len(values) != 4:
        raise FormatError(f"{table.name}: {len(values)} rows, expected fx, fy, cx, cy of one camera")
    width, height = size_of(image, "first frame")
    try:
        return Camera("pinhole", width, height, *values.tolist())
    except CameraError as error:
        raise FormatError(f"{table.name}: {error}") from None
