"""What Unity recordings share: left-handed poses, the pose file of VR-Caps, and device depth.

Unity is left-handed (x right, y up, z forward). Ours is right-handed with y down, so every pose is conjugated with S
= diag(1, -1, 1): R' = S R S, t' = S t, quaternion (x, y, z, w) -> (-x, y, -z, w). Multiplying from one side only
would leave determinant -1.

The pose file has the title line `tX,tY,tZ,rX,rY,rZ,rW,time(s)`: position in Unity units, quaternion x, y, z, w, and
the simulated clock in seconds; one row per step of physics (30.0003 Hz). It is the pose of the object that carries
the script: in VR-Caps the capsule, whose child the camera is. Its writer is never closed, so the last line may be cut
off (it is dropped when it has no line end), and it follows the computer's locale, so decimals may have commas
(refused: `1,5,2` cannot be told apart).
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.depth import DepthEncoding, RelativeInverseDepth, ReversedZDepth
from vio.errors import FormatError
from vio.formats.declared import Declared
from vio.formats.table import check_quaternions, parse_floats, parse_times, read_table

Array = NDArray[np.float64]

FLIP = np.diag([1.0, -1.0, 1.0, 1.0])
TITLE = "tx,ty,tz,rx,ry,rz,rw,time(s)"
COLUMNS = 8
NS_PER_S = 1_000_000_000


class UnityPoses(NamedTuple):
    """Poses of the object that carried the recording script."""

    t_ns: NDArray[np.int64]
    """(N,) simulated clock."""
    T_world_object: Array
    """(N, 4, 4) right-handed (y down), translation in Unity units."""


def right_handed(T_unity: ArrayLike) -> Array:
    """Poses (..., 4, 4) from Unity's axes to x right, y down, z forward; the same formula leads back."""
    return np.asarray(FLIP @ np.asarray(T_unity, float) @ FLIP)


def read_unity_poses(path: Path) -> UnityPoses:
    """Read `position_rotation.csv`.

    Raises:
        FormatError: no rows, another title line, decimal commas, an unusable row, or times that do not increase.
    """
    table = read_table(path, drop_unfinished=True)
    if not table.rows:
        raise FormatError(f"{table.name}: no rows; expected tX,tY,tZ,rX,rY,rZ,rW,time(s)")
    if table.header.replace(" ", "").lower() != TITLE:
        raise FormatError(f"{table.name}: the title line is {table.header[:60]!r}, expected {TITLE!r}; this is no pose "
                          "file of VR-Caps")
    for k, row in enumerate(table.rows):
        if len(row.split(",")) > COLUMNS:
            raise FormatError(f"{table.at(k)}: {len(row.split(','))} fields for {COLUMNS} columns: the decimals were "
                              "written with commas, which cannot be told apart; export again with decimal points")
    values = parse_floats(table, range(COLUMNS), ",", FormatError)
    t_ns, _ = parse_times([row.split(",")[7] for row in table.rows], NS_PER_S, table, FormatError)
    quat_xyzw = check_quaternions(values[:, 3:7], table, FormatError)
    return UnityPoses(t_ns, right_handed(se3.transform(se3.matrix_from_quat_xyzw(quat_xyzw), values[:, :3])))


def unity_depth(declared: Declared) -> DepthEncoding:
    """Metric when the user declares near plane, far plane and unit; else depth up to an unknown factor."""
    if declared.depth_planes is None or declared.unit_m is None:
        return RelativeInverseDepth()
    near, far = declared.depth_planes
    return ReversedZDepth(near * declared.unit_m, far * declared.unit_m)
