"""Loops in the graph: asked whether they can be true at all, then Huber, then gate, then Gaussian.

A wrong loop bends everything, so loops come last, when outlying motions are gone and the graph knows how sure it is. A
loop must lie within what the graph holds possible; those that do are let in under a Huber loss, and those that the
others, the motions and the IMU then contradict are dropped for good. The gut looks like itself: without loops nothing
is lost that the motions had.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.chain_model import LONGEST_REACH
from fusion.config import RefineConfig
from fusion.engine import Begin, Engine
from fusion.graph import Values, read_poses
from fusion.joint import JointSamples
from fusion.result import LoopConclusion
from fusion.scaled_motion import ScaledMotions, linearize, make_motions
from fusion.solve import MotionTerm, Solution
from vio.errors import MotionsError
from vio.loops import Loops
from vio.motions import match_frames

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.int64]

IMPOSSIBLE = "the graph holds the motion impossible"
CONTRADICTED = "motions, IMU and the other loops contradict it"
OUTSIDE = "a frame lies outside what the motions span"
TOO_CLOSE = "its frames are neighbours"
POSSIBLE = 50.0
"""Squared distance, 6 degrees of freedom, of a loop from what the graph expects before it knows any loop. 22.5 would be
99.9 % if the graph's covariances were right; on rendered recordings its errors are about 1.5 times as large."""
GAUSSIAN = 1e6
"""Huber threshold that no residual reaches."""
ROUNDS = 4
SHARED_ERROR = 0.3
"""Correlation of the errors of two loops beside each other: they see the same wall through the same wrong depths."""
BESIDE_S = 3.0
"""Loops whose ends are both within so many seconds lie beside each other."""


@dataclass(frozen=True)
class GraphLoops:
    """Loops as a problem's graph takes them."""

    motions: ScaledMotions
    conclusion: LoopConclusion


def make_loops(loops: Loops, frame_t_s: Array, t_s: Array, T_body_camera: Array, scale_log_mean: float) -> GraphLoops:
    """Loops between nodes at t_s (M,), in the unit whose ln metres are `scale_log_mean`.

    Args:
        loops: as they were found.
        frame_t_s: times of all frames of the recording.
        t_s: (M,) times of the nodes, a run of those.
        T_body_camera: (4, 4)
        scale_log_mean: of the motions that the loops go with.

    Raises:
        MotionsError: an end that is no frame.
    """
    refused = Counter(loops.refused)
    if loops.motions is None:
        nothing = make_motions(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)),
                               T_body_camera)
        return GraphLoops(nothing, LoopConclusion(loops.proposed, dict(refused)))
    given = loops.motions
    first = int(np.argmin(np.abs(frame_t_s - t_s[0])))
    i, j = (ends - first for ends in match_frames(given, frame_t_s))
    inside, far = (i >= 0) & (j < len(t_s)), j - i > LONGEST_REACH
    refused[OUTSIDE] += int((~inside).sum())
    refused[TOO_CLOSE] += int((inside & ~far).sum())
    kept = inside & far
    i, j, unit = i[kept], j[kept], np.repeat([1.0, np.exp(given.scale_log_mean - scale_log_mean)], 3)
    T = given.T_i_j[kept].copy()
    T[:, :3, 3] *= unit[3]
    cov = given.cov[kept] * unit[:, None] * unit * _shared_factor(t_s[i], t_s[j])[:, None, None]
    return GraphLoops(make_motions(i, j, T, cov, T_body_camera),
                      LoopConclusion(loops.proposed, _counted(refused), np.column_stack([i, j])))


def _shared_factor(t_i: Array, t_j: Array) -> Array:
    """(L,) factors on the covariances: 1 + the correlation with every loop beside it."""
    beside = (np.abs(t_i[:, None] - t_i) < BESIDE_S) & (np.abs(t_j[:, None] - t_j) < BESIDE_S)
    return np.asarray(1 + SHARED_ERROR * (beside.sum(axis=1) - 1))


def _counted(refused: Mapping[str, int]) -> dict[str, int]:
    return {reason: count for reason, count in refused.items() if count}


