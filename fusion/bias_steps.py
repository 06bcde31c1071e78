"""Steps of the IMU's biases: when, how large and how surely; and letting the biases go there and nowhere else.

A sensor that was knocked or restarted goes on with another bias. A model whose biases hardly wander spreads that over
the whole recording; one whose biases wander everywhere loses what the IMU knows. So a stretch whose inertial data
disagree, or whose biases change by more than their random walk allows, is looked at alone, with free scale. Its biases
may first wander so much everywhere that the change is nothing unusual; near where they then change most, letting them
go over two frames is tried place by place. A step is believed when the stretch costs clearly less with it even so, and
when with the steps found the biases keep to the noise card everywhere else, the inertial chi² is what it should be and
the motions agree: a body that moves unseen, or a sensor that warms up, does not come to that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.chain import BIAS
from fusion.chain_model import LONGEST_REACH, ChainModel, ScaleWalk
from fusion.chain_solve import chain_gauss_newton
from fusion.chain_state import ChainState
from fusion.config import RefineConfig
from fusion.engine import Begin
from fusion.graph import first_anchor
from fusion.inertial import InertialSteps
from fusion.problem import Problem
from fusion.result import BiasStep
from fusion.scale import CALM_CHI2, PLAUSIBLE_REJECTED, Segments, imu_chi2
from fusion.scaled_motion import ScaledMotions
from fusion.solve import MotionTerm, Solution
from fusion.stretches import Stretch
from vio.errors import EstimationError

Array = NDArray[np.float64]

OVER_OTHERS = 1.5
"""Inertial chi² of a stretch over the median of all at which it is looked at; alone, `CALM_CHI2` decides."""
MOST_STEPS = 3
"""In one stretch; a sensor that steps more often drifts."""
MOST_UNEXPLAINED = 3
"""Stretches that steps do not explain, after which the recording as a whole is at fault and no more is looked for."""
LEAST_GAIN = 40.0
"""By how much twice the cost must fall for a step: in one of 1400 strained stretches of 1500 frames, chance makes as
much (6 degrees of freedom, Bonferroni)."""
STRAINED = 4.0
"""Change of a bias over what its random walk allows, at which a stretch is looked at; sound ones stay below 2."""
LOOSENED = (1.0, 4.0, 16.0)
"""How many strains the biases may wander at first: what a stretch makes of a step that it cannot follow says little."""
LET_GO, WIDEST = 2, 6
"""Links between frames over which the biases are let go at least; how many more on either side at most."""
AS_GOOD = 10.0
"""Cost beyond the least at which the step may lie elsewhere as well."""
ITERATIONS, TOLERANCE = 12, 1e-4
TRIAL_ITERATIONS, TRIAL_TOLERANCE = 2, 1e-3
"""Of windows that are compared: one without the step is worse by far before it is solved."""


@dataclass(frozen=True)
class _Solved:
    """A stretch, solved."""

    model: ChainModel
    solution: Solution
    cost: float
    chi2: float
    strain: Array
    """(6,) of accelerometer and gyro bias."""
    beyond_gate: float
    """Share of motions that are outliers to it."""

    @property
    def agrees(self) -> bool:
        """Whether inertial data and motions agree, so that an unseen motion of the body has not moved the scale."""
        return self.chi2 <= CALM_CHI2 and self.beyond_gate <= PLAUSIBLE_REJECTED


class _StretchAlone:
    """One stretch of a problem with scales of its own, solved with biases that are let go here or there."""

    def __init__(self, problem: Problem, config: RefineConfig, segments: Segments, steps: InertialSteps,
                 state: ChainState, first: int, last: int) -> None:
        self.first, self.usable = first, int(problem.imu_usable[first:last].sum())
        self.steps, m = steps.part(first, last), problem.motions
        inside = (m.i >= first) & (m.j <= last) & (m.j - m.i <= LONGEST_REACH)
        motions = m.select(inside, first_node=first)
        self.scale = None if config.scale.policy == "fixed" or problem.scale_log_sd == 0 else \
            _scales(problem, segments, config.scale.walk_per_sqrt_s, first, last)
        self.start = replace(state.part(first, last + 1), log_scale=np.zeros(0))
        if self.scale is not None:
            self.start = replace(self.start, log_scale=np.full(len(self.scale.step_sd) + 1, self.scale.log_mean))
        T = self.start.T_world_body[0]
        self.anchor = replace(first_anchor(T, problem.gyro_bias_rad_s, config.initial), velocity_m_s=self.start.v[0])
        self.gate = config.robust.gate
        self.term = _term(motions, self.scale, problem.scale_log_mean, config.robust.huber)

    def solved(self, released: NDArray[np.bool_], more: Array | None = None) -> _Solved:
        """The stretch with biases let go over some links (K,), everywhere else wandering (6,) times as much."""
        return self._solved(self._steps(released, more), self.start, ITERATIONS, TOLERANCE)

    def let_go(self, released: NDArray[np.bool_], first: int, last: int, more: Array, start: ChainState) -> _Solved:
        """Roughly, with biases let go over the links `first` to `last` (exclusive) too."""
        also = released.copy()
        also[first:last] = True
        return self._solved(self._steps(also, more), start, TRIAL_ITERATIONS, TRIAL_TOLERANCE)

    def _steps(self, released: NDArray[np.bool_], more: Array | None) -> InertialSteps:
        steps = self.steps if more is None else replace(self.steps, bias_walk_sd=self.steps.bias_walk_sd * more)
        return steps.released(released)

    def _solved(self, steps: InertialSteps, start: ChainState, iterations: int, tolerance: float) -> _Solved:
        model = ChainModel(steps, self.anchor, self.scale)
        found = chain_gauss_newton(model, start, self.term, iterations, tolerance)
        cost = found.native_cost + self.term.losses(found.squared_norm)[0]
        return _Solved(model, found, cost, imu_chi2(found.native_cost, self.usable),
                       _strain(_walked(found.values) / steps.bias_walk_sd),
                       float(np.mean(found.squared_norm > self.gate)))

    def step_over(self, done: _Solved, first: int, last: int) -> tuple[Array, Array]:
        """Change (6,) of accelerometer and gyro bias from frame `first` to `last` of the stretch, and its sd."""
        state = done.solution.values
        biases = np.concatenate([state.accel_bias, state.gyro_bias], axis=1)
        system = done.model.linearize(state, self.term)
        right = np.zeros((system.blocks * system.reach, BIAS.stop, 6))
        right[last, BIAS], right[first, BIAS] = np.eye(6), -np.eye(6)
        x = system.factor().solve_columns(right)[:, BIAS]
        return biases[last] - biases[first], np.sqrt(np.diagonal(x[last] - x[first]))


def _scales(problem: Problem, segments: Segments, walk_per_sqrt_s: float, first: int, last: int) -> ScaleWalk:
    """Log scales of a stretch, whose first one may have walked away from the recording's prior."""
    of_node = segments.of_node[first:last + 1]
    step_sd = walk_per_sqrt_s * np.sqrt(np.diff(segments.t_s[of_node[0]:of_node[-1] + 1]))
    walked = walk_per_sqrt_s * np.sqrt(problem.t_s[first] - problem.t_s[0])
    return ScaleWalk(of_node - of_node[0], problem.scale_log_mean, float(np.hypot(problem.scale_log_sd, walked)),
                     step_sd)


