"""Nominal motion of a capsule: a winding centreline, a stop-and-go course along it, and tumbles.

Frames: world z up; body x along the capsule's axis towards its camera, y left, z up when lying level.
Times are seconds after the first frame. Speeds are about ten times those of a mean transit (0.1 mm per
frame), so that short sequences contain parallax: a choice of design, not physiology. Hence a long
recording travels further than the gut is long, on a centreline that keeps folding in the same volume.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator, make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

Array = NDArray[np.float64]

KNOT_SPACING_S = 0.5
MARGIN_S = 2.0  # the motion is defined this long before the first and after the last frame
NODE_SPACING_M = 5e-3
HALF_CAPSULE_M = 13e-3  # a capsule is 26 mm long and lies along the chord of the centreline


@dataclass(frozen=True)
class OrganShape:
    """How a centreline winds and how lively a capsule is in it."""

    semi_axes_m: tuple[float, float, float]
    """Ellipsoid that the centreline is steered back into."""
    bend_radius_m: float
    """Typical (RMS) radius of curvature."""
    tightest_radius_m: float
    bend_length_m: float
    """Arc length over which the curvature changes."""
    speed_factor: float
    tumble_gap_s: float
    """Mean time between two tumbles."""
    side_wander_m: float
    """Standard deviation of the position across the lumen, per axis."""


ORGANS = {
    "colon": OrganShape((0.16, 0.07, 0.16), 0.08, 0.035, 0.08, 0.8, 20.0, 0.8e-3),
    "small-bowel": OrganShape((0.11, 0.06, 0.10), 0.03, 0.018, 0.03, 1.0, 40.0, 0.5e-3),
    "stomach": OrganShape((0.06, 0.05, 0.08), 0.05, 0.025, 0.05, 1.2, 10.0, 1.5e-3),
}

# kind: probability, slowest and fastest speed along the centreline [mm/s]
_PHASES = {
    "natural": {"forward": (0.45, 0.5, 4.0), "back": (0.15, -0.5, -3.0), "dwell": (0.20, 0.0, 0.0),
                "burst": (0.10, 6.0, 20.0), "revisit": (0.10, -3.0, -8.0)},
    "operated": {"forward": (0.75, 2.0, 8.0), "back": (0.10, -1.0, -4.0), "dwell": (0.05, 0.0, 0.0),
                 "burst": (0.05, 6.0, 20.0), "revisit": (0.05, -3.0, -8.0)},
}
DRIVING = tuple(_PHASES)
_HEADING_WANDER_RAD = (0.20, 0.06, 0.06)  # about body x (roll), y and z, standard deviations


class NominalPath:
    """A pose that is twice continuously differentiable in time (position four times)."""

    def __init__(self, knot_t_s: Array, positions_m: Array, rotations: Rotation) -> None:
        self._position: Any = make_interp_spline(knot_t_s, positions_m, k=5)
        self._velocity: Any = self._position.derivative(1)
        self._acceleration: Any = self._position.derivative(2)
        self._rotation: Any = RotationSpline(knot_t_s, rotations)

    def position_m(self, t_s: Array, order: int = 0) -> Array:
        """World position (n, 3) [m] at times (n,), or its first or second time derivative."""
        out: Array = (self._position, self._velocity, self._acceleration)[order](t_s)
        return out

    def rotation(self, t_s: Array) -> Array:
        """`R_world_body` (n, 3, 3)."""
        out: Array = self._rotation(t_s).as_matrix()
        return out

    def body_rate(self, t_s: Array, order: int = 1) -> Array:
        """Angular rate (order 1, rad/s) or acceleration (order 2, rad/s²) (n, 3) in body axes."""
        out: Array = self._rotation(t_s, order)
        return out


def moving_path(organ: str, driving: str, duration_s: float, rng: np.random.Generator) -> NominalPath:
    """A capsule's course through an organ, defined from 2 s before time 0 to 2 s after `duration_s`.

    Args:
        organ: key of `ORGANS`.
        driving: "natural" (peristalsis carries it: dwell, bursts, to and fro) or "operated" (mostly forward).
        duration_s: time of the last frame or later.
        rng: source of everything random.
    """
    shape = ORGANS[organ]
    t = np.arange(-MARGIN_S, duration_s + MARGIN_S + KNOT_SPACING_S, KNOT_SPACING_S)
    arc = _course(t, _PHASES[driving], shape.speed_factor, rng)
    node_arc, nodes, frames = _centreline(shape, float(arc.max()), rng)
    along = RotationSpline(node_arc, frames)(arc)
    side = shape.side_wander_m * _smooth_noise(rng, len(t), 9)
    side[:, 0] = 0.0
    positions = make_interp_spline(node_arc, nodes, k=5)(arc) + along.apply(side)
    wander = Rotation.from_rotvec(_smooth_noise(rng, len(t), 9) * _HEADING_WANDER_RAD)
    tumble = Rotation.from_rotvec(_tumbles(t, shape.tumble_gap_s, rng))
    return NominalPath(t, positions, along * wander * tumble)


def resting_path(duration_s: float, rng: np.random.Generator) -> NominalPath:
    """A capsule that lies still at the world's origin in a random attitude."""
    t = np.linspace(-MARGIN_S, duration_s + MARGIN_S, 8)
    return NominalPath(t, np.zeros((8, 3)), Rotation.from_quat(np.tile(rng.standard_normal(4), (8, 1))))


