"""C3VD, versions 1 and 2 (Bobrow et al. 2023, Golhar et al. 2025): a colonoscope in a phantom, registered to its model.

    v1   SEQ/NNNN_color.png, NNNN_depth.tiff, pose.txt
    v2   SEQ/rgb/NNNN.png, depth/NNNN_depth.tiff, pose.txt     (deformation and screening videos: no depth)

Clock: the video's documented 29.97 frames per second (30000/1001), by frame number; a declared rate replaces it.

Depth: 16 bit along z, 65535 = 100 mm; 0 and 65535 are invalid.

Truth: `pose.txt` has 16 numbers per frame, camera to world, millimetres, right-handed, camera x right, y down, z
forward. Version 1 writes matrices column by column, version 2 row by row: the order is told by where (0, 0, 0, 1)
stands, once for the whole file, and a file that shows neither or both is refused. The world is the model's: where
gravity points is unknown.

Camera, v1: the published omnidirectional calibration, fitted by a fisheye (0.5 pixels off at most; it is turned by
0.17 degrees about its axis, hence `T_body_camera`; body = published camera). v2: unknown unless declared, its
calibration file is not part of a sequence. No IMU.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.calibration import Calibration
from vio.depth import LinearDepth
from vio.errors import FormatError, RecordingError
from vio.formats.camera_truth import rigid
from vio.formats.declared import Declared
from vio.formats.files import has_numbered, numbered, stamps_at_rate
from vio.formats.omnidirectional import Omnidirectional, fit_equidistant
from vio.formats.table import parse_floats, read_table
from vio.imu import ImuSamples
from vio.recording import Recording
from vio.trajectory import Trajectory

Array = NDArray[np.float64]

LAYOUT = "C3VD: 0000_color.png (v1) or rgb/0000.png (v2), with pose.txt"
ACCEPTS = frozenset({"calibration", "rate_hz"})
COLOUR_V1, COLOUR_V2 = r"(\d{4,9})_color\.png", r"(\d{4,9})\.png"
DEPTH = r"(\d{4,9})_depth\.tiff"
POSES = "pose.txt"
RATE_HZ = 30000 / 1001
MM = 1e-3
DEPTH_ENCODING = LinearDepth(unit_m=0.1 / 65535, largest=65534)
ENDOSCOPE = Omnidirectional(
    width=1350, height=1080, cx=678.544839263292, cy=542.975887548343,
    a=(769.243600037458, -0.000812770624150226, 6.25674244578925e-07, -1.19662182144280e-09),
    c=0.99998688224999, d=0.00288273829525059, e=-0.00296316513429569,
)
"""Olympus CF-HQ190L, as published with version 1."""


def matches(path: str | Path) -> bool:
    """Whether `path` holds frames in the naming of either version."""
    path = Path(path)
    return has_numbered(path, COLOUR_V1) or ((path / POSES).is_file() and has_numbered(path / "rgb", COLOUR_V2))


def read_c3vd(path: str | Path, declared: Declared | None = None) -> Recording:
    """Read one sequence.

    Raises:
        RecordingError: no frames, or frames that the pose file does not cover.
        FormatError: an unusable row of the pose file, or an order of its numbers that cannot be told.
    """
    declared, root = declared or Declared(), Path(path)
    frames = numbered(root, COLOUR_V1)
    version = 1 if frames else 2
    depth_folder = root if version == 1 else root / "depth"
    frames = frames or numbered(root / "rgb", COLOUR_V2)
    if not frames:
        raise RecordingError(f"{root.name}: neither 0000_color.png nor rgb/0000.png; give the folder of one sequence")
    depths = numbered(depth_folder, DEPTH)
    numbers = np.array(list(frames))
    t_ns = stamps_at_rate(numbers, declared.rate_hz or RATE_HZ, "c3vd")
    calibration = declared.calibration or _published(version)
    poses = root / POSES
    truth = None
    if poses.is_file():
        T_body_published = np.eye(4) if declared.calibration is None else declared.calibration.T_body_camera
        truth = _truth(poses, root.name, numbers, t_ns, T_body_published)
    return Recording(
        root.name, t_ns, ImuSamples.none(), calibration, truth=truth, frame_paths=tuple(frames.values()),
        depth_paths=tuple(depths.get(k) for k in frames), depth_encoding=DEPTH_ENCODING,
        provenance={"format": "c3vd", "version": version, "clock": "constant rate, by frame number"},
    )


def _published(version: int) -> Calibration:
    if version == 2:
        return Calibration()
    fisheye = fit_equidistant(ENDOSCOPE)
    return Calibration(fisheye.camera, fisheye.T_omni_camera)


def _truth(
    poses: Path, sequence: str, numbers: NDArray[np.int64], t_ns: NDArray[np.int64], T_body_published: Array
) -> Trajectory:
    """Poses of the body: the published camera itself, or where the declared calibration puts the camera."""
    T = read_c3vd_poses(poses)
    rows = numbers - numbers[0] if len(T) == len(numbers) else numbers
    if rows[-1] >= len(T):
        raise RecordingError(f"{sequence}: frame {numbers[-1]} has no row in {POSES} ({len(T)} rows for "
                             f"{len(numbers)} frames); restore the missing part")
    return Trajectory(np.asarray(t_ns * 1e-9), T[rows] @ se3.inverse(T_body_published))


def read_c3vd_poses(path: Path) -> Array:
    """Poses (N, 4, 4) of the camera in the world, metres, of a `pose.txt` in either order.

    Raises:
        FormatError: no rows, an unusable row, no rigid transform, or an order that cannot be told.
    """
    table = read_table(path)
    if not table.rows:
        raise FormatError(f"{table.name}: no rows; expected 16 numbers per frame")
    T = parse_floats(table, range(16), ",", FormatError).reshape(-1, 4, 4)
    end = np.array([0, 0, 0, 1.0])
    by_row, by_column = (np.abs(side - end).max(axis=1) < 1e-9 for side in (T[:, 3], T[:, :, 3]))
    neither = ~(by_row | by_column)
    if neither.any():
        raise FormatError(f"{table.at(int(np.argmax(neither)))}: neither the last row nor the last column of the "
                          "matrix is 0, 0, 0, 1; this is no camera pose (the robot's log has a time in front)")
    if by_row.all() == by_column.all():
        raise FormatError(f"{table.name}: matrices are written row by row in some lines and column by column in "
                          "others, or nothing moves and the order cannot be told; give a file in one order")
    T = T if by_row.all() else T.transpose(0, 2, 1).copy()
    T[:, :3, 3] *= MM
    return rigid(T, table.at)