def _term(motions: ScaledMotions, scale: ScaleWalk | None, log_scale: float, huber: float) -> MotionTerm:
    return MotionTerm(motions, None if scale is None else scale.of_node[motions.i], log_scale, huber,
                      np.ones(len(motions)))


def find_bias_steps(problem: Problem, config: RefineConfig, segments: Segments, start: Begin,
                    suspects: Sequence[Stretch]) -> tuple[BiasStep, ...]:
    """Steps of the biases in some stretches of a start.

    Args:
        problem: the checked problem.
        config: of the refinement.
        segments: of the log scales.
        start: of a chain.
        suspects: stretches to look at.
    """
    found: list[BiasStep] = []
    unexplained = 0
    for stretch in suspects:
        last = min(stretch.last + config.solver.overlap_frames, len(problem) - 1)
        alone = _StretchAlone(problem, config, segments, start.model.steps, start.values, stretch.first, last)
        try:
            steps = _steps_of(alone, problem)
        except EstimationError:  # nothing is believed of a stretch that cannot be solved
            steps = None
        unexplained += steps is None
        if unexplained > MOST_UNEXPLAINED:
            break
        found += [step for step in steps or [] if all(step.first_frame > old.last_frame for old in found)]
    return tuple(found)


def suspect_stretches(start: Begin) -> list[Stretch]:
    """Stretches of a chain's start whose inertial data disagree, or whose biases strain."""
    chi2 = [stretch.imu_chi2 for stretch in start.stretches]
    limit = CALM_CHI2 if len(chi2) == 1 else max(CALM_CHI2, OVER_OTHERS * float(np.median(chi2)))
    walked = _walked(start.values) / start.model.steps.bias_walk_sd
    return [stretch for stretch in start.stretches
            if stretch.imu_chi2 > limit or _strain(walked[stretch.first:stretch.last - 1]).max() > STRAINED]


