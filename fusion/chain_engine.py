"""The engine of recordings whose motions join frames close in time: one band in the order of time, and a few loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion.chain import POSE, ChainFactor, ChainSystem
from fusion.chain_model import LONGEST_REACH, ChainModel, ScaleWalk
from fusion.chain_solve import chain_gauss_newton
from fusion.chain_start import chain_start, inertial_steps
from fusion.config import RefineConfig
from fusion.engine import Begin, Step, Uncertainty
from fusion.problem import Problem
from fusion.scale import Segments
from fusion.scaled_motion import Linearized
from fusion.solve import MotionTerm, Solution

Array = NDArray[np.float64]


class ChainEngine:
    """Solves a recording as a chain of frames; keeps the memory of its last system, and its factor while that holds."""

    def __init__(self) -> None:
        self._memory: ChainSystem | None = None
        self._factored: tuple[Begin, MotionTerm, ChainFactor] | None = None

    @staticmethod
    def suits(problem: Problem) -> bool:
        """Whether no motion joins frames that are far apart."""
        return int((problem.motions.j - problem.motions.i).max()) <= LONGEST_REACH

    def begin(self, problem: Problem, config: RefineConfig, log_scale: float, accel_inflation: float) -> Begin:
        """Factors and first values at one log scale."""
        steps = inertial_steps(problem, accel_inflation)
        state, anchor, stretches = chain_start(problem, config, log_scale, steps)
        return Begin(ChainModel(steps, anchor), state, tuple(stretches))

    def free(self, begin: Begin, problem: Problem, segments: Segments, walk_per_sqrt_s: float,
             log_scale: float) -> Begin:
        """The same with log scales as unknowns."""
        walk = ScaleWalk(segments.of_node, problem.scale_log_mean, problem.scale_log_sd,
                         walk_per_sqrt_s * np.sqrt(np.diff(segments.t_s)))
        return Begin(replace(begin.model, scale=walk),
                     replace(begin.values, log_scale=np.full(len(segments.t_s), log_scale)))

    def solve(self, begin: Begin, term: MotionTerm, max_iterations: int, relative_tolerance: float) -> Solution:
        """Gauss-Newton."""
        self._factored = None
        self._memory = begin.model.system(term, self._memory)
        return chain_gauss_newton(begin.model, begin.values, term, max_iterations, relative_tolerance, self._memory)

    def _factor(self, begin: Begin, term: MotionTerm) -> ChainFactor:
        """The factor at a solution; the one at hand where it is of the same."""
        if self._factored is not None:
            of, of_term, factor = self._factored
            if of.model is begin.model and of.values is begin.values and of_term is term:
                return factor
        self._factored = None
        self._memory = begin.model.linearize(begin.values, term, self._memory)
        self._factored = begin, term, self._memory.factor()
        return self._factored[2]

    def uncertainty(self, begin: Begin, term: MotionTerm, segments: Segments | None,
                    rng: np.random.Generator) -> Uncertainty:
        """Covariances and joint samples from one factorisation."""
        cov, joint = self._factor(begin, term).marginals_and_samples(rng)
        variance = np.zeros(0)
        if segments is None:  # the band's unknowns of scale mean nothing then
            joint = replace(joint, log_scale=np.zeros_like(joint.log_scale))
        else:
            begins = np.flatnonzero(np.diff(segments.of_node, prepend=-1))
            variance = cov[begins, 0, 0]
        return Uncertainty(np.ascontiguousarray(cov[:, POSE, POSE]), variance, joint)

    def response(self, begin: Begin, term: MotionTerm, blocks: Linearized, error: Array) -> Step:
        """How the solution moves when the motions' whitened measurements do."""
        return self.responses(begin, term, blocks, error[None])[0]

    def responses(self, begin: Begin, term: MotionTerm, blocks: Linearized, errors: Array) -> list[Step]:
        """`response` to each of a few errors (S, N, 6), with the solution's one factor."""
        factor = self._factor(begin, term)
        weight = term.losses(blocks.squared_norm)[1]
        weighted = np.moveaxis(errors, 0, 2) * weight[:, None, None]
        gradient = np.zeros((*factor.system.gradient.shape, len(errors)))
        for node, A in ((term.motions.i, blocks.A_i), (term.motions.j, blocks.A_j)):
            np.add.at(gradient[:, POSE], node, np.swapaxes(A, 1, 2) @ weighted)
        if term.segment is not None:
            np.add.at(gradient[:, 0], term.motions.i, (np.swapaxes(blocks.A_s, 1, 2) @ weighted)[:, 0])
        x = factor.solve_columns(gradient)
        scale = np.zeros((len(term.motions), len(errors))) if term.segment is None else x[term.motions.i, 0]
        return [Step(np.ascontiguousarray(x[:, POSE, k]), scale[:, k]) for k in range(len(errors))]
