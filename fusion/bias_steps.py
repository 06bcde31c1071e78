"""Steps of the IMU's biases in one stretch: when, how large and how surely.

A sensor that was knocked or restarted goes on with another bias. A model whose biases hardly wander spreads that over
the whole recording; one whose biases wander everywhere loses what the IMU knows. So its biases may first wander so much
everywhere in the stretch that the change is nothing unusual; near where they then change most, letting them go over two
frames is tried place by place. A step is believed when the stretch costs clearly less with it even so, and when with
the steps found the biases keep to the noise card everywhere else, the inertial chi² is what it should be and the
motions agree: a body that moves unseen, or a sensor that warms up, does not come to that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.problem import Problem
from fusion.result import BiasStep
from fusion.stretch_alone import STRAINED, Solved, StretchAlone, bias_walked, changes_over

Array = NDArray[np.float64]

JUMP_SD = np.array([0.5, 0.05])
"""Change of accelerometer [m/s²] and gyro bias [rad/s] per interval where they are let go: any that occurs."""
MOST_STEPS = 3
"""In one stretch; a sensor that steps more often drifts."""
LEAST_GAIN = 40.0
"""By how much twice the cost must fall for a step: in one of 1400 strained stretches of 1500 frames, chance makes as
much (6 degrees of freedom, Bonferroni)."""
LOOSENED = (1.0, 4.0, 16.0)
"""How many strains the biases may wander at first: what a stretch makes of a step that it cannot follow says little."""
LET_GO, WIDEST = 2, 6
"""Links between frames over which the biases are let go at least; how many more on either side at most."""
CALM_STRAIN = 2.5
"""Beside steps, at most, where a slow change is no other explanation: cut at a step, it leaves 3."""
AS_GOOD = 10.0
"""Cost beyond the least at which the step may lie elsewhere as well."""


@dataclass(frozen=True)
class Stepped:
    """What steps make of a stretch."""

    steps: tuple[BiasStep, ...]
    """None where it needs no explaining."""
    sure: bool
    """Whether every step has its place, and beside them the biases are as calm as sound ones."""


def steps_of(alone: StretchAlone, problem: Problem) -> Stepped | None:
    """The steps that explain a stretch; None where steps do not."""
    jumps = np.zeros((len(alone.steps), 2))
    windows: list[tuple[int, int]] = []
    here = alone.solved(jumps)
    while not here.agrees or here.strain.max() > STRAINED:
        if len(windows) == MOST_STEPS:
            return None
        strain = np.maximum(here.sensor_strain, 1.0)
        for more in (strain * factor for factor in LOOSENED):
            slack = np.hypot(jumps, alone.slack(more))
            wandering = alone.solved(slack)
            if wandering.agrees:
                break
        else:
            return None
        window, cost = _placed(alone, slack, wandering)
        if 2 * (wandering.cost - cost) < LEAST_GAIN:
            return None
        windows.append(window)
        jumps[slice(*window)] = JUMP_SD
        here = alone.solved(jumps)
    placed = all(last - first < LET_GO + 2 * WIDEST for first, last in windows)
    return Stepped(tuple(_concluded(alone, problem, here, window) for window in sorted(windows)),
                   not windows or (placed and bool(here.strain.max() <= CALM_STRAIN)))


def _placed(alone: StretchAlone, slack: Array, wandering: Solved) -> tuple[tuple[int, int], float]:
    """The links (first, last + 1) over which a step explains most, and what the stretch then costs.

    Biases are let go over two links at a time, because an interval in which the step lies has a bias of its own; in the
    end over as many as it may lie in.
    """
    known: dict[int, float] = {}

    def cost(link: int) -> float:
        if not 0 <= link <= len(slack) - LET_GO:
            return np.inf
        if link not in known:
            also = slack.copy()
            also[link:link + LET_GO] = np.hypot(also[link:link + LET_GO], JUMP_SD)
            known[link] = alone.tried(also, wandering.solution.values).cost
        return known[link]

    walked = bias_walked(wandering.solution.values) / wandering.model.steps.bias_walk_sd
    _, link, length = max((float(changes.max()), int(np.argmax(changes.max(axis=1))), n)
                          for n, changes in changes_over(walked))
    apart = max(1, length // 4)
    best = min(range(link - length // 2, link + length + length // 2 + 1, apart), key=cost)
    while apart > 1 or min(cost(best - 1), cost(best + 1)) < cost(best):
        apart = max(1, apart // 2)
        best = min((best - apart, best, best + apart), key=cost)
    first = last = best
    while best - first < WIDEST and cost(first - 1) < cost(best) + AS_GOOD:
        first -= 1
    while last - best < WIDEST and cost(last + 1) < cost(best) + AS_GOOD:
        last += 1
    return (first, last + LET_GO), cost(best)


def _concluded(alone: StretchAlone, problem: Problem, done: Solved, window: tuple[int, int]) -> BiasStep:
    size, sd = alone.step_over(done, *window)
    first, last = (alone.first + node for node in window)
    sizes = [tuple(map(float, part)) for part in (size[3:], sd[3:], size[:3], sd[:3])]
    return BiasStep(first, last, float(problem.t_s[first + 1]), float(problem.t_s[last]), *sizes)
