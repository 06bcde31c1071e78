"""Vibration of a capsule: small motions on top of the nominal ones, in five levels.

There is ONE random stream per (seed, kind), drawn at level 5; a level scales it and, for collisions,
keeps a nested subset of its events. So every level shakes the capsule harder than the one below, for
every seed, and the same events can be followed through the levels.

The paper adds Gaussian noise "within [-1, 1]" to the position at levels 1 to 5 without a unit, and tells
peristalsis from collisions without figures; the amplitudes below are this project's own.
All values and derivatives are closed forms or splines evaluated locally: no signal is stored densely.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from vio.simulation.contact import Contacts
from vio.simulation.path import MARGIN_S

Array = NDArray[np.float64]

KINDS = ("none", "gaussian", "peristalsis", "collision")
MAX_LEVEL = 5

GAUSSIAN_STEP_M = 1e-4
GAUSSIAN_KNOT_HZ = 8.0
_RESIDUE_HZ = 0.8
_COLLISION_WINDOW_S = 0.5  # after it an impulse is below 1e-13 of its peak


class Vibration(Protocol):
    """Offset of the shaken body from the nominal one, in nominal body axes."""

    kinks_s: Array
    """(k,) sorted instants at which the second derivative has a kink: an integrator should stop there."""

    def __call__(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Offset (n, 6), rotation vector [rad] then displacement [m], and its two time derivatives."""
        ...


