"""TUM RGB-D (Sturm et al. 2012): a Kinect and a motion-capture room.

    SEQ/rgb.txt           timestamp filename
    SEQ/depth.txt         optional: timestamp filename; 16-bit PNG, z, 5000 counts per metre, 0 unknown
    SEQ/groundtruth.txt   optional: timestamp tx ty tz qx qy qz qw (`vio.formats.tum`)

Clock: one for all, seconds since 1970 with six decimals, kept exact. Truth is the colour camera's optical frame in
the room (z up), metres, x right, y down, z forward; body = camera. Repeated stamps of truth keep their first row.

Depth and colour are taken at different moments: each frame gets the depth image nearest in time, at most 20 ms away
(the tolerance of the benchmark's own tool), which is the frame's depth only as far as the camera stands still
meanwhile. Camera: unknown unless declared; the benchmark publishes one set per Kinect, outside of the sequences. No
IMU: `accelerometer.txt` has no gyro and is not read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.errors import FormatError, RecordingError
from vio.formats.camera_truth import body_truth
from vio.formats.declared import Declared
from vio.formats.files import inside
from vio.formats.table import check_quaternions, parse_floats, parse_times, read_table
from vio.imu import ImuSamples
from vio.recording import Recording

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

LAYOUT = "TUM RGB-D: rgb.txt, depth.txt, groundtruth.txt"
ACCEPTS = frozenset({"calibration"})
NS_PER_S = 1_000_000_000
DEPTH_UNIT_M = 1 / 5000
DEPTH_TOLERANCE_NS = 20_000_000


def matches(path: str | Path) -> bool:
    """Whether `path` holds the list of colour images."""
    return (Path(path) / "rgb.txt").is_file()


def read_tum_rgbd(path: str | Path, declared: Declared | None = None) -> Recording:
    """Read one sequence.

    Raises:
        RecordingError: no frames.
        FormatError: an unusable row, naming its line.
    """
    declared, root = declared or Declared(), Path(path)
    t_ns, files = _read_list(root, "rgb.txt")
    if not files:
        raise RecordingError(f"{root.name}: rgb.txt lists no frames; at least one is needed")
    calibration = declared.calibration_or(None)
    truth = root / "groundtruth.txt"
    return Recording(
        root.name, t_ns, ImuSamples.none(), calibration,
        truth=body_truth(*_read_poses(truth), int(t_ns[0]), calibration) if truth.is_file() else None,
        frame_paths=files, depth_paths=_nearest_depth(root, t_ns), depth_unit_m=DEPTH_UNIT_M,
        provenance={"format": "tum-rgbd", "depth": "nearest in time, within 20 ms"},
    )


def _read_list(root: Path, name: str) -> tuple[Stamps, tuple[Path, ...]]:
    table = read_table(root / name)
    fields = [row.split(maxsplit=1) for row in table.rows]
    for k, row in enumerate(fields):
        if len(row) != 2:
            raise FormatError(f"{table.at(k)}: expected `timestamp filename`, found {table.rows[k]!r}")
    t_ns, _ = parse_times([row[0] for row in fields], NS_PER_S, table, FormatError)
    return t_ns, tuple(inside(root, row[1], table.at(k)) for k, row in enumerate(fields))


def _nearest_depth(root: Path, t_ns: Stamps) -> tuple[Path | None, ...]:
    if not (root / "depth.txt").is_file():
        return ()
    depth_t_ns, files = _read_list(root, "depth.txt")
    if not files:
        return ()
    after = np.searchsorted(depth_t_ns, t_ns)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(files) - 1)
    pick = np.where(np.abs(t_ns - depth_t_ns[before]) <= np.abs(depth_t_ns[after] - t_ns), before, after)
    near = np.abs(depth_t_ns[pick] - t_ns) <= DEPTH_TOLERANCE_NS
    return tuple(files[k] if ok else None for k, ok in zip(pick, near, strict=True))


def _read_poses(path: Path) -> tuple[Array, Stamps]:
    table = read_table(path)
    if not table.rows:
        raise FormatError(f"{table.name}: no rows; remove the file if there is no truth")
    values = parse_floats(table, range(1, 8), None, FormatError)
    quat_xyzw = check_quaternions(values[:, 3:], table, FormatError)
    t_ns, keep = parse_times([row.split()[0] for row in table.rows], NS_PER_S, table, FormatError, repair=True)
    return se3.transform(se3.matrix_from_quat_xyzw(quat_xyzw), values[:, :3])[keep], t_ns
