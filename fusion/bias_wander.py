"""Biases that wander, all along a stretch, by more than the noise card says: a sensor that warms up.

Where they are held to the noise card, such biases change by many times what it allows, and the inertial data disagree;
where they may wander as much as they do, everything agrees. A body that moves unseen is the contrary: its biases stay
within their random walk, for no slow change explains it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.problem import Problem
from fusion.stretch_alone import STRAINED, StretchAlone

Array = NDArray[np.float64]

ROUNDS = 5
"""Solutions, in each of which strained biases may wander more by half their strain: held, they do not show it all."""


@dataclass(frozen=True)
class BiasWander:
    """A stretch in which the biases wander more than the noise card says."""

    first: int
    """Node it begins at …"""
    last: int
    """… and ends at."""
    accel: float
    """How many times as much the accelerometer's bias wanders; 1 = as the noise card says."""
    gyro: float

    def slack(self, problem: Problem) -> Array:
        """(last - first, 2) of the intervals in it (`Problem.bias_slack`)."""
        walk = np.array([problem.noise.accel_walk_m_s3_rthz, problem.noise.gyro_walk_rad_s2_rthz])
        beyond = walk * np.sqrt(np.array([self.accel, self.gyro]) ** 2 - 1)
        return np.asarray(np.sqrt(problem.dt_s[self.first:self.last, None]) * beyond)

    def in_words(self, first_frame: int, last_node: int) -> str:
        """Where and how much, in frames of a recording whose nodes 0 to `last_node` are its frames from one on."""
        sensors = [(name, more) for name, more in (("accelerometer", self.accel), ("gyro", self.gyro)) if more > 1]
        which = " and ".join(f"the {name}'s" for name, _ in sensors)
        times = " and ".join(f"{more:.0f}" for _, more in sensors)
        what = "bias wanders" if len(sensors) == 1 else "biases wander"
        why = "another sensor's card?" if (self.first, self.last) == (0, last_node) else "a sensor that warms up?"
        return (f"frames {first_frame + self.first} to {first_frame + self.last}: {which} {what} up to {times} times "
                f"as much as the noise card says ({why})")


def joined(wanders: Sequence[BiasWander]) -> list[BiasWander]:
    """Stretches (in order) that follow each other as one that wanders as much as the worst of them."""
    out: list[BiasWander] = []
    for wander in wanders:
        if out and out[-1].last == wander.first:
            old = out.pop()
            wander = BiasWander(old.first, wander.last, max(old.accel, wander.accel), max(old.gyro, wander.gyro))
        out.append(wander)
    return out


def wander_of(alone: StretchAlone) -> tuple[float, float] | None:
    """How many times as much accelerometer and gyro bias wander in a stretch; None where that does not explain it."""
    more = np.ones(2)
    for _ in range(ROUNDS):
        here = alone.solved(alone.slack(more))
        strain = here.sensor_strain
        if strain.max() <= STRAINED:
            return (float(more[0]), float(more[1])) if here.agrees and more.max() > 1 else None
        more = np.where(strain > STRAINED, more * strain / 2, more)
    return None