def possible(loops: ScaledMotions, values: Values, joint: JointSamples, log_scale: Array) -> Bools:
    """(L,) which loops lie within what a solution without them expects, given how sure it is.

    Args:
        loops: between nodes of the solution.
        values: the solution.
        joint: draws of its error.
        log_scale: (L,) that applies to each.
    """
    R, p = read_poses(values)
    blocks = linearize(loops, R, p, log_scale)
    moved = np.zeros((len(joint.xi), len(loops), 6))
    for A, node in ((blocks.A_i, loops.i), (blocks.A_j, loops.j)):
        to_body = np.swapaxes(R[node], 1, 2)
        xi = np.concatenate([np.einsum("nab,snb->sna", to_body, error) for error in
                             (joint.rotation_errors(R, node), joint.position_errors(R, node))], axis=2)
        moved += np.einsum("nka,sna->snk", A, xi)
    moved += blocks.A_s[:, :, 0] * joint.scale_errors(loops.i)[:, :, None]
    spread = np.einsum("snk,snl->nkl", moved, moved) / len(moved) + np.eye(6)
    off = np.linalg.solve(spread, blocks.b[:, :, None])[:, :, 0]
    return np.asarray(np.einsum("nk,nk->n", blocks.b, off) < POSSIBLE)


def close_loops(engine: Engine, begin: Begin, term: MotionTerm, loops: GraphLoops, joint: JointSamples,
                segment_of_node: Indices | None, config: RefineConfig
                ) -> tuple[MotionTerm, Solution, LoopConclusion] | None:
    """Solve again with the loops that hold.

    Args:
        engine: that found the solution without loops.
        begin: its factors and the solution.
        term: its motions, gated.
        loops: to be tried.
        joint: draws of the solution's error.
        segment_of_node: (M,) scale segment of every node; None where scale is held.
        config: the gate and the solver's limits.

    Returns:
        The term with the accepted loops behind its motions, the solution, and what became of every loop; None where no
        loop holds.

    Raises:
        EstimationError: no solution with the loops.
    """
    segment = None if segment_of_node is None else segment_of_node[loops.motions.i]
    alone = MotionTerm(loops.motions, segment, term.held_log_scale, None, np.ones(len(loops.motions)))
    held = possible(loops.motions, begin.values, joint, alone.log_scale(begin.values))
    if not held.any():
        return None
    solver, count = config.solver, len(term.motions)
    chosen, huber = held, np.r_[np.full(count, GAUSSIAN), np.full(int(held.sum()), config.robust.huber)]
    solution = engine.solve(begin, with_loops(term, alone, chosen, huber), solver.max_iterations,
                            solver.relative_tolerance)
    for _ in range(ROUNDS):
        accepted = held & (alone.squared_norm(solution.values) < config.robust.gate)
        if not accepted.any():
            return None
        joined = with_loops(term, alone, accepted, None)
        solution = engine.solve(Begin(begin.model, solution.values), joined, solver.max_iterations,
                                solver.relative_tolerance)
        if (accepted == chosen).all():
            break
        chosen = accepted
    return joined, solution, judged(loops.conclusion, held, accepted, alone.squared_norm(solution.values))


def with_loops(term: MotionTerm, loops: MotionTerm, chosen: Bools, huber: Array | None) -> MotionTerm:
    """One term of the motions and, behind them, the chosen loops."""
    m, extra = term.motions, loops.motions.select(chosen)
    i, j, R, t, whiten = (np.concatenate([getattr(m, name), getattr(extra, name)])
                          for name in ("i", "j", "R", "t", "whiten"))
    held = None if m.held_log_scale is None else np.concatenate([m.held_log_scale, np.full(len(extra), np.nan)])
    motions = ScaledMotions(i, j, R, t, whiten, m.T_body_camera, held)
    segment = None if term.segment is None or loops.segment is None else \
        np.concatenate([term.segment, loops.segment[chosen]])
    return replace(term, motions=motions, segment=segment, huber=huber,
                   weight=np.concatenate([term.weight, np.ones(len(extra))]))


def judged(before: LoopConclusion, held: Bools, accepted: Bools, distance2: Array) -> LoopConclusion:
    """The conclusion with the graph's verdict on every loop."""
    refused = Counter(before.refused)
    refused[IMPOSSIBLE] += int((~held).sum())
    refused[CONTRADICTED] += int((held & ~accepted).sum())
    return replace(before, refused=_counted(refused), accepted=accepted, distance2=distance2)


def none_held(before: LoopConclusion, reason: str = IMPOSSIBLE) -> LoopConclusion:
    """The conclusion where no loop was used."""
    count = len(before.frames)
    refused = Counter(before.refused)
    refused[reason] += count
    return replace(before, refused=_counted(refused), accepted=np.zeros(count, bool), distance2=np.full(count, np.nan))


def check_loops(loops: Loops, frame_t_s: Array) -> None:
    """Make sure that loops belong to a recording.

    Raises:
        MotionsError: an end lies further than 1 ms from every frame.
    """
    if loops.motions is not None:
        try:
            match_frames(loops.motions, frame_t_s)
        except MotionsError as error:
            raise MotionsError(f"loops: of another recording ({error})") from None