def _walked(state: ChainState) -> Array:
    """(M-1, 6) change of accelerometer and gyro bias from frame to frame."""
    return np.diff(np.concatenate([state.accel_bias, state.gyro_bias], axis=1), axis=0)


def _strain(walked: Array) -> Array:
    """(6,) the largest change of every bias over any time, in units of what its random walk allows: (K, 6) such."""
    highest = [changes.max(axis=0) for _, changes in _changes(walked)]
    return np.asarray(np.max(highest or [np.zeros(6)], axis=0))


def _changes(walked: Array) -> Iterator[tuple[int, Array]]:
    """Changes (K + 1 - n, 6) over n links, of the order of 1 for a random walk of such links, for n = 4, 8, 16 …"""
    total = np.concatenate([np.zeros((1, 6)), np.cumsum(walked, axis=0)])
    for n in 2 ** np.arange(2, 2 + len(total).bit_length()):
        if n < len(total):
            yield int(n), np.abs(total[n:] - total[:-n]) / np.sqrt(n)


def _steps_of(alone: _StretchAlone, problem: Problem) -> list[BiasStep] | None:
    """The steps that explain a stretch, none where it needs no explaining; None where steps do not explain it."""
    released = np.zeros(len(alone.steps), bool)
    windows: list[tuple[int, int]] = []
    here = alone.solved(released)
    while not here.agrees or here.strain.max() > STRAINED:
        if len(windows) == MOST_STEPS:
            return None
        strain = np.repeat(np.maximum(here.strain.reshape(2, 3).max(axis=1), 1.0), 3)
        for more in (strain * factor for factor in LOOSENED):
            wandering = alone.solved(released, more)
            if wandering.agrees:
                break
        else:
            return None
        window, cost = _placed(alone, released, more, wandering)
        if 2 * (wandering.cost - cost) < LEAST_GAIN:
            return None
        windows.append(window)
        released[slice(*window)] = True
        here = alone.solved(released)
    return [_concluded(alone, problem, here, window) for window in sorted(windows)]


def _placed(alone: _StretchAlone, released: NDArray[np.bool_], more: Array,
            wandering: _Solved) -> tuple[tuple[int, int], float]:
    """The links (first, last + 1) over which a step explains most, and what the stretch then costs.

    Biases are let go over two links at a time, because an interval in which the step lies has a bias of its own; in the
    end over as many as it may lie in.
    """
    known: dict[int, float] = {}

    def cost(link: int) -> float:
        if not 0 <= link <= len(released) - LET_GO:
            return np.inf
        if link not in known:
            known[link] = alone.let_go(released, link, link + LET_GO, more, wandering.solution.values).cost
        return known[link]

    walked = _walked(wandering.solution.values) / wandering.model.steps.bias_walk_sd
    _, link, length = max((float(changes.max()), int(np.argmax(changes.max(axis=1))), n)
                               for n, changes in _changes(walked))
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


def _concluded(alone: _StretchAlone, problem: Problem, done: _Solved, window: tuple[int, int]) -> BiasStep:
    size, sd = alone.step_over(done, *window)
    first, last = (alone.first + node for node in window)
    sizes = [tuple(map(float, part)) for part in (size[3:], sd[3:], size[:3], sd[:3])]
    return BiasStep(first, last, float(problem.t_s[first + 1]), float(problem.t_s[last]), *sizes)


def with_released(problem: Problem, steps: Sequence[BiasStep]) -> Problem:
    """The problem with its biases let go at the steps."""
    if not steps:
        return problem
    released = np.zeros(len(problem) - 1, bool)
    for step in steps:
        released[step.first_frame:step.last_frame] = True
    return replace(problem, bias_released=released)
