"""Where an organ winds: a smooth curve in the world with frames that never twist about it.

Frames: world z up. The frame at an arc length has x along the lumen (the chord of a capsule's length), y and z across.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from vio.simulation.organs import Organ

Array = NDArray[np.float64]

NODE_SPACING_M = 5e-3
HALF_CAPSULE_M = 13e-3  # a capsule is 26 mm long
_MARGIN_M = 2 * HALF_CAPSULE_M + 5 * NODE_SPACING_M


class Centreline:
    """A curve of known arc length, defined a little beyond both of its ends.

    Args:
        organ: how it winds.
        rng: source of everything random.
    """

    def __init__(self, organ: Organ, rng: np.random.Generator) -> None:
        count = int(np.ceil((organ.length_m + 2 * _MARGIN_M) / NODE_SPACING_M)) + 1
        arc = np.arange(count, dtype=float) * NODE_SPACING_M - _MARGIN_M
        nodes = _wind(organ, count, rng)
        nodes -= nodes.mean(axis=0)
        self.length_m = organ.length_m
        self._position: Any = make_interp_spline(arc, nodes, k=5)
        inner = np.clip(arc, arc[0] + HALF_CAPSULE_M, arc[-1] - HALF_CAPSULE_M)
        chord = self._position(inner + HALF_CAPSULE_M) - self._position(inner - HALF_CAPSULE_M)
        chord /= np.linalg.norm(chord, axis=1, keepdims=True)
        self._frames: Any = RotationSpline(arc, _transported_frames(chord, rng))

    def position_m(self, arc_m: Array) -> Array:
        """World position (n, 3) [m] at arc lengths (n,) [m]."""
        out: Array = self._position(arc_m)
        return out

    def frame(self, arc_m: Array) -> Rotation:
        """`R_world_lumen` (n,) with x along the lumen."""
        return self._frames(arc_m)


def _wind(organ: Organ, count: int, rng: np.random.Generator) -> Array:
    """Random curve (count, 3) of unit speed: its curvature forgets over `bend_length_m` and is bounded.

    Outside the ellipsoid the curve is bent back as tightly as allowed, so it stays within about
    two of its tightest radii of it, however long it is.
    """
    axes = np.array(organ.semi_axes_m)
    keep = np.exp(-NODE_SPACING_M / organ.bend_length_m)
    kick = rng.standard_normal((count, 3)) * np.sqrt((1 - keep**2) / 2) / organ.bend_radius_m
    limit = 1 / organ.tightest_radius_m
    x = np.zeros(3)
    heading = _unit(rng.standard_normal(3))
    bend = np.zeros(3)
    out = np.empty((count, 3))
    for k in range(count):
        out[k] = x
        bend = keep * bend + kick[k]
        scaled = x / axes
        if scaled @ scaled > 1 and heading @ (x / axes**2) > -0.5 * np.linalg.norm(x / axes**2):
            bend = 0.7 * bend - 0.3 * limit * _unit(scaled / axes + 1e-3 * kick[k])
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


def _unit(v: Array) -> Array:
    out: Array = v / np.sqrt(v @ v)
    return out
