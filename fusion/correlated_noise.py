"""What errors of motions that last for several frames do to a trajectory: more than independent ones of the same size.

The graph weighs motions as if their errors were independent, which costs little accuracy; how sure it is has to be said
for the errors as they are. A part of variance a = 2 ρ / (1 + ρ) that decays by ρ from motion to motion is added to the
whitened errors: slow errors are then as large as those of a first-order process of unit variance, quick ones stay a
little larger. Drawn, and sent through the solved graph's linear response, it widens covariances and joint samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fusion.engine import Begin, Engine, Uncertainty
from fusion.graph import read_poses
from fusion.joint import SAMPLES, JointSamples
from fusion.problem import Problem
from fusion.scale import Segments
from fusion.scaled_motion import linearize
from fusion.solve import MotionTerm

Array = NDArray[np.float64]

AT_ONCE = 10
"""Draws that are made and solved for together: what memory holds for a whole examination."""


def with_lasting_errors(engine: Engine, begin: Begin, term: MotionTerm, problem: Problem, segments: Segments | None,
                        unsure: Uncertainty, rng: np.random.Generator) -> Uncertainty:
    """Uncertainty widened for translation errors that last `problem.error_correlation_s`.

    Args:
        engine: that solved the graph.
        begin: all other factors, and the solution.
        term: the motions as they were solved.
        problem: whose motions they are.
        segments: of the log scales; None where scale is held.
        unsure: what the graph claims for independent errors.
        rng: source of the draws.

    Raises:
        EstimationError: the linear system has no unique solution.
    """
    blocks = linearize(term.motions, *read_poses(begin.values), term.log_scale(begin.values))
    t_s = problem.t_s[term.motions.i]
    cov, variance, joint = unsure.cov.copy(), unsure.log_scale_variance.copy(), unsure.joint
    if joint is not None:
        joint = JointSamples(joint.node, joint.xi.copy(), joint.log_scale.copy())
    for first in range(0, SAMPLES, AT_ONCE):
        errors = lasting_errors(t_s, problem.error_correlation_s, min(AT_ONCE, SAMPLES - first), rng)
        for draw, step in enumerate(engine.responses(begin, term, blocks, errors), first):
            cov += step.pose[:, :, None] * step.pose[:, None, :] / SAMPLES
            of_segment = np.zeros(len(variance))
            if term.segment is not None:
                of_segment[term.segment] = step.scale
                variance += of_segment**2 / SAMPLES
            if joint is not None:
                joint.xi[draw] += step.pose[joint.node]
                if segments is not None:
                    joint.log_scale[draw] += of_segment[segments.of_node[joint.node]]
    return Uncertainty(cov, variance, joint)


def lasting_errors(t_s: Array, correlation_s: float, draws: int, rng: np.random.Generator) -> Array:
    """(draws, N, 6) whitened errors of motions that begin at t_s (N,), of translation only.

    What two motions share decays with the time between them.
    """
    step_s = np.diff(np.sort(t_s))
    apart_s = float(np.median(step_s[step_s > 0])) if (step_s > 0).any() else correlation_s
    share = lasting_share(np.exp(-apart_s / correlation_s))
    errors = np.zeros((draws, len(t_s), 6))
    errors[:, :, 3:] = np.sqrt(share) * first_order(t_s, correlation_s, rng.standard_normal((draws, len(t_s), 3)))
    return errors


def first_order(t_s: Array, correlation_s: float, white: Array) -> Array:
    """A first-order process of unit variance at times t_s (N,), in any order, driven by white noise (S, N, c)."""
    order = np.argsort(t_s, kind="stable")
    kept = np.exp(-np.diff(t_s[order]) / correlation_s)
    process = np.ascontiguousarray(np.moveaxis(white[:, order], 1, 0))  # one motion's numbers lie together
    process[1:] *= np.sqrt(1 - kept**2)[:, None, None]
    for before, after, rho in zip(process[:-1], process[1:], kept, strict=True):
        after += rho * before
    out = np.empty_like(white)
    out[:, order] = np.moveaxis(process, 0, 1)
    return out


def lasting(problem: Problem) -> Callable[[Array], Array] | None:
    """White noise (S, N, c) of the problem's motions → errors of unit variance as they last; None where they do not."""
    if problem.error_correlation_s == 0:
        return None
    return partial(first_order, problem.t_s[problem.motions.i], problem.error_correlation_s)


def lasting_share(rho: float) -> float:
    """Variance of the part to add for errors of correlation `rho` from motion to motion."""
    return 2 * rho / (1 + rho)


def long_run(problem: Problem) -> Problem:
    """The problem with translation noise as large as lasting errors make it in the long run, for what has no response.

    Variance times (1 + ρ) / (1 - ρ): right for a path of many motions, too large for a few.
    """
    if problem.error_correlation_s == 0:
        return problem
    rho = np.exp(-float(np.median(problem.dt_s)) / problem.error_correlation_s)
    factor = np.sqrt((1 + rho) / (1 - rho))
    return replace(problem, motions=replace(
        problem.motions, whiten=problem.motions.whiten / np.repeat([1.0, factor], 3)))
