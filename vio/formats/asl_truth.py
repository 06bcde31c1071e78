"""Truth in the ASL layout: `state_groundtruth_estimate0/data.csv`, poses of the body with quaternions w, x, y, z."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from vio import se3
from vio.errors import FormatError
from vio.formats.table import check_quaternions, parse_floats, parse_stamps, read_table, write_stamped_rows
from vio.recording import TruthState
from vio.trajectory import Trajectory

TRUTH = "state_groundtruth_estimate0"
TRUTH_HEADER = (
    "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w,q_x,q_y,q_z,v_x [m/s],v_y [m/s],v_z [m/s],"
    "b_g_x [rad/s],b_g_y [rad/s],b_g_z [rad/s],b_a_x [m/s^2],b_a_y [m/s^2],b_a_z [m/s^2]"
)


class AslTruth(NamedTuple):
    """Truth of one recording."""

    trajectory: Trajectory
    """Body in the world; seconds after `t_first_ns`."""
    t_first_ns: int
    state: TruthState | None
    """Velocity and biases; None when the file has poses only (8 columns)."""


def read_asl_truth(path: str | Path, t_first_ns: int | None = None) -> AslTruth:
    """Read truth: stamp, position, quaternion wxyz, and (17 columns) velocity and biases.

    Args:
        path: the `data.csv`.
        t_first_ns: zero of the trajectory's times; its own first stamp when None.

    Raises:
        FormatError: no rows, or an unusable row, naming its line.
    """
    table = read_table(Path(path))
    if not table.rows:
        raise FormatError(f"{table.name}: no rows; remove the file if there is no truth")
    t_ns = parse_stamps(table, FormatError)
    columns = len(table.rows[0].rstrip(", \t").split(","))
    values = parse_floats(table, range(1, 17 if columns >= 17 else 8), ",", FormatError)
    quat_wxyz = check_quaternions(values[:, 3:7], table, FormatError)
    zero = int(t_ns[0]) if t_first_ns is None else t_first_ns
    T_world_body = se3.transform(se3.matrix_from_quat_xyzw(np.roll(quat_wxyz, -1, axis=1)), values[:, :3])
    state = TruthState(values[:, 7:10], values[:, 10:13], values[:, 13:16]) if columns >= 17 else None
    return AslTruth(Trajectory(np.asarray((t_ns - zero) * 1e-9), T_world_body), zero, state)


def write_asl_truth(path: Path, truth: Trajectory, state: TruthState | None, t_first_ns: int) -> None:
    """Write truth, whose times are seconds after `t_first_ns`; without a state only the first 8 columns."""
    t_ns = t_first_ns + np.round(truth.t_s * 1e9).astype(np.int64)
    quat_wxyz = np.roll(se3.quat_xyzw_from_matrix(truth.rotations), 1, axis=1)
    values, header = np.hstack([truth.positions_m, quat_wxyz]), TRUTH_HEADER.partition(",v_x")[0]
    if state is not None:
        values = np.hstack([values, state.velocity_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2])
        header = TRUTH_HEADER
    write_stamped_rows(path, header, t_ns, values)