def _course(t: Array, phases: dict[str, tuple[float, float, float]], factor: float, rng: np.random.Generator) -> Array:
    """Arc length (n,) [m] at times t: phases of 1.5 to 5 s at constant speed, rounded off, never below zero."""
    table = np.array(list(phases.values()))
    count = int(np.ceil((t[-1] - t[0]) / 1.5)) + 2
    kind = rng.choice(len(table), count, p=table[:, 0])
    speed = 1e-3 * factor * (table[kind, 1] + (table[kind, 2] - table[kind, 1]) * rng.random(count))
    length = rng.uniform(1.5, 5.0, count)
    free = np.concatenate([[0.0], np.cumsum(speed * length)])
    arc = free - np.minimum(np.minimum.accumulate(free), 0.0)  # a retreat ends at the start of the path
    out: Array = PchipInterpolator(t[0] + np.concatenate([[0.0], np.cumsum(length)]), arc)(t)
    return out


def _centreline(shape: OrganShape, length_m: float, rng: np.random.Generator) -> tuple[Array, Array, Rotation]:
    """Nodes every 5 mm: arc length (m,), position (m, 3), rotation-minimising frame with x along the capsule."""
    margin = 2 * HALF_CAPSULE_M + 5 * NODE_SPACING_M
    count = int(np.ceil((length_m + 2 * margin) / NODE_SPACING_M)) + 1
    arc = np.arange(count, dtype=float) * NODE_SPACING_M - margin
    nodes = _wind(shape, count, rng)
    curve = make_interp_spline(arc, nodes, k=5)
    inner = np.clip(arc, arc[0] + HALF_CAPSULE_M, arc[-1] - HALF_CAPSULE_M)
    chord = curve(inner + HALF_CAPSULE_M) - curve(inner - HALF_CAPSULE_M)
    chord /= np.linalg.norm(chord, axis=1, keepdims=True)
    return arc, nodes, _transported_frames(chord, rng)


def _wind(shape: OrganShape, count: int, rng: np.random.Generator) -> Array:
    """Random curve (count, 3) of unit speed: its curvature forgets over `bend_length_m` and is bounded.

    Outside the ellipsoid the curve is bent back as tightly as allowed, so it stays within about
    two of its tightest radii of it, however long it is.
    """
    axes = np.array(shape.semi_axes_m)
    keep = np.exp(-NODE_SPACING_M / shape.bend_length_m)
    kick = rng.standard_normal((count, 3)) * np.sqrt((1 - keep**2) / 2) / shape.bend_radius_m
    limit = 1 / shape.tightest_radius_m
    x = np.zeros(3)
    heading = _unit(rng.standard_normal(3))
    bend = np.zeros(3)
    out = np.empty((count, 3))
    for k in range(count):
        out[k] = x
        bend = keep * bend + kick[k]
        scaled = x / axes
        if scaled @ scaled > 1 and heading @ (x / axes**2) > -0.5 * np.linalg.norm(x / axes**2):
            bend = -limit * _unit(scaled / axes + 1e-3 * kick[k])
        bend = bend - (bend @ heading) * heading
        size = np.sqrt(bend @ bend)
        if size > limit:
            bend = bend * (limit / size)
        heading = _unit(heading + NODE_SPACING_M * bend)
        x = x + NODE_SPACING_M * heading
    return out


def _transported_frames(forward: Array, rng: np.random.Generator) -> Rotation:
    """Frames (m,) with x along `forward` (m, 3) that never twist about it: parallel transport."""
    side = _unit(np.cross(forward[0], rng.standard_normal(3)))
    y = np.empty_like(forward)
    for k, x in enumerate(forward):
        side = _unit(side - (side @ x) * x)
        y[k] = side
    return Rotation.from_matrix(np.stack([forward, y, np.cross(forward, y)], axis=2))


def _tumbles(t: Array, mean_gap_s: float, rng: np.random.Generator) -> Array:
    """Rotation vectors (n, 3): turns of 0.6 to 3.1 rad within 2 to 5 s, a hold, and the turn back."""
    count = int(np.ceil((t[-1] - t[0]) / 5.0)) + 1  # a tumble takes at least 5 s
    gap = rng.exponential(mean_gap_s, count)
    there, hold, back = rng.uniform(2, 5, count), rng.uniform(1, 6, count), rng.uniform(2, 5, count)
    axis = rng.standard_normal((count, 3))
    axis *= (rng.uniform(0.6, 3.1, count) / np.linalg.norm(axis, axis=1))[:, None]
    start = t[0] + np.cumsum(gap) + np.concatenate([[0.0], np.cumsum(there + hold + back)[:-1]])
    event = np.clip(np.searchsorted(start, t, "right") - 1, 0, None)
    since = t - start[event]
    part = _smooth_step(since / there[event]) - _smooth_step((since - there[event] - hold[event]) / back[event])
    return part[:, None] * axis[event]


def _smooth_step(x: Array) -> Array:
    """0 below 0, 1 above 1, twice continuously differentiable between."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 + x * (6 * x - 15))


def _smooth_noise(rng: np.random.Generator, count: int, width: int) -> Array:
    """Noise (count, 3) of unit standard deviation, smoothed over `width` knots."""
    kernel = np.hanning(width + 2)[1:-1]
    kernel /= np.sqrt(kernel @ kernel)
    raw = rng.standard_normal((count + width - 1, 3))
    return np.stack([np.convolve(raw[:, c], kernel, "valid") for c in range(3)], axis=1)


def _unit(v: Array) -> Array:
    out: Array = v / np.sqrt(v @ v)
    return out
