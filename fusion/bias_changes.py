"""Where the IMU's biases change by more than their random walk: letting them do so there and nowhere else.

A stretch whose inertial data disagree, or whose biases change by more than their random walk allows, is looked at
alone. Steps of the biases explain it, or biases that wander more all along it, or nothing. In a recording of a single
stretch nothing else tells how much is wandering, and the scale policy judges.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from fusion.bias_steps import JUMP_SD, Stepped, steps_of
from fusion.bias_wander import slack_of, wander_of
from fusion.chain_start import followed_start
from fusion.chain_state import ChainState
from fusion.config import RefineConfig
from fusion.engine import Begin
from fusion.problem import Problem
from fusion.result import BiasStep, BiasWander
from fusion.scale import CALM_CHI2, Segments
from fusion.stretch_alone import STRAINED, StretchAlone, bias_walked, strain_of
from fusion.stretches import Stretch
from vio.errors import EstimationError

OVER_OTHERS = 1.5
"""Inertial chi² of a stretch over the median of all at which it is looked at; alone, `CALM_CHI2` decides."""
MOST_UNEXPLAINED = 3
"""Stretches that nothing explains, after which the recording as a whole is at fault and no more is looked for."""


@dataclass(frozen=True)
class BiasChanges:
    """Where the biases change by more than their random walk."""

    steps: tuple[BiasStep, ...] = ()
    wanders: tuple[BiasWander, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.steps or self.wanders)

    def let_go(self, problem: Problem) -> Problem:
        """The problem with its biases free to change there."""
        if not self:
            return problem
        slack = np.zeros((len(problem) - 1, 2))
        for wander in self.wanders:
            slack[wander.first_frame:wander.last_frame] = slack_of(wander, problem)
        for step in self.steps:
            slack[step.first_frame:step.last_frame] = JUMP_SD
        return replace(problem, bias_slack=slack)

    @property
    def told_wanders(self) -> tuple[BiasWander, ...]:
        """Stretches that follow each other as one that wanders as much as the worst of them."""
        out: list[BiasWander] = []
        for wander in self.wanders:
            if out and out[-1].last_frame == wander.first_frame:
                old = out.pop()
                wander = replace(wander, first_frame=old.first_frame, start_s=old.start_s,
                                 accel_times=max(old.accel_times, wander.accel_times),
                                 gyro_times=max(old.gyro_times, wander.gyro_times))
            out.append(wander)
        return tuple(out)


def find_bias_changes(problem: Problem, config: RefineConfig, segments: Segments, start: Begin,
                      suspects: Sequence[Stretch]) -> BiasChanges:
    """What explains some stretches of a start.

    Args:
        problem: the checked problem.
        config: of the refinement.
        segments: of the log scales.
        start: of a chain.
        suspects: stretches to look at.
    """
    steps: list[BiasStep] = []
    wanders: list[BiasWander] = []
    unexplained = 0
    for stretch in suspects:
        explained = _explained(problem, config, segments, start, stretch)
        if explained is None:
            unexplained += 1
        elif isinstance(explained, BiasWander):
            wanders.append(explained)
        else:
            steps += [step for step in explained.steps if all(step.first_frame > old.last_frame for old in steps)]
        if unexplained > MOST_UNEXPLAINED:
            break
    return BiasChanges(tuple(steps), tuple(wanders))


def _explained(problem: Problem, config: RefineConfig, segments: Segments, start: Begin,
               stretch: Stretch) -> Stepped | BiasWander | None:
    """Steps, or biases that wander where steps are not sure to explain the stretch; None where neither does."""
    first, last = stretch.first, min(stretch.last + config.solver.overlap_frames, len(problem) - 1)
    steps = start.model.steps

    def alone(state: ChainState) -> StretchAlone:
        return StretchAlone(problem, config, segments, steps, state, first, last)

    stepped: Stepped | None = None
    wander: BiasWander | None = None
    with suppress(EstimationError):  # nothing is believed of what cannot be solved
        stepped = steps_of(alone(start.values.part(first, last + 1)), problem)
    if len(start.stretches) == 1 or (stepped is not None and stepped.sure):
        return stepped
    with suppress(EstimationError):
        wander = wander_of(alone(followed_start(problem, config, steps.part(first, last), first)), problem, stretch)
    return wander or stepped


def suspect_stretches(start: Begin) -> list[Stretch]:
    """Stretches of a chain's start whose inertial data disagree, or whose biases strain."""
    chi2 = [stretch.imu_chi2 for stretch in start.stretches]
    limit = CALM_CHI2 if len(chi2) == 1 else max(CALM_CHI2, OVER_OTHERS * float(np.median(chi2)))
    walked = bias_walked(start.values) / start.model.steps.bias_walk_sd
    return [stretch for stretch in start.stretches
            if stretch.imu_chi2 > limit or strain_of(walked[stretch.first:stretch.last - 1]).max() > STRAINED]
