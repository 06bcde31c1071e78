"""The wall as it moves: contractions travel along it, and it gives way to the capsule that presses against it.

At time t the wall point (row, column) lies at
    X = C(s + u(s, t)) + r(row, column) P(s, t) (cos θ U + sin θ V)   with U, V at s + u,
pushed out along its radius where it would otherwise be inside the capsule. Its material address stays, so the exact
motion of every visible wall point is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from vio.simulation.centreline import Centreline
from vio.simulation.organs import Waves
from vio.simulation.wall import COLUMNS, TAU, Wall

Array = NDArray[np.float64]

CAPSULE_RADIUS_M = 5.5e-3
CAPSULE_HALF_AXIS_M = 7.5e-3  # half the distance between the centres of its two domes
CLEARANCE_M = 0.15e-3  # fluid film between capsule and wall
_TENT_ROWS, _TENT_COLUMNS = 3.0, 4.0  # how far the tissue around a contact is pulled along
_TENT_REACH_ROWS = 12  # four standard deviations, where the filter ends
_NEIGHBOUR_ROWS = 90
_SLIDE_M = 3e-3  # times the contraction's amplitude: how far the wall slides along the lumen
_ANGLE = np.arange(COLUMNS) / COLUMNS * TAU
_DIRECTION = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)])


@dataclass(frozen=True)
class WallState:
    """A stretch of wall at one instant."""

    first_row: int
    centre_m: Array
    """(k, 3) centre of every row in the world."""
    across: Array
    """(k, 2, 3) directions U and V across the lumen."""
    radius_m: Array
    """(k, columns)"""

    def points(self, row: Array, column: Array) -> Array:
        """World positions (n, 3) of wall points at fractional rows and columns (n,), on the triangles of the grid."""
        i = np.clip(np.floor(row).astype(int) - self.first_row, 0, len(self.centre_m) - 2)
        j = np.floor(column).astype(int)
        a, b = row - self.first_row - i, column - j
        lower = a + b <= 1  # the triangle of the cell, split as the renderer splits it
        corner = [self._vertex(i + di, (j + dj) % COLUMNS) for di, dj in ((0, 0), (1, 0), (0, 1), (1, 1))]
        first = corner[0] + a[:, None] * (corner[1] - corner[0]) + b[:, None] * (corner[2] - corner[0])
        second = corner[3] + (1 - a)[:, None] * (corner[2] - corner[3]) + (1 - b)[:, None] * (corner[1] - corner[3])
        return np.asarray(np.where(lower[:, None], first, second))

    def vertices(self) -> Array:
        """World positions (k, columns, 3) of the grid's vertices."""
        outward = np.einsum("kcx,cm->kmx", self.across, _DIRECTION)
        return np.asarray(self.centre_m[:, None] + self.radius_m[..., None] * outward)

    def _vertex(self, i: NDArray[np.intp], j: NDArray[np.intp]) -> Array:
        out: Array = self.centre_m[i] + self.radius_m[i, j][:, None] * (
            _DIRECTION[0, j][:, None] * self.across[i, 0] + _DIRECTION[1, j][:, None] * self.across[i, 1])
        return out


class WallMotion:
    """Where the wall of an organ is at any time.

    Args:
        wall: the wall at rest.
        centreline: where its organ winds.
        waves: its contractions.
        strength: scale of their amplitude; 0 is a wall that only gives way to the capsule.
    """

    def __init__(self, wall: Wall, centreline: Centreline, waves: Waves, strength: float = 1.0) -> None:
        self._wall, self._centreline, self._waves = wall, centreline, waves
        self._amplitude = strength * waves.amplitude

    def contraction(self, arc_m: Array, t_s: float | Array) -> tuple[Array, Array]:
        """Share of the radius that is left, and slide along the lumen [m], at arc lengths (n,) and time(s) [s].

        Waves follow each other at the distance that rate and speed imply. Both vanish at the closed ends.
        """
        spacing = self._waves.speed_m_s * 60 / self._waves.per_minute
        phase = (arc_m - self._waves.speed_m_s * np.asarray(t_s)) / spacing
        x = (phase - np.floor(phase) - 0.5) * spacing
        bump = np.exp(-((x / self._waves.width_m) ** 2)) - np.exp(-((0.5 * spacing / self._waves.width_m) ** 2))
        end = np.minimum(arc_m, self._wall.organ.length_m - arc_m)
        bump = self._amplitude * bump * (1 - np.exp(-np.clip(end, 0, None) / 0.02))
        return 1 - bump, _SLIDE_M * bump * x / self._waves.width_m

    def state(self, first: int, last: int, t_s: float, radius_m: Array, T_world_body: Array | None) -> WallState:
        """The wall between two rows.

        Args:
            first, last: rows, the second exclusive.
            t_s: seconds after the first frame.
            radius_m: (last - first, columns) radius at rest, from `Wall`.
            T_world_body: (4, 4) pose of the capsule that the wall gives way to; None = no capsule.
        """
        arc = self._wall.arc_m[first:last]
        share, slide = self.contraction(arc, t_s)
        centre = self._centreline.position_m(arc + slide)
        across = np.swapaxes(self._centreline.frame(arc + slide).as_matrix()[:, :, 1:], 1, 2)
        state = WallState(first, centre, np.ascontiguousarray(across), radius_m * share[:, None])
        return state if T_world_body is None else _give_way(state, T_world_body)


