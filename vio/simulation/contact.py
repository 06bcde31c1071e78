"""Capsule and wall: how much room there is, and when the two come into contact.

The nominal motion keeps to the room that the lumen at rest leaves; what a fold, a contraction or a tumble takes of it
becomes an indentation, since the wall is softer than the capsule. The onset of an indentation is a contact: the
capsule feels a knock along the wall's normal, and `vibration.CollisionVibration` makes it an impulse.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, minimum_filter, minimum_filter1d

from vio.simulation.anatomy import Anatomy
from vio.simulation.wall import COLUMNS, ROW_M, TAU
from vio.simulation.wall_motion import CAPSULE_HALF_AXIS_M, CAPSULE_RADIUS_M, capsule_axis, exit_radius, rows_between

if TYPE_CHECKING:
    from vio.simulation.path import NominalPath

Array = NDArray[np.float64]

_STRIDE = 4  # rows and columns of the wall per cell of the coarse grids below
_ROOM_CELLS = 13  # 1 mm cells along the capsule that bound its room: folds further off bend before it
_REACH_ROWS = int(14e-3 / ROW_M)
_ONSET_M = 0.05e-3  # an indentation deeper than this is a contact
_RATE_HZ = 10.0
_FULL_SPEED_M_S = 4e-3  # an indentation that grows this fast is the hardest knock
_BATCH = 256


@dataclass(frozen=True)
class Contacts:
    """Knocks between capsule and wall, sorted in time."""

    t_s: Array
    """(k,) onset."""
    strength: Array
    """(k,) in (0, 1], from the speed of the indentation."""
    push: Array
    """(k, 3) unit vector, body axes: where the wall pushes the capsule."""
    turn: Array
    """(k, 3) unit vector, body axes: the axis about which it turns it."""


def free_radius(anatomy: Anatomy, arc_m: Array, theta_rad: Array) -> Array:
    """How far the middle of an aligned capsule can move off the centreline (n,) [m], at arcs and directions (n,).

    The narrowest cross-section along the capsule counts, minus its radius and half of the contraction that may come.
    """
    first, last = rows_between(anatomy.wall, float(arc_m.min()) - 0.03, float(arc_m.max()) + 0.03)
    radius = anatomy.wall.radius_m(first, last)[:: 2, :: _STRIDE].astype(float)
    radius = minimum_filter(radius, size=(1, 13), mode=("nearest", "wrap"))  # as wide as the capsule
    radius = minimum_filter1d(radius, _ROOM_CELLS, axis=0, mode="nearest")
    room = radius * (1 - 0.5 * anatomy.organ.waves.amplitude) - CAPSULE_RADIUS_M
    room = gaussian_filter(np.maximum(room, 0.0), (6, 3), mode=("nearest", "wrap"))
    row = np.clip((anatomy.wall.row_at(arc_m) - first) / 2, 0, len(room) - 1)
    column = theta_rad / TAU * (COLUMNS // _STRIDE)
    return _bilinear(room, row, column)


def find_contacts(anatomy: Anatomy, path: NominalPath, duration_s: float) -> Contacts:
    """Contacts of the nominal motion between time 0 and `duration_s`."""
    t = np.arange(0.0, duration_s, 1 / _RATE_HZ)
    depth, at = np.empty(len(t)), np.empty((len(t), 3))
    for first in range(0, len(t), _BATCH):
        batch = slice(first, first + _BATCH)
        depth[batch], at[batch] = _indentation(anatomy, path, t[batch])
    onset = np.flatnonzero((depth[1:] > _ONSET_M) & (depth[1:] - depth[:-1] > _ONSET_M)) + 1
    onset = onset[np.concatenate([[True], np.diff(onset) > 1])] if len(onset) else onset  # one knock per rise
    speed = (depth[onset] - depth[onset - 1]) * _RATE_HZ
    lever = at[onset]
    inward = -lever * [0.0, 1.0, 1.0] - np.clip(np.abs(lever[:, :1]) - CAPSULE_HALF_AXIS_M, 0, None) * np.sign(
        lever[:, :1]) * [1.0, 0.0, 0.0]
    push = _unit_rows(inward)
    return Contacts(t[onset], np.clip(speed / _FULL_SPEED_M_S, 0.15, 1.0), push, _unit_rows(np.cross(lever, push)))


def _indentation(anatomy: Anatomy, path: NominalPath, t: Array) -> tuple[Array, Array]:
    """Depth (n,) [m] of the deepest contact at times (n,), and its place (n, 3) [m] in body axes."""
    position, R, arc = path.position_m(t), path.rotation(t), path.arc_m(t)
    row = np.clip(np.round(anatomy.wall.row_at(arc)).astype(int), 0, anatomy.wall.rows - 1)
    offsets = np.arange(-2 * _REACH_ROWS, 2 * _REACH_ROWS + 1, _STRIDE)
    rows = np.clip(row[:, None] + offsets, 0, anatomy.wall.rows - 1)
    low, high = int(rows.min()), int(rows.max()) + 1
    radius = anatomy.wall.radius_m(low, high)[:, ::_STRIDE].astype(float)
    arcs = anatomy.wall.arc_m[rows]
    share, slide = anatomy.motion.contraction(arcs, t[:, None])
    flat = (arcs + slide).ravel()
    centre = anatomy.centreline.position_m(flat).reshape(*rows.shape, 3)
    across = np.swapaxes(anatomy.centreline.frame(flat).as_matrix()[:, :, 1:], 1, 2).reshape(*rows.shape, 2, 3)
    angle = np.arange(0, COLUMNS, _STRIDE) / COLUMNS * TAU
    T = np.zeros((len(t), 4, 4))
    T[:, :3, :3], T[:, :3, 3] = R, position
    rear, front = (end[:, None] for end in capsule_axis(T))
    needed = exit_radius(centre, across, angle, rear, front, CAPSULE_RADIUS_M)
    depth = needed - radius[rows - low] * share[..., None]
    deepest = depth.reshape(len(t), -1).argmax(axis=1)
    k, m = np.unravel_index(deepest, depth.shape[1:])
    n = np.arange(len(t))
    outward = np.cos(angle[m])[:, None] * across[n, k, 0] + np.sin(angle[m])[:, None] * across[n, k, 1]
    place = centre[n, k] + needed[n, k, m, None] * outward
    return np.maximum(depth[n, k, m], 0.0), np.einsum("nyx,ny->nx", R, place - position)


def _bilinear(values: Array, row: Array, column: Array) -> Array:
    """Values (n,) of a grid at fractional rows and (periodic) columns (n,)."""
    i = np.clip(np.floor(row).astype(int), 0, max(len(values) - 2, 0))
    j = np.floor(column).astype(int)
    a, b, width = row - i, column - j, values.shape[1]
    low, high = i, np.minimum(i + 1, len(values) - 1)
    near = (1 - b) * values[low, j % width] + b * values[low, (j + 1) % width]
    far = (1 - b) * values[high, j % width] + b * values[high, (j + 1) % width]
    out: Array = (1 - a) * near + a * far
    return out


def _unit_rows(v: Array) -> Array:
    out: Array = v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12)
    return out
