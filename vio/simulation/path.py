"""Nominal motion of a capsule through an organ: a stop-and-go course along the lumen, a place across it, and tumbles.

Frames: world z up; body x along the capsule's axis towards its camera, y left, z up when lying level.
Times are seconds after the first frame. Driving is

* "transit": as slow as a capsule really is, most of the way in bursts that take a few percent of the time;
* "natural": about ten times that, so that short sequences contain parallax; dwells, bursts, to and fro;
* "operated": an operator drives it through, mostly forward (how the paper's data were made);
* "brisk": another operator, faster, with more looking back;
* "one-way": forward only, never back, unless it comes to the organ's end;
* "withdrawn": as operated until half the time has passed, then pulled back the way it came, still looking ahead.

At a closed end of the organ the capsule turns back: every organ has the length it has, and a long course revisits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator, make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from vio.simulation.anatomy import Anatomy
from vio.simulation.centreline import HALF_CAPSULE_M
from vio.simulation.contact import free_radius

Array = NDArray[np.float64]

KNOT_SPACING_S = 0.5
MARGIN_S = 2.0  # the motion is defined this long before the first and after the last frame
END_GAP_M = 1.1 * HALF_CAPSULE_M  # how close to a closed end the capsule's front comes

# kind: probability, slowest and fastest speed along the centreline [mm/s]
_PHASES = {
    "natural": {"forward": (0.45, 0.5, 4.0), "back": (0.15, -0.5, -3.0), "dwell": (0.20, 0.0, 0.0),
                "burst": (0.10, 6.0, 20.0), "revisit": (0.10, -3.0, -8.0)},
    "operated": {"forward": (0.75, 2.0, 8.0), "back": (0.10, -1.0, -4.0), "dwell": (0.05, 0.0, 0.0),
                 "burst": (0.05, 6.0, 20.0), "revisit": (0.05, -3.0, -8.0)},
    "brisk": {"forward": (0.55, 4.0, 12.0), "back": (0.20, -3.0, -9.0), "dwell": (0.05, 0.0, 0.0),
              "burst": (0.10, 8.0, 24.0), "revisit": (0.10, -4.0, -10.0)},
    "one-way": {"forward": (0.90, 2.0, 8.0), "dwell": (0.05, 0.0, 0.0), "burst": (0.05, 6.0, 20.0)},
    "transit": {"forward": (0.18, 0.1, 0.5), "back": (0.06, -0.1, -0.4), "dwell": (0.72, 0.0, 0.0),
                "burst": (0.035, 4.0, 12.0), "revisit": (0.005, -2.0, -5.0)},
}
_PHASES["withdrawn"] = _PHASES["operated"]
DRIVING = tuple(_PHASES)
_HEADING_WANDER_RAD = (0.20, 0.06, 0.06)  # about body x (roll), y and z, standard deviations
_PLACE_SD = 0.9  # of the place across the lumen, in units of the room that the capsule has
_PRESS_M = 1.0e-3  # how far a capsule that leans on the wall presses into it


class NominalPath:
    """A pose that is twice continuously differentiable in time (position four times)."""

    def __init__(self, knot_t_s: Array, positions_m: Array, rotations: Rotation, arc_m: Array) -> None:
        self._position: Any = make_interp_spline(knot_t_s, positions_m, k=5)
        self._velocity: Any = self._position.derivative(1)
        self._acceleration: Any = self._position.derivative(2)
        self._rotation: Any = RotationSpline(knot_t_s, rotations)
        self._arc: Any = PchipInterpolator(knot_t_s, arc_m)

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

    def arc_m(self, t_s: Array) -> Array:
        """Arc length of the organ's centreline beside the capsule's middle (n,) [m]: the truth of "how far along"."""
        out: Array = self._arc(t_s)
        return out


def moving_path(anatomy: Anatomy, driving: str, duration_s: float, rng: np.random.Generator,
                start: float | None = None) -> NominalPath:
    """A capsule's course through an organ, defined from 2 s before time 0 to 2 s after `duration_s`.

    Args:
        anatomy: the organ it moves in.
        driving: one of `DRIVING`, see the module.
        duration_s: time of the last frame or later.
        rng: source of everything random.
        start: where it starts, 0 at the organ's entrance, 1 at its exit; None draws a place from the first 60 %.
    """
    organ = anatomy.organ
    place = rng.uniform(0.0, 0.6) if start is None else start
    factor = organ.transit_factor if driving == "transit" else organ.speed_factor
    low, high = 0.4 * organ.radius_m + END_GAP_M, organ.length_m - 0.4 * organ.radius_m - END_GAP_M
    t = np.arange(-MARGIN_S, duration_s + MARGIN_S + KNOT_SPACING_S, KNOT_SPACING_S)
    turn_s = 0.5 * duration_s if driving == "withdrawn" else np.inf
    arc = _course(t, _PHASES[driving], factor, low + place * (high - low), (low, high), turn_s, rng)
    along = anatomy.centreline.frame(arc)
    positions = _chord_middle(anatomy, arc) + along.apply(_place_across(anatomy, arc, rng))
    wander = Rotation.from_rotvec(_smooth_noise(rng, len(t), 9) * _HEADING_WANDER_RAD)
    tumble = Rotation.from_rotvec(_tumbles(t, organ.tumble_gap_s, rng))
    return NominalPath(t, positions, along * wander * tumble, arc)


def resting_path(anatomy: Anatomy, duration_s: float, rng: np.random.Generator) -> NominalPath:
    """A capsule that lies still in the middle of the organ, in a random attitude."""
    t = np.linspace(-MARGIN_S, duration_s + MARGIN_S, 8)
    arc = np.full(8, 0.5 * anatomy.organ.length_m)
    attitude = Rotation.from_quat(np.tile(rng.standard_normal(4), (8, 1)))
    return NominalPath(t, anatomy.centreline.position_m(arc), attitude, arc)


def _course(t: Array, phases: dict[str, tuple[float, float, float]], factor: float, start_m: float,
            ends_m: tuple[float, float], turn_s: float, rng: np.random.Generator) -> Array:
    """Arc length (n,) [m] at times t: phases of 1.5 to 5 s at constant speed, rounded off.

    It turns at the ends, and with the first phase that begins after `turn_s`.
    """
    table = np.array(list(phases.values()))
    count = int(np.ceil((t[-1] - t[0]) / 1.5)) + 2
    kind = rng.choice(len(table), count, p=table[:, 0])
    speed = 1e-3 * factor * (table[kind, 1] + (table[kind, 2] - table[kind, 1]) * rng.random(count))
    length = rng.uniform(1.5, 5.0, count)
    arc, sense = np.empty(count + 1), 1.0
    arc[0] = start_m
    begin = t[0] + np.concatenate([[0.0], np.cumsum(length)])
    turning = int(np.searchsorted(begin, turn_s))
    for k, step in enumerate(speed * length):
        if k == turning:
            sense = -sense
        arc[k + 1] = min(max(arc[k] + sense * step, ends_m[0]), ends_m[1])
        if arc[k + 1] in ends_m:
            sense = 1.0 if arc[k + 1] == ends_m[0] else -1.0
    out: Array = PchipInterpolator(begin, arc)(t)
    return out


def _chord_middle(anatomy: Anatomy, arc: Array) -> Array:
    """Middle of a stiff capsule that lies in a bent lumen (n, 3): drawn towards the inside of the bend."""
    curve = anatomy.centreline.position_m
    ends = 0.5 * (curve(arc - HALF_CAPSULE_M) + curve(arc + HALF_CAPSULE_M))
    return 0.5 * curve(arc) + 0.5 * ends


def _place_across(anatomy: Anatomy, arc: Array, rng: np.random.Generator) -> Array:
    """Offset (n, 3) [m] in lumen axes: it wanders through the room there is, and leans on the wall where that ends."""
    wish = _PLACE_SD * _smooth_noise(rng, len(arc), 9)[:, 1:]
    size = np.linalg.norm(wish, axis=1)
    room = free_radius(anatomy, arc, np.arctan2(wish[:, 1], wish[:, 0]))
    limited = size / (1 + size**6) ** (1 / 6)  # about `size` below 1, never above 1
    out = np.zeros((len(arc), 3))
    out[:, 1:] = wish * (limited * (room + _PRESS_M) / np.maximum(size, 1e-9))[:, None]
    return out


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
