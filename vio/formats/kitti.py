"""KITTI odometry poses: 12 numbers per row, a row-major 3 x 4 pose in the first frame; times in a file apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vio import se3
from vio.atomic import atomic_write
from vio.errors import FormatError, GeometryError
from vio.formats.table import parse_floats, read_table
from vio.trajectory import Trajectory


def read_kitti(poses_path: str | Path, times_path: str | Path | None = None) -> Trajectory:
    """Read poses as `T_world_body`, world = first frame, body = whatever moved (KITTI: the left camera).

    Without times the row number stands for the seconds, so that only poses of equal rows can be compared.

    Raises:
        FormatError: no rows, a value that is no finite number, a pose that is not rigid, times that do not
            increase, or numbers of times and poses that differ; names the line where there is one.
    """
    table = read_table(Path(poses_path))
    if not table.rows:
        raise FormatError(f"{table.name}: no rows; expected 12 numbers per row")
    values = parse_floats(table, range(12), None, FormatError)
    T = np.tile(np.eye(4), (len(values), 1, 1))
    T[:, :3] = values.reshape(-1, 3, 4)
    try:
        T = se3.check_transforms(T, "pose")
    except GeometryError as error:
        raise FormatError(f"{table.name}: {error}") from None
    t = np.arange(len(T), dtype=float) if times_path is None else _read_times(Path(times_path), len(T))
    return Trajectory(t, T)


def write_kitti(trajectory: Trajectory, poses_path: str | Path, times_path: str | Path) -> None:
    """Write poses and their times, each file atomically, with 17 significant digits and nanoseconds.

    Raises:
        OutputError: a file cannot be written.
    """
    with atomic_write(times_path) as times, atomic_write(poses_path) as poses:
        np.savetxt(times, trajectory.t_s, fmt="%.9f")
        np.savetxt(poses, trajectory.T_world_body[:, :3].reshape(-1, 12), fmt="%.16e")


def _read_times(path: Path, count: int) -> se3.Array:
    table = read_table(path)
    t = parse_floats(table, range(1), None, FormatError)[:, 0]
    if len(t) != count:
        raise FormatError(f"{table.name}: {len(t)} times for {count} poses; give one per row")
    step = np.diff(t, prepend=-np.inf)
    if (step <= 0).any():
        k = int(np.argmax(step <= 0))
        raise FormatError(f"{table.at(k)}: time {t[k]:.9f} s does not follow {t[k - 1]:.9f} s; sort, drop duplicates")
    return t
