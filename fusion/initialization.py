"""A start for the graph: overlapping chunks at a fixed scale, each begun from the gyro's rotations.

Chaining a whole examination lets the tilt drift until Gauss-Newton diverges; chunks do not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from fusion.config import InitialConfig, RefineConfig, SolverConfig
from fusion.graph import Anchor, add_anchor, add_imu, first_anchor, insert_states
from fusion.preintegration import preintegrate
from fusion.problem import Problem
from fusion.scaled_motion import ScaledMotions
from fusion.solve import MotionTerm, Solution, gauss_newton
from vio import se3
from vio.errors import EstimationError

Array = NDArray[np.float64]

SHORTEST_TAIL = 200
"""A last chunk with fewer nodes joins the one before."""
LEVEL_FRAMES = 60
CLIP_STEP = 6.0
"""Steps longer than this many medians are shortened before chaining the first guess."""
CHUNK_ITERATIONS, CHUNK_TOLERANCE = 12, 1e-3
NEARBY_FRAMES = 121
"""Frames over which the motions show the gyro's bias well enough to chain its rotations, outliers and all."""
SEARCH_FRAMES = 400
SEARCH_GRID = np.linspace(-3.0, 3.0, 13)
CARRIED_POSE_SD = np.array([0.01, 0.01, 1e-3, 1e-4, 1e-4, 1e-4])
CARRIED_VELOCITY_SD = 0.003
CARRIED_BIAS_SD = np.array([0.02] * 3 + [2e-4] * 3)


@dataclass(frozen=True)
class Start:
    """First values of all nodes, and the IMU measurements linearised near them."""

    values: gtsam.Values
    measurements: list[gtsam.PreintegratedCombinedMeasurements]
    anchor: Anchor


