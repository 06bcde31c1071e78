"""One stretch of a recording looked at alone, with free scale: what it costs where its biases may change more.

Biases that strain change by more than their random walk allows, over whatever time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.chain import BIAS
from fusion.chain_model import LONGEST_REACH, ChainModel, ScaleWalk
from fusion.chain_solve import chain_gauss_newton
from fusion.chain_state import ChainState
from fusion.config import RefineConfig
from fusion.graph import first_anchor
from fusion.inertial import InertialSteps
from fusion.problem import Problem
from fusion.scale import CALM_CHI2, PLAUSIBLE_REJECTED, PLAUSIBLE_SDS, Segments, imu_chi2
from fusion.scaled_motion import ScaledMotions
from fusion.solve import MotionTerm, Solution

Array = NDArray[np.float64]

STRAINED = 4.0
"""Change of a bias over what its random walk allows, at which a stretch is looked at; sound ones stay below 2."""
ITERATIONS, TOLERANCE = 12, 1e-4
TRIAL_ITERATIONS, TRIAL_TOLERANCE = 2, 1e-3
"""Of windows that are compared: one without the step is worse by far before it is solved."""


@dataclass(frozen=True)
class Solved:
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
    def sensor_strain(self) -> Array:
        """(2,) of the accelerometer's bias and the gyro's, along the worst axis."""
        return np.asarray(self.strain.reshape(2, 3).max(axis=1))

    @property
    def agrees(self) -> bool:
        """Whether inertial data and motions agree, so that an unseen motion of the body has not moved the scale."""
        return self.chi2 <= CALM_CHI2 and self.beyond_gate <= PLAUSIBLE_REJECTED


class StretchAlone:
    """One stretch of a problem with scales of its own, solved with biases that may change more here or there."""

    def __init__(self, problem: Problem, config: RefineConfig, segments: Segments, steps: InertialSteps,
                 state: ChainState, first: int, last: int) -> None:
        """`state` holds the frames `first` to `last`, where the solution begins."""
        self.first, self.usable = first, int(problem.imu_usable[first:last].sum())
        self.steps, m = steps.part(first, last), problem.motions
        inside = (m.i >= first) & (m.j <= last) & (m.j - m.i <= LONGEST_REACH)
        motions = m.select(inside, first_node=first)
        self.scale = None if config.scale.policy == "fixed" or problem.scale_log_sd == 0 else \
            _scales(problem, segments, config.scale.walk_per_sqrt_s, first, last)
        self.start = replace(state, log_scale=np.zeros(0))
        if self.scale is not None:
            self.start = replace(self.start, log_scale=np.full(len(self.scale.step_sd) + 1, self.scale.log_mean))
        T = self.start.T_world_body[0]
        self.anchor = replace(first_anchor(T, problem.gyro_bias_rad_s, config.initial), velocity_m_s=self.start.v[0])
        self.gate = config.robust.gate
        self.term = _term(motions, self.scale, problem.scale_log_mean, config.robust.huber)

    def solved(self, slack: Array, start: ChainState | None = None) -> Solved:
        """The stretch whose biases may change by a slack (K, 2) beyond their random walk (`Problem.bias_slack`)."""
        return self._solved(self.steps.loosened(slack), start or self.start, ITERATIONS, TOLERANCE)

    def tried(self, slack: Array, start: ChainState) -> Solved:
        """The same, roughly, from a start that is close."""
        return self._solved(self.steps.loosened(slack), start, TRIAL_ITERATIONS, TRIAL_TOLERANCE)

    def slack(self, more: Array) -> Array:
        """(K, 2) with which accelerometer and gyro bias wander (2,) times as much as the noise card says."""
        return np.asarray(self.steps.bias_walk_sd[:, ::3] * np.sqrt(more**2 - 1))

    def _solved(self, steps: InertialSteps, start: ChainState, iterations: int, tolerance: float) -> Solved:
        model = ChainModel(steps, self.anchor, self.scale)
        found = chain_gauss_newton(model, start, self.term, iterations, tolerance)
        cost = found.native_cost + self.term.losses(found.squared_norm)[0]
        return Solved(model, found, cost, imu_chi2(found.native_cost, self.usable),
                       strain_of(bias_walked(found.values) / steps.bias_walk_sd),
                       float(np.mean(found.squared_norm > self.gate)))

    def is_plausible(self, done: Solved) -> bool:
        """Whether scale stayed where its prior lets it be."""
        if self.scale is None:
            return True
        moved = float(done.solution.values.log_scale.mean()) - self.scale.log_mean
        return abs(moved) <= PLAUSIBLE_SDS * self.scale.log_sd

    def step_over(self, done: Solved, first: int, last: int) -> tuple[Array, Array]:
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


def bias_walked(state: ChainState) -> Array:
    """(M-1, 6) change of accelerometer and gyro bias from frame to frame."""
    return np.diff(np.concatenate([state.accel_bias, state.gyro_bias], axis=1), axis=0)


def strain_of(walked: Array) -> Array:
    """(6,) the largest change of every bias over any time, in units of what its random walk allows: (K, 6) such."""
    highest = [changes.max(axis=0) for _, changes in changes_over(walked)]
    return np.asarray(np.max(highest or [np.zeros(6)], axis=0))


def changes_over(walked: Array) -> Iterator[tuple[int, Array]]:
    """Changes (K + 1 - n, 6) over n links, of the order of 1 for a random walk of such links, for n = 4, 8, 16 …"""
    total = np.concatenate([np.zeros((1, 6)), np.cumsum(walked, axis=0)])
    for n in 2 ** np.arange(2, 2 + len(total).bit_length()):
        if n < len(total):
            yield int(n), np.abs(total[n:] - total[:-n]) / np.sqrt(n)
