"""A capsule that halts: its own time stands still for a while, and so do its course and its vibration.

With u(t) the capsule's own time, a course x(u) becomes x(u(t)); its derivatives follow by the chain rule. The clock
slows down within half a second before a halt and speeds up within half a second after it, twice continuously
differentiable: no jerk marks where a halt begins.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vio.errors import SimulationError
from vio.simulation.path import NominalPath
from vio.simulation.vibration import Vibration

Array = NDArray[np.float64]
Halts = Sequence[tuple[float, float]]

RAMP_S = 0.5


class Clock:
    """The capsule's own time u(t): as fast as time, except in halts.

    Args:
        halts: (begin, end) [s] between which nothing of the capsule moves, in order and at least 1 s apart.

    Raises:
        SimulationError: a halt that ends before it begins, or that begins before the last one is over.
    """

    def __init__(self, halts: Halts) -> None:
        self.begin_s, self.end_s = np.asarray(halts, float).reshape(-1, 2).T
        short = np.flatnonzero(~(self.end_s > self.begin_s))
        close = np.flatnonzero(~(self.begin_s[1:] - self.end_s[:-1] >= 2 * RAMP_S))
        if len(short):
            raise SimulationError(f"halts: number {short[0]} ends at {self.end_s[short[0]]} s and begins at "
                                  f"{self.begin_s[short[0]]} s; give (begin, end) in seconds")
        if len(close):
            raise SimulationError(f"halts: number {close[0] + 1} begins less than {2 * RAMP_S:g} s after the end of "
                                  "the one before; give them in order and further apart")

    def __call__(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Own time (n,) [s] at times (n,), and its first and second derivative."""
        t = np.asarray(t_s, float)
        own, rate, change = t.copy(), np.ones_like(t), np.zeros_like(t)
        for begin, end in zip(self.begin_s, self.end_s, strict=True):
            for start, sign in ((begin - RAMP_S, -1), (end, 1)):
                x = (t - start) / RAMP_S
                c = np.clip(x, 0, 1)
                own += sign * RAMP_S * (c**4 * (2.5 + c * (c - 3)) + np.maximum(x - 1, 0))
                rate += sign * c**3 * (10 + c * (6 * c - 15))
                change += sign * 30 * c**2 * (1 - c) ** 2 / RAMP_S
        return own, rate, change

    def when(self, own_s: Array) -> Array:
        """Times (k,) at which the capsule's own time is `own_s` (k,)."""
        low = np.asarray(own_s, float)
        high = low + (self.end_s - self.begin_s + RAMP_S).sum()
        for _ in range(60):
            middle = 0.5 * (low + high)
            early = self(middle)[0] < own_s
            low, high = np.where(early, middle, low), np.where(early, high, middle)
        return np.asarray(high)


class HaltingPath(NominalPath):
    """A nominal motion with halts."""

    def __init__(self, path: NominalPath, clock: Clock) -> None:
        self._path, self._clock = path, clock

    def position_m(self, t_s: Array, order: int = 0) -> Array:
        """As `NominalPath.position_m`."""
        own, rate, change = self._clock(t_s)
        if order == 0:
            return self._path.position_m(own)
        velocity = self._path.position_m(own, 1)
        if order == 1:
            return velocity * rate[:, None]
        return self._path.position_m(own, 2) * rate[:, None] ** 2 + velocity * change[:, None]

    def rotation(self, t_s: Array) -> Array:
        """As `NominalPath.rotation`."""
        return self._path.rotation(self._clock(t_s)[0])

    def body_rate(self, t_s: Array, order: int = 1) -> Array:
        """As `NominalPath.body_rate`."""
        own, rate, change = self._clock(t_s)
        turning = self._path.body_rate(own, 1)
        if order == 1:
            return turning * rate[:, None]
        return self._path.body_rate(own, 2) * rate[:, None] ** 2 + turning * change[:, None]

    def arc_m(self, t_s: Array) -> Array:
        """As `NominalPath.arc_m`."""
        return self._path.arc_m(self._clock(t_s)[0])


class HaltingVibration:
    """A vibration that halts with the capsule."""

    def __init__(self, vibration: Vibration, clock: Clock) -> None:
        self._vibration, self._clock = vibration, clock
        self.kinks_s: Array = clock.when(vibration.kinks_s)

    def __call__(self, t_s: Array) -> tuple[Array, Array, Array]:
        """See `Vibration`."""
        own, rate, change = (x[:, None] for x in self._clock(t_s))
        value, first, second = self._vibration(own[:, 0])
        return value, first * rate, second * rate**2 + first * change
