"""Biases that wander, all along a stretch, by more than the noise card says: a sensor that warms up.

Where they are held to the noise card, such biases change by many times what it allows, and the inertial data disagree;
where they may wander as much as they do, everything agrees. A body that moves unseen is the contrary: its biases stay
within their random walk, for no slow change explains it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.problem import Problem
from fusion.result import BiasWander
from fusion.stretch_alone import STRAINED, StretchAlone
from fusion.stretches import Stretch

Array = NDArray[np.float64]

ROUNDS = 8
"""Solutions, after each of which one sensor's bias may wander more by half its strain: held, it does not show it all.
The gyro's comes first. The motions measure it, so that it cannot stand in for the accelerometer's; the other way round
a loose accelerometer hides that the gyro's bias wanders."""
MOST_TIMES = 1000.0
"""As much as the biases may wander at most: what needs more is no sensor's bias."""
ACCEL, GYRO = 0, 1
AT_FIRST = np.array([100.0, 1000.0])
"""How many times as much the biases may wander in the solution near which all others are looked for."""


def slack_of(wander: BiasWander, problem: Problem) -> Array:
    """(K, 2) of the K intervals in it (`Problem.bias_slack`)."""
    walk = np.array([problem.noise.accel_walk_m_s3_rthz, problem.noise.gyro_walk_rad_s2_rthz])
    beyond = walk * np.sqrt(np.array([wander.accel_times, wander.gyro_times]) ** 2 - 1)
    return np.asarray(np.sqrt(problem.dt_s[wander.first_frame:wander.last_frame, None]) * beyond)


def wander_of(alone: StretchAlone, problem: Problem, stretch: Stretch) -> BiasWander | None:
    """How much the biases wander in a stretch; None where that does not explain it."""
    more, near = np.ones(2), alone.solved(alone.slack(AT_FIRST)).solution.values
    for _ in range(ROUNDS):
        here = alone.solved(alone.slack(more), near)
        strain = here.sensor_strain
        if strain.max() <= STRAINED:
            found = here.agrees and alone.is_plausible(here) and more.max() > 1
            start_s, end_s = (float(problem.t_s[node]) for node in (stretch.first, stretch.last))
            return BiasWander(stretch.first, stretch.last, start_s, end_s, *map(float, more)) if found else None
        sensor = GYRO if strain[GYRO] > STRAINED else ACCEL
        more[sensor] = min(more[sensor] * strain[sensor] / 2, MOST_TIMES)
    return None
