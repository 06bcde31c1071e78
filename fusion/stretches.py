"""Stretches of a recording whose inertial data contradict everything else, and what is left of them.

One bad stretch must not cost the whole examination its inertial data: in that stretch alone the accelerometer is
reduced to the direction of gravity, and where that does not help, the IMU is left out and the motions carry on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.problem import Problem
from fusion.scale import GRAVITY_ONLY

CONTRADICTED_CHI2 = 2.0
"""Inertial chi² per degree of freedom (clean value about 0.5) of a stretch that cannot be right …"""
CONTRADICTED_RATIO = 5.0
"""… when it is also this many times what the recording's other stretches have in the median."""
LARGEST_SHARE = 1 / 3
"""Share of stretches beyond which the recording as a whole is at fault, and its policy must judge."""


@dataclass(frozen=True)
class Stretch:
    """One chunk of the start: frames `first` to `last`, and how well its inertial data agree."""

    first: int
    last: int
    imu_chi2: float
    """Infinite where the stretch could not be solved."""
    reason: str | None = None
    """Why it could not."""


def contradicted(stretches: Sequence[Stretch]) -> list[Stretch]:
    """The stretches that stand out; none where they are not a minority."""
    chi2 = np.array([stretch.imu_chi2 for stretch in stretches])
    limit = max(CONTRADICTED_CHI2, CONTRADICTED_RATIO * float(np.median(chi2))) if len(chi2) else np.inf
    bad = [stretch for stretch in stretches if not stretch.imu_chi2 <= limit]
    return bad if len(bad) <= LARGEST_SHARE * len(stretches) else []


def demoted(problem: Problem, bad: Sequence[Stretch], without_imu: bool) -> tuple[Problem, list[str]]:
    """The problem with the IMU trusted less in some stretches, and a sentence for each.

    Args:
        problem: the problem.
        bad: stretches to demote.
        without_imu: leave their IMU out; otherwise only its accelerometer is reduced to gravity.
    """
    usable, inflation, words = problem.imu_usable.copy(), problem.accel_inflation.copy(), []
    for stretch in bad:
        cut = slice(stretch.first, stretch.last)
        if without_imu:
            usable[cut] = False
            what = "the IMU is left out"
        else:
            inflation[cut] *= GRAVITY_ONLY
            what = "the accelerometer serves for the direction of gravity only"
        why = stretch.reason or f"inertial chi² {stretch.imu_chi2:.1f} per dof"
        words.append(f"frames {problem.first_frame + stretch.first} to {problem.first_frame + stretch.last}: {what} "
                     f"({why})")
    return replace(problem, imu_usable=usable, accel_inflation=inflation), words
