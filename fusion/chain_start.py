"""A start for a chain of frames: overlapping chunks at a fixed scale, each begun from the gyro's rotations.

Chaining a whole examination lets the tilt drift until Gauss-Newton diverges; chunks do not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion.chain_model import ChainModel
from fusion.chain_solve import chain_gauss_newton
from fusion.chain_state import ChainState
from fusion.config import RefineConfig
from fusion.graph import (
    BLIND_GYRO_RAD_S,
    BLIND_SPEED_M_S,
    GAP_VELOCITY_SD_M_S_RTS,
    Anchor,
    gyro_covers,
)
from fusion.inertial import InertialSteps, preintegrate_steps
from fusion.initialization import (
    CARRIED_BIAS_SD,
    CARRIED_POSE_SD,
    CARRIED_VELOCITY_SD,
    CHUNK_ITERATIONS,
    chunk_spans,
    first_guess,
)
from fusion.preintegration import make_bias
from fusion.problem import Problem
from fusion.scale import imu_chi2
from fusion.solve import MotionTerm
from fusion.stretches import Stretch
from vio.errors import EstimationError

Array = NDArray[np.float64]

CHUNK_TOLERANCE = 3e-2
"""What a chunk leaves, the whole recording's own iterations remove."""
UNKNOWN = 1e-12
"""Whitening of what a gap says nothing about."""


def inertial_steps(problem: Problem, accel_inflation: float = 1.0) -> InertialSteps:
    """The inertial steps of a problem; where a gap makes one unusable, only loose links.

    Args:
        problem: the checked problem.
        accel_inflation: additional factor on the accelerometer density everywhere.
    """
    steps = preintegrate_steps(problem.pieces, problem.noise, problem.gyro_bias_rad_s,
                               problem.accel_inflation * accel_inflation, problem.gyro_inflation)
    gap = np.flatnonzero(~problem.imu_usable)
    spanned = np.zeros(len(problem) + 1, np.int64)
    np.add.at(spanned, problem.motions.i, 1)
    np.add.at(spanned, problem.motions.j, -1)
    measured = np.cumsum(spanned)[:-2] > 0
    for k in gap:
        dt, carried = steps.dt_s[k], not measured[k] and gyro_covers(problem, int(k))
        if not carried:
            steps.R[k] = np.eye(3)
        for values in (steps.v, steps.p, steps.R_bg, steps.v_bg, steps.v_ba, steps.p_bg, steps.p_ba):
            values[k] = 0.0
        turn_sd = min(BLIND_GYRO_RAD_S * dt, np.pi) if carried else np.pi
        pose = [UNKNOWN] * 2 if measured[k] else [1 / turn_sd, 1 / (BLIND_SPEED_M_S * dt)]
        steps.whiten[k] = np.diag(np.repeat([pose[0], 1 / (GAP_VELOCITY_SD_M_S_RTS * np.sqrt(dt)), pose[1]], 3))
        steps.free_fall[k] = 0.0
    return steps if problem.bias_slack is None else steps.loosened(problem.bias_slack)


def chain_start(problem: Problem, config: RefineConfig, log_scale: float,
                steps: InertialSteps) -> tuple[ChainState, Anchor, list[Stretch]]:
    """Solve chunk after chunk at one log scale, carrying pose, velocity and bias to the next.

    A chunk that cannot be solved goes on with its first guess, and its stretch says so.

    Returns:
        First values of all frames, the prior on the first, and how every chunk fared.

    Raises:
        EstimationError: no chunk could be solved.
    """
    parts: list[ChainState] = []
    stretches: list[Stretch] = []
    anchors: list[Anchor] = []
    before: Anchor | None = None
    memory = None
    for k0, keep, k1 in chunk_spans(len(problem) - 1, config.solver):
        model, guess, term = _chunk(problem, config, log_scale, steps.part(k0, k1), k0, before)
        anchors.append(model.anchor)
        memory = model.system(term, memory)
        try:
            solution = chain_gauss_newton(model, guess, term, CHUNK_ITERATIONS, CHUNK_TOLERANCE, memory)
            state, chi2 = solution.values, imu_chi2(solution.native_cost, int(problem.imu_usable[k0:k1].sum()))
            stretches.append(Stretch(k0, keep, chi2))
        except EstimationError as error:
            state = guess
            stretches.append(Stretch(k0, keep, np.inf, str(error)))
        parts.append(state.part(0, keep - k0 + (k1 == keep)))
        before = _carried(state, keep - k0)
    if not any(np.isfinite(stretch.imu_chi2) for stretch in stretches):
        raise EstimationError(stretches[0].reason or "graph: no chunk could be solved")
    return ChainState.joined(parts), anchors[0], stretches


def followed_start(problem: Problem, config: RefineConfig, steps: InertialSteps, first: int) -> ChainState:
    """First values of the frames that steps from frame `first` on join, if their biases change as the motions show."""
    changing = replace(problem, bias_slack=np.ones((len(problem) - 1, 2)))
    return _chunk(changing, config, problem.scale_log_mean, steps, first, None)[1]


def _chunk(problem: Problem, config: RefineConfig, log_scale: float, steps: InertialSteps, k0: int,
           anchor: Anchor | None) -> tuple[ChainModel, ChainState, MotionTerm]:
    """One chunk's factors, first guess and motions."""
    k1 = k0 + len(steps)
    inside = (problem.motions.i >= k0) & (problem.motions.j <= k1)
    motions = problem.motions.select(inside, first_node=k0)
    gyro_bias = problem.gyro_bias_rad_s if anchor is None else anchor.bias.gyroscope()
    R, p, v, anchor = first_guess(problem, motions, steps.rotations(gyro_bias), config.initial, log_scale, k0, anchor)
    accel_bias, gyro_bias = anchor.bias.accelerometer(), anchor.bias.gyroscope()
    guess = ChainState(R, p, v, np.tile(accel_bias, (len(R), 1)), np.tile(gyro_bias, (len(R), 1)), np.zeros(0))
    term = MotionTerm(motions, None, log_scale, config.robust.huber, np.ones(len(motions)))
    return ChainModel(steps, anchor), guess, term


def _carried(state: ChainState, node: int) -> Anchor:
    return Anchor(state.T_world_body[node], np.diag(CARRIED_POSE_SD**2), state.v[node], CARRIED_VELOCITY_SD,
                  make_bias(state.accel_bias[node], state.gyro_bias[node]), CARRIED_BIAS_SD)
