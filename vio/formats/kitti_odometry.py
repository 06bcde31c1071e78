"""KITTI odometry (Geiger et al. 2012): a car.

    sequences/NN/image_0/%06d.png (grey) or image_2 (colour), calib.txt, times.txt
    sequences/NN/poses.txt or poses/NN.txt      optional: `vio.formats.kitti`

Clock: `times.txt`, seconds after the first frame, one row per frame. Truth is the left grey camera (camera 0) in its
first pose: x right, y down, z forward, metres, so z is NOT up and gravity is unknown. Body = camera 0; image_2 sits
beside it, by the fourth column of P2. Images are rectified: pinhole without distortion, from P0 or P2. No IMU (it is
in the raw data), no depth.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.calibration import Calibration, short_name
from vio.camera import Camera
from vio.errors import CameraError, FormatError, RecordingError
from vio.formats.declared import Declared
from vio.formats.files import has_numbered, numbered
from vio.formats.kitti import read_kitti
from vio.formats.table import parse_times, read_table, read_text
from vio.image_files import size_of
from vio.imu import ImuSamples
from vio.recording import Recording
from vio.trajectory import Trajectory

Array = NDArray[np.float64]

LAYOUT = "KITTI odometry: image_0 or image_2 with calib.txt and times.txt"
ACCEPTS = frozenset({"calibration"})
FRAME = r"(\d{6})\.png"
FOLDERS = {"image_0": "P0:", "image_2": "P2:"}
NS_PER_S = 1_000_000_000


def matches(path: str | Path) -> bool:
    """Whether `path` holds times and one of the left cameras' folders."""
    path = Path(path)
    return (path / "times.txt").is_file() and any(has_numbered(path / name, FRAME) for name in FOLDERS)


def read_kitti_odometry(path: str | Path, declared: Declared | None = None) -> Recording:
    """Read one sequence.

    Raises:
        RecordingError: no frames, or frames that times or poses do not cover.
        FormatError: an unusable row, or a calibration without its camera.
    """
    declared, root = declared or Declared(), Path(path).resolve()
    folder = next((name for name in FOLDERS if has_numbered(root / name, FRAME)), None)
    if folder is None:
        raise RecordingError(f"{root.name}: no image_0/000000.png; give the folder of one sequence")
    frames = numbered(root / folder, FRAME)
    numbers = np.array(list(frames))
    table = read_table(root / "times.txt")
    all_ns, _ = parse_times(table.rows, NS_PER_S, table, FormatError)
    if numbers[-1] >= len(all_ns):
        raise RecordingError(f"{table.name}: {len(all_ns)} times, but there is a frame {numbers[-1]}; restore the rows")
    lens = None
    if folder != "image_0" or declared.calibration is None:
        lens = _calibration(root / "calib.txt", FOLDERS[folder], next(iter(frames.values())))
    calibration = declared.calibration or lens or Calibration()
    T_cam0_camera = np.eye(4) if lens is None else lens.T_body_camera
    T_cam0_body = T_cam0_camera @ se3.inverse(calibration.T_body_camera)
    return Recording(
        root.name, all_ns[numbers], ImuSamples.none(), calibration,
        truth=_truth(root, all_ns, int(all_ns[numbers[0]]), T_cam0_body),
        frame_paths=tuple(frames.values()), provenance={"format": "kitti", "camera": folder},
    )


def _truth(root: Path, t_ns: NDArray[np.int64], first_ns: int, T_cam0_body: Array) -> Trajectory | None:
    files = (root / "poses.txt", root.parent.parent / "poses" / f"{root.name}.txt")
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        return None
    T_world_cam0 = read_kitti(file).T_world_body
    if len(T_world_cam0) != len(t_ns):
        raise FormatError(f"{short_name(file)}: {len(T_world_cam0)} poses for {len(t_ns)} times; give one per row")
    return Trajectory(np.asarray((t_ns - first_ns) * 1e-9), T_world_cam0 @ T_cam0_body)


def _calibration(file: Path, label: str, image: Path) -> Calibration:
    """Camera and its place beside camera 0, which is the body."""
    name = short_name(file)
    P = _projection(file, name, label)
    width, height = size_of(image, "first frame")
    try:
        camera = Camera("pinhole", width, height, P[0, 0], P[1, 1], P[0, 2], P[1, 2])
    except CameraError as error:
        raise FormatError(f"{name}: {label} {error}") from None
    T_camera_body = np.eye(4)
    T_camera_body[:3, 3] = np.linalg.solve(camera.K, P[:, 3])  # P = K [I | t], t from camera 0 to this one
    return Calibration(camera, se3.inverse(T_camera_body))


def _projection(file: Path, name: str, label: str) -> Array:
    line = next((line for line in read_text(file).splitlines() if line.startswith(label)), "")
    try:
        values = np.array(line.removeprefix(label).split(), float)
    except ValueError:
        values = np.zeros(0)
    if len(values) != 12 or not np.isfinite(values).all():
        raise FormatError(f"{name}: no line {label} with 12 numbers; restore it")
    return values.reshape(3, 4)