def level_rotation(problem: Problem, R_chain: Array, first: int) -> Array:
    """Rotation (3, 3) that turns a gyro chain so that its mean specific force points up.

    Args:
        problem: for the IMU pieces.
        R_chain: (K, 3, 3) attitudes of the nodes from `first` on, up to a constant rotation.
        first: node of `R_chain[0]`.
    """
    usable = [k for k in range(min(len(R_chain) - 1, LEVEL_FRAMES)) if problem.imu_usable[first + k]]
    if not usable:
        return np.eye(3)
    pieces = problem.pieces
    up = np.zeros(3)
    for k in usable:
        span = slice(pieces.first[first + k], pieces.first[first + k + 1])
        up += R_chain[k] @ (pieces.accel_m_s2[span] * pieces.dt_s[span, None]).sum(axis=0)
    up /= np.linalg.norm(up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = np.linalg.norm(axis), up[2]
    if sine < 1e-9:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return se3.so3_exp(axis / sine * np.arctan2(sine, cosine))


def gyro_chain(problem: Problem, R_steps: Array, first: int) -> Array:
    """Attitudes (K+1, 3, 3) relative to node `first`, from the gyro's rotations (K, 3, 3) of the intervals after it.

    The measured motion's rotation stands in where the IMU is missing.
    """
    T = se3.transform(R_steps, np.zeros(3))
    m = problem.motions
    instead = np.flatnonzero((m.j - m.i == 1) & (m.i >= first) & (m.i < first + len(T)))
    instead = instead[~problem.imu_usable[m.i[instead]]]
    T[m.i[instead] - first, :3, :3] = m.select(instead).body_rotation()
    return se3.chain(T)[:, :3, :3]


def chunk_spans(intervals: int, solver: SolverConfig) -> Iterator[tuple[int, int, int]]:
    """First node, node to continue from, and last node of every chunk; the last two agree in the last chunk."""
    k0 = 0
    while k0 < intervals:
        keep = min(k0 + solver.chunk_frames, intervals)
        k1 = min(keep + solver.overlap_frames, intervals)
        if intervals - keep < SHORTEST_TAIL:
            keep = k1 = intervals
        yield k0, keep, k1
        k0 = keep


def chunked_start(problem: Problem, config: RefineConfig, log_scale: float, accel_inflation: float = 1.0) -> Start:
    """Solve chunk after chunk at one log scale, carrying pose, velocity and bias to the next.

    Args:
        accel_inflation: additional factor on the accelerometer density everywhere.

    Raises:
        EstimationError: a chunk cannot be solved.
    """
    intervals = len(problem) - 1
    values = gtsam.Values()
    measurements: list[gtsam.PreintegratedCombinedMeasurements] = []
    anchor, first_of_all = None, None
    for k0, keep, k1 in chunk_spans(intervals, config.solver):
        bias = np.r_[np.zeros(3), problem.gyro_bias_rad_s] if anchor is None else anchor.bias.vector()
        chunk = _preintegrate(problem, bias, accel_inflation, (k0, k1))
        anchor, solution = _solve_chunk(problem, config, log_scale, chunk, (k0, k1), anchor)
        first_of_all = anchor if first_of_all is None else first_of_all
        for k in range(k0, keep + (keep == intervals)):
            values.insert(X(k), solution.values.atPose3(X(k)))
            values.insert(V(k), solution.values.atVector(V(k)))
            values.insert(B(k), solution.values.atConstantBias(B(k)))
        measurements += chunk[: keep - k0]
        anchor = _carried(solution.values, keep)
    if first_of_all is None:
        raise EstimationError("graph: no interval between frames")
    return Start(values, measurements, first_of_all)


def _preintegrate(problem: Problem, bias: Array, accel_inflation: float,
                  span: tuple[int, int]) -> list[gtsam.PreintegratedCombinedMeasurements]:
    return preintegrate(problem.pieces, problem.noise, bias[:3], bias[3:], problem.accel_inflation * accel_inflation,
                        problem.gyro_inflation, span, problem.bias_slack)


def first_guess(problem: Problem, motions: ScaledMotions, rotations: Array, initial: InitialConfig, log_scale: float,
                k0: int, anchor: Anchor | None) -> tuple[Array, Array, Array, Anchor]:
    """Attitudes, positions and velocities of a chunk's frames from the gyro and the motions, and what it begins from.

    Args:
        problem: the whole recording.
        motions: those inside the chunk, counted from its first frame.
        rotations: (K-1, 3, 3) of the gyro between its frames.
        initial: how sure the state of the recording's first frame is.
        log_scale: of the motions.
        k0: the chunk's first frame.
        anchor: what the chunk before carries on; None = level by gravity.
    """
    R = gyro_chain(problem, _followed(problem, motions, rotations, k0), k0)
    if anchor is None:
        R = level_rotation(problem, R, k0) @ R
        anchor = first_anchor(se3.transform(R[0], np.zeros(3)), problem.gyro_bias_rad_s, initial)
    else:
        R = anchor.T_world_body[:3, :3] @ R
    return R, *chain_positions(problem, motions, R, anchor.T_world_body[:3, 3], log_scale, k0), anchor


def _followed(problem: Problem, motions: ScaledMotions, rotations: Array, k0: int) -> Array:
    """The gyro's rotations; where biases may change by more than their random walk, with the bias the motions show."""
    here = slice(k0, k0 + len(rotations))
    if problem.bias_slack is None or not problem.bias_slack[here].any():
        return rotations
    surest = motions.surest_neighbours(len(rotations) + 1)
    seen = np.flatnonzero((surest >= 0) & problem.imu_usable[here])
    if len(seen) == 0:
        return rotations
    dt = problem.dt_s[here, None]
    measured = motions.select(surest[seen]).body_rotation()
    off = se3.so3_log(np.swapaxes(measured, 1, 2) @ rotations[seen]) / dt[seen]
    near = median_filter(off, size=(NEARBY_FRAMES, 1), mode="nearest")
    bias = np.stack([np.interp(np.arange(len(rotations)), seen, along) for along in near.T], axis=1)
    return np.asarray(rotations @ se3.so3_exp(-bias * dt))


def _carried(values: gtsam.Values, node: int) -> Anchor:
    return Anchor(values.atPose3(X(node)).matrix(), np.diag(CARRIED_POSE_SD**2), values.atVector(V(node)),
                  CARRIED_VELOCITY_SD, values.atConstantBias(B(node)), CARRIED_BIAS_SD)


def _solve_chunk(problem: Problem, config: RefineConfig, log_scale: float,
                 measurements: list[gtsam.PreintegratedCombinedMeasurements], span: tuple[int, int],
                 anchor: Anchor | None) -> tuple[Anchor, Solution]:
    k0, k1 = span
    inside = (problem.motions.i >= k0) & (problem.motions.j <= k1)
    motions = problem.motions.select(inside, first_node=k0)
    rotations = np.array([m.deltaRij().matrix() for m in measurements])
    R, p, v, anchor = first_guess(problem, motions, rotations, config.initial, log_scale, k0, anchor)
    guess = gtsam.Values()
    insert_states(guess, se3.transform(R, p), v, [anchor.bias] * len(R), k0)
    graph = gtsam.NonlinearFactorGraph()
    add_anchor(graph, k0, anchor)
    add_imu(graph, measurements, problem, k0)
    term = MotionTerm(motions, None, log_scale, config.robust.huber, np.ones(len(motions)), first_node=k0)
    return anchor, gauss_newton(graph, guess, term, CHUNK_ITERATIONS, CHUNK_TOLERANCE)


def chain_positions(problem: Problem, motions: ScaledMotions, R: Array, p0: Array, log_scale: float,
                     k0: int) -> tuple[Array, Array]:
    """First guess of positions and velocities: measured steps, outliers shortened, along the gyro's attitudes."""
    step = np.zeros((len(R) - 1, 3))
    consecutive = motions.j - motions.i == 1
    step[motions.i[consecutive]] = motions.body_motion(log_scale)[consecutive, :3, 3]
    size = np.linalg.norm(step, axis=1)
    limit = CLIP_STEP * max(float(np.median(size)), 1e-12)
    step *= np.minimum(1.0, limit / np.maximum(size, 1e-12))[:, None]
    step = (R[:-1] @ step[:, :, None])[:, :, 0]
    p = p0 + np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])
    rate = step / problem.dt_s[k0 : k0 + len(step), None]
    v = np.concatenate([rate[:1], 0.5 * (rate[1:] + rate[:-1]), rate[-1:]])
    return p, v


def search_log_scale(problem: Problem, config: RefineConfig) -> float:
    """Coarse log scale for a source whose prior says little: the grid point whose first chunk costs least.

    Every motion costs at most what the gate allows, so that a few outliers cannot decide.
    """
    last = min(SEARCH_FRAMES, len(problem) - 1)
    chunk = _preintegrate(problem, np.r_[np.zeros(3), problem.gyro_bias_rad_s], 1.0, (0, last))
    best, best_cost = problem.scale_log_mean, np.inf
    for offset in SEARCH_GRID:
        candidate = problem.scale_log_mean + float(offset) * problem.scale_log_sd
        try:
            _, solution = _solve_chunk(problem, config, candidate, chunk, (0, last), None)
        except EstimationError:
            continue
        cost = solution.native_cost + 0.5 * float(np.minimum(solution.squared_norm, config.robust.gate).sum())
        if cost < best_cost:
            best, best_cost = candidate, cost
    return best