def capsule_axis(T_world_body: Array) -> tuple[Array, Array]:
    """Centres (..., 3) of the rear and the front dome of a capsule at pose(s) (..., 4, 4)."""
    reach = CAPSULE_HALF_AXIS_M * T_world_body[..., :3, 0]
    return T_world_body[..., :3, 3] - reach, T_world_body[..., :3, 3] + reach


def exit_radius(centre_m: Array, across: Array, angle_rad: Array, rear_m: Array, front_m: Array,
                radius_m: float) -> Array:
    """Where radial rays of the wall leave a capsule: the larger distance (..., m) [m], -inf where they miss it.

    Args:
        centre_m, across: (..., 3) and (..., 2, 3) centres and directions U, V of rows.
        angle_rad: (m,) angles of the rays in their row.
        rear_m, front_m: (..., 3) ends of the capsule's axis.
        radius_m: of the capsule.
    """
    axis = front_m - rear_m
    length = np.linalg.norm(axis, axis=-1, keepdims=True)
    axis = axis / length
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)

    def along(vector: Array) -> Array:
        """Component (..., m) of a vector (..., 3) along every ray."""
        u, v = np.sum(across[..., 0, :] * vector, -1), np.sum(across[..., 1, :] * vector, -1)
        out: Array = u[..., None] * cos + v[..., None] * sin
        return out

    start = centre_m - rear_m
    height = np.sum(start * axis, -1, keepdims=True)
    slope, square = along(axis), np.sum(start * start, -1, keepdims=True)
    tube = _larger_root(1 - slope * slope, along(start) - slope * height, square - height**2 - radius_m**2)
    reached = height + np.where(np.isfinite(tube), tube, 0.0) * slope
    best = np.where((reached >= 0) & (reached <= length), tube, -np.inf)
    for end in (rear_m, front_m):
        offset = centre_m - end
        missing = np.sum(offset * offset, -1, keepdims=True) - radius_m**2
        best = np.maximum(best, _larger_root(np.float64(1.0), along(offset), missing))
    return best


def _larger_root(a: Array | np.float64, half_b: Array, c: Array) -> Array:
    """Larger root of a x² + 2 half_b x + c, -inf where there is none."""
    discriminant = half_b * half_b - a * c
    real = (discriminant >= 0) & (a > 1e-12)
    root = (np.sqrt(np.where(real, discriminant, 0.0)) - half_b) / np.where(real, a, 1.0)
    return np.where(real, root, -np.inf)


def _give_way(state: WallState, T_world_body: Array) -> WallState:
    """Push the wall out of the capsule, and pull the tissue around along."""
    rear, front = capsule_axis(T_world_body)
    met = np.flatnonzero(_meets_capsule(state, T_world_body))
    if not len(met):
        return state
    rows = slice(max(met[0] - _TENT_REACH_ROWS, 0), met[-1] + 1 + _TENT_REACH_ROWS)
    needed = exit_radius(state.centre_m[rows], state.across[rows], _ANGLE, rear, front, CAPSULE_RADIUS_M + CLEARANCE_M)
    push = np.clip(needed - state.radius_m[rows], 0.0, None)
    if not push.any():
        return state
    tent = np.maximum(push, 1.1 * gaussian_filter(push, (_TENT_ROWS, _TENT_COLUMNS), mode=("nearest", "wrap")))
    radius = state.radius_m.copy()
    radius[rows] += tent
    return WallState(state.first_row, state.centre_m, state.across, radius)


def _meets_capsule(state: WallState, T_world_body: Array) -> NDArray[np.bool_]:
    """Rows (k,) whose plane cuts the capsule, without those of another loop of the gut."""
    along = np.cross(state.across[:, 0], state.across[:, 1])
    offset = state.centre_m - T_world_body[:3, 3]
    reach = CAPSULE_HALF_AXIS_M * np.abs(along @ T_world_body[:3, 0]) + CAPSULE_RADIUS_M + CLEARANCE_M
    nearest = np.argmin(np.sum(offset * offset, axis=1))
    same_loop = np.abs(np.arange(len(offset)) - nearest) <= _NEIGHBOUR_ROWS
    return np.asarray((np.abs(np.sum(along * offset, axis=1)) < reach) & same_loop)


def rows_between(wall: Wall, low_m: float, high_m: float) -> tuple[int, int]:
    """Rows (first, last) whose centres lie between two arc lengths [m], at least two, inside the organ."""
    first = int(np.clip(np.floor(wall.row_at(np.array([low_m]))[0]), 0, wall.rows - 2))
    last = int(np.clip(np.ceil(wall.row_at(np.array([high_m]))[0]) + 1, first + 2, wall.rows))
    return first, last

