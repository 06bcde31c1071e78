"""The engine of any graph: gtsam's factors, METIS ordering, multifrontal Cholesky, QR where Cholesky fails."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import S, X
from numpy.typing import NDArray

from fusion.config import RefineConfig
from fusion.covariance import marginal_covariances
from fusion.engine import Begin, Step, Uncertainty
from fusion.graph import add_anchor, add_imu, add_scale_walk
from fusion.initialization import chunked_start
from fusion.joint_graph import sample_graph
from fusion.problem import Problem
from fusion.scale import Segments
from fusion.scaled_motion import Linearized
from fusion.solve import MotionTerm, Solution, gauss_newton, linear_graph, linear_step

Array = NDArray[np.float64]


class NativeEngine:
    """Solves a recording with gtsam."""

    def begin(self, problem: Problem, config: RefineConfig, log_scale: float, accel_inflation: float) -> Begin:
        """Factors and first values at one log scale."""
        start = chunked_start(problem, config, log_scale, accel_inflation)
        native = gtsam.NonlinearFactorGraph()
        add_anchor(native, 0, start.anchor)
        add_imu(native, start.measurements, problem)
        return Begin(native, start.values)

    def free(self, begin: Begin, problem: Problem, segments: Segments, walk_per_sqrt_s: float,
             log_scale: float) -> Begin:
        """The same with log scales as unknowns."""
        native, values = gtsam.NonlinearFactorGraph(begin.model), gtsam.Values(begin.values)
        add_scale_walk(native, segments.t_s, problem.scale_log_mean, problem.scale_log_sd, walk_per_sqrt_s)
        for k in range(len(segments.t_s)):
            values.insert(S(k), log_scale)
        return Begin(native, values)

    def solve(self, begin: Begin, term: MotionTerm, max_iterations: int, relative_tolerance: float) -> Solution:
        """Gauss-Newton."""
        return gauss_newton(begin.model, begin.values, term, max_iterations, relative_tolerance)

    def uncertainty(self, begin: Begin, term: MotionTerm, segments: Segments | None,
                    rng: np.random.Generator) -> Uncertainty:
        """Covariances from a Bayes tree, joint samples from a band where the graph has one."""
        nodes = int(term.motions.j.max()) + 1
        gaussian = linear_graph(begin.model, begin.values, term)
        cov, variance = marginal_covariances(gaussian, nodes, 0 if segments is None else len(segments.t_s))
        joint = sample_graph(gaussian, nodes, None if segments is None else segments.of_node, rng)
        return Uncertainty(cov, variance, joint)

    def responses(self, begin: Begin, term: MotionTerm, blocks: Linearized, errors: Array) -> list[Step]:
        """`response` to each of a few errors (S, N, 6)."""
        still = self._step(begin, term, blocks)
        found = []
        for error in errors:
            columns = blocks.columns.copy()
            columns[:, :, -1] += error
            moved = self._step(begin, term, replace(blocks, columns=columns))
            found.append(Step(moved.pose - still.pose, moved.scale - still.scale))
        return found

    def response(self, begin: Begin, term: MotionTerm, blocks: Linearized, error: Array) -> Step:
        """How the solution moves when the motions' whitened measurements do: one step less another."""
        return self.responses(begin, term, blocks, error[None])[0]

    @staticmethod
    def _step(begin: Begin, term: MotionTerm, blocks: Linearized) -> Step:
        gaussian = linear_graph(begin.model, begin.values, term, blocks)
        delta = linear_step(gaussian, gtsam.Ordering.MetisGaussianFactorGraph(gaussian))
        pose = np.array([delta.at(X(k)) for k in range(int(term.motions.j.max()) + 1)])
        if term.segment is None:
            return Step(pose, np.zeros(len(term.motions)))
        return Step(pose, np.array([delta.at(S(k))[0] for k in range(term.segments)])[term.segment])
