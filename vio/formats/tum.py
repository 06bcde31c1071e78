"""TUM trajectories: `timestamp tx ty tz qx qy qz qw`, separated by spaces, `#` comments (Sturm et al. 2012)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vio import se3
from vio.atomic import atomic_write
from vio.errors import FormatError
from vio.formats.table import check_quaternions, parse_floats, read_table
from vio.trajectory import Trajectory

HEADER = "# timestamp [s] tx ty tz [m] qx qy qz qw"


def read_tum(path: str | Path, repair: bool = False) -> Trajectory:
    """Read a trajectory; times are kept as they are in the file.

    Args:
        path: the text file.
        repair: keep the first of several rows with one stamp instead of refusing the file.

    Raises:
        FormatError: no rows, a value that is no finite number, a quaternion that is not of unit length to 1e-3,
            or a stamp that goes back or (without `repair`) repeats; names the line.
    """
    table = read_table(Path(path))
    if not table.rows:
        raise FormatError(f"{table.name}: no rows; expected `timestamp tx ty tz qx qy qz qw`")
    values = parse_floats(table, range(8), None, FormatError)
    quat_xyzw = check_quaternions(values[:, 4:], table, FormatError)
    t = values[:, 0]
    step = np.diff(t, prepend=-np.inf)
    if (step < 0).any():
        k = int(np.argmax(step < 0))
        raise FormatError(f"{table.at(k)}: stamp {t[k]:.9f} s goes back from {t[k - 1]:.9f} s; sort the rows")
    repeated = step == 0
    if repeated.any() and not repair:
        k = int(np.argmax(repeated))
        raise FormatError(f"{table.at(k)}: stamp {t[k]:.9f} s repeats the one before it ({repeated.sum()} such rows); "
                          "read with repair=True to keep the first of each")
    T = se3.transform(se3.matrix_from_quat_xyzw(quat_xyzw), values[:, 1:4])
    return Trajectory(t[~repeated], T[~repeated])


def write_tum(trajectory: Trajectory, path: str | Path) -> None:
    """Write a trajectory atomically: times to the nanosecond, the rest with 17 significant digits.

    Raises:
        OutputError: the file cannot be written.
    """
    quat_xyzw = se3.quat_xyzw_from_matrix(trajectory.rotations)
    rows = np.hstack([trajectory.t_s[:, None], trajectory.positions_m, quat_xyzw])
    with atomic_write(path) as file:
        np.savetxt(file, rows, fmt=["%.9f"] + ["%.16e"] * 7, header=HEADER, comments="", encoding="utf-8")