class NoVibration:
    """No offset at any time."""

    kinks_s = np.empty(0)

    def __call__(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Zeros, three times (n, 6)."""
        zero = np.zeros((len(t_s), 6))
        return zero, zero, zero


class GaussianVibration:
    """Normal noise clipped to [-1, 1], times 0.1 mm per level, on three position axes.

    The noise sits on knots at 8 Hz joined by a quintic spline: no energy to speak of above 5 Hz, far
    below the 20 Hz that a 40 Hz IMU can show. Measured per level: 0.12 mm, 1.6 mm/s and 31 mm/s² RMS
    (length of the vector), so 0.15 m/s² at level 5.
    """

    kinks_s = np.empty(0)

    def __init__(self, level: int, duration_s: float, rng: np.random.Generator) -> None:
        count = int(np.ceil((duration_s + 2 * MARGIN_S) * GAUSSIAN_KNOT_HZ)) + 6
        t = -MARGIN_S + (np.arange(count) - 2) / GAUSSIAN_KNOT_HZ
        noise = np.clip(rng.standard_normal((count, 3)), -1.0, 1.0)
        spline: Any = make_interp_spline(t, level * GAUSSIAN_STEP_M * noise, k=5)
        self._splines = (spline, spline.derivative(1), spline.derivative(2))

    def __call__(self, t_s: Array) -> tuple[Array, Array, Array]:
        """See `Vibration`."""
        still = np.zeros((len(t_s), 3))
        value, rate, acceleration = (np.hstack([still, spline(t_s)]) for spline in self._splines)
        return value, rate, acceleration


class PeristalticVibration:
    """Six sines per channel, 0.15 to 2.5 Hz, about 0.45 mm and 2.2 degrees at level 5, falling as f^-1/2."""

    kinks_s = np.empty(0)

    def __init__(self, level: int, rng: np.random.Generator) -> None:
        hz = np.exp(rng.uniform(np.log(0.15), np.log(2.5), (6, 6)))
        size = np.where(np.arange(6) < 3, np.deg2rad(2.2), 0.45e-3)
        size = (level / MAX_LEVEL) * size * np.sqrt(0.3 / hz) * 1.4 / np.sqrt(6)
        self._amplitude = size * rng.uniform(0.5, 1.5, (6, 6))
        self._omega = 2 * np.pi * hz
        self._phase = rng.uniform(0, 2 * np.pi, (6, 6))

    def __call__(self, t_s: Array) -> tuple[Array, Array, Array]:
        """See `Vibration`."""
        value, rate, acceleration = (np.zeros((len(t_s), 6)) for _ in range(3))
        for amplitude, omega, phase in zip(self._amplitude, self._omega, self._phase, strict=True):
            angle = t_s[:, None] * omega + phase
            sine = amplitude * np.sin(angle)
            value += sine
            rate += amplitude * omega * np.cos(angle)
            acceleration -= omega**2 * sine
        return value, rate, acceleration


class CollisionVibration:
    """Impulses from residue and from contacts with the wall: a decaying oscillation of 5 to 45 Hz, C2 at its onset.

    Residue hits at random, up to 0.8 times per second, from any side. A contact hits when and where the capsule's
    nominal motion meets the wall, the harder the faster. Each pushes up to 0.30 mm and turns up to 1.6 degrees at
    level 5, less at high frequency. An event has a mark in [0, 1); a level keeps those below its share, and always the
    lowest, so that even the shortest recording is hit at least once.
    """

    def __init__(self, level: int, duration_s: float, rng: np.random.Generator,
                 contacts: Contacts | None = None) -> None:
        strength = level / MAX_LEVEL
        latest_s = duration_s - min(0.1, 0.5 * duration_s)  # so that no event falls after the last frame
        count = max(int(rng.poisson(_RESIDUE_HZ * latest_s)), 1)
        start = rng.uniform(0.0, latest_s, count)
        size = rng.uniform(0.4, 1.0, count)
        axis, push = (_unit_rows(rng.standard_normal((count, 3))) for _ in range(2))
        if contacts is not None:
            early = contacts.t_s < latest_s
            start, size = np.append(start, contacts.t_s[early]), np.append(size, contacts.strength[early])
            axis, push = np.vstack([axis, contacts.turn[early]]), np.vstack([push, contacts.push[early]])
            count = len(start)
        hz = np.exp(rng.uniform(np.log(5), np.log(45), count))
        rise_s, phase = rng.uniform(0.012, 0.035, count), rng.uniform(0, 2 * np.pi, count)
        mark = rng.random(count)
        keep = (mark <= max(0.25 + 0.75 * strength, float(mark.min()))) & (level > 0)
        size = size * strength * np.minimum(20.0 / hz, 2.0)
        direction = size[:, None] * np.hstack([np.deg2rad(1.6) * axis, 0.30e-3 * push])
        order = np.flatnonzero(keep)[np.argsort(start[keep], kind="stable")]
        self._direction, self._rise = direction[order], rise_s[order]
        self._omega, self._phase = 2 * np.pi * hz[order], phase[order]
        self.kinks_s = start[order]

    def __call__(self, t_s: Array) -> tuple[Array, Array, Array]:
        """See `Vibration`. Each time looks only at the events of the last half second."""
        value, rate, acceleration = (np.zeros((len(t_s), 6)) for _ in range(3))
        event = np.searchsorted(self.kinks_s, t_s, "right") - 1
        row = np.arange(len(t_s))
        while True:
            live = event >= 0
            row, event = row[live], event[live]
            live = t_s[row] - self.kinks_s[event] < _COLLISION_WINDOW_S
            row, event = row[live], event[live]
            if not len(row):
                return value, rate, acceleration
            wave, wave1, wave2 = self._impulse(t_s[row] - self.kinks_s[event], event)
            direction = self._direction[event]
            value[row] += wave[:, None] * direction
            rate[row] += wave1[:, None] * direction
            acceleration[row] += wave2[:, None] * direction
            event = event - 1

    def _impulse(self, since_s: Array, event: NDArray[np.intp]) -> tuple[Array, Array, Array]:
        """(q e^(1-q))³ sin(w t + phase) with q = t / rise, and its two derivatives."""
        rise, omega = self._rise[event], self._omega[event]
        q = since_s / rise
        decay = np.exp(3 - 3 * q)
        envelope = q**3 * decay
        envelope1 = 3 * q**2 * (1 - q) * decay / rise
        envelope2 = 3 * q * (2 - 6 * q + 3 * q**2) * decay / rise**2
        sine, cosine = np.sin(omega * since_s + self._phase[event]), np.cos(omega * since_s + self._phase[event])
        first = envelope1 * sine + envelope * omega * cosine
        second = envelope2 * sine + 2 * envelope1 * omega * cosine - envelope * omega**2 * sine
        return envelope * sine, first, second


def make_vibration(kind: str, level: int, duration_s: float, seed: int, contacts: Contacts | None = None) -> Vibration:
    """The vibration of one recording; level 0 and kind "none" are still. Only collisions listen to contacts."""
    if level == 0 or kind == "none":
        return NoVibration()
    rng = np.random.default_rng([seed, 2, KINDS.index(kind)])
    if kind == "gaussian":
        return GaussianVibration(level, duration_s, rng)
    if kind == "peristalsis":
        return PeristalticVibration(level, rng)
    return CollisionVibration(level, duration_s, rng, contacts)


def _unit_rows(v: Array) -> Array:
    out: Array = v / np.linalg.norm(v, axis=1, keepdims=True)
    return out
