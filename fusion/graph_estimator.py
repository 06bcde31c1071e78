"""The factor-graph recipe: chunks → fixed scale → scale policy → Huber → gate → Gaussian → covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import S
from numpy.typing import NDArray

from fusion import scale as scale_policy
from fusion.body_motion import BodyMotion, without_body_motion
from fusion.config import RefineConfig
from fusion.covariance import marginal_covariances
from fusion.estimate import Estimate, add_scale_uncertainty
from fusion.graph import add_anchor, add_imu, add_scale_walk, read_log_scales, read_states
from fusion.initialization import Start, chunked_start, search_log_scale
from fusion.joint import SEED, with_assumed_scale
from fusion.joint_graph import sample_graph
from fusion.motion_noise import is_right, translation_noise, with_noise
from fusion.problem import Problem
from fusion.result import ScaleConclusion, ScalePolicy
from fusion.scale import FreePass, Segments
from fusion.solve import MotionTerm, Solution, gauss_newton, linear_graph
from fusion.stages import Stages
from vio.errors import EstimationError

Array = NDArray[np.float64]

COARSE_TOLERANCE = 1e-3
"""Of the Huber passes: they only have to tell outliers from the rest, and Huber alone would bias the scale."""
GATED_SHARE = 0.1
"""A rejected motion weighs this over its squared norm: the true step still lies within a few of its errors."""
GATE_ROUNDS = 3
NOISE_ROUNDS, SETTLED = 5, 0.07
"""How often the motions' noise may be corrected, and by how little at last."""


@dataclass(frozen=True)
class _Pass:
    """A finished optimisation with its factors, ready for covariances."""

    native: gtsam.NonlinearFactorGraph
    term: MotionTerm
    solution: Solution
    imu_chi2: float

    @property
    def rejected(self) -> NDArray[np.int64]:
        return np.flatnonzero(self.term.weight < 1.0)


class GraphEstimator:
    """Solves one problem; holds what the passes share."""

    def __init__(self, problem: Problem, config: RefineConfig, stages: Stages) -> None:
        self.problem, self.config, self.stages = problem, config, stages
        self.segments: Segments = scale_policy.make_segments(problem.t_s, config.scale.segment_s)

    def estimate(self) -> Estimate:
        """Run the whole recipe; once more where the motions' noise turns out to be claimed wrongly.

        Raises:
            EstimationError: a stage found no solution.
        """
        self._check_solvable()
        given, noise = self.problem, 1.0
        for _ in range(NOISE_ROUNDS):
            final, conclusion, fixed_chi2, inflation = self._solve()
            with self.stages("motion_noise"):
                factor = translation_noise(final.native, final.solution.values, final.term,
                                           np.random.default_rng(SEED))
            if is_right(factor) if noise == 1.0 else abs(factor - 1) < SETTLED:
                break
            noise *= factor
            self.problem = replace(given, motions=with_noise(given.motions, 1.0, noise))
        else:
            final, conclusion, fixed_chi2, inflation = self._solve()
        with self.stages("covariances"):
            return replace(self._read(final, conclusion, fixed_chi2, inflation), translation_noise=noise)

    def _solve(self) -> tuple[_Pass, ScaleConclusion, float, float]:
        """Solution, what it says of scale, the IMU's chi² at fixed scale and the accelerometer's inflation."""
        start_scale = self._start_scale()
        with self.stages("initialization"):
            start = self._start(start_scale, 1.0)
        with self.stages("fixed_scale"):
            fixed = self._fixed_pass(start, start_scale)
        final, conclusion, inflation = self._decide(fixed, start_scale)
        return final, conclusion, fixed.imu_chi2, inflation

    def _check_solvable(self) -> None:
        if not self.problem.imu_usable.any():
            raise EstimationError("graph: no frame interval has usable IMU data")

    def _start_scale(self) -> float:
        if self.problem.scale_log_sd <= scale_policy.VAGUE_PRIOR_SD or self.config.scale.policy == "fixed":
            return self.problem.scale_log_mean
        with self.stages("scale_search"):
            return search_log_scale(self.problem, self.config)

    def _start(self, log_scale: float, inflation: float) -> Start:
        return chunked_start(self.problem, self.config, log_scale, inflation)

    def _native(self, start: Start) -> gtsam.NonlinearFactorGraph:
        native = gtsam.NonlinearFactorGraph()
        add_anchor(native, 0, start.anchor)
        add_imu(native, start.measurements, self.problem)
        return native

    def _fixed_pass(self, start: Start, log_scale: float) -> _Pass:
        native = self._native(start)
        motions = self.problem.motions
        term = MotionTerm(motions, None, log_scale, self.config.robust.huber, np.ones(len(motions)))
        solution = gauss_newton(native, start.values, term, self.config.solver.max_iterations, COARSE_TOLERANCE)
        return self._finished(native, term, solution)

    def _finished(self, native: gtsam.NonlinearFactorGraph, term: MotionTerm, solution: Solution) -> _Pass:
        chi2 = scale_policy.imu_chi2(solution.native_cost, int(self.problem.imu_usable.sum()))
        return _Pass(native, term, solution, chi2)

    def _decide(self, fixed: _Pass, start_scale: float) -> tuple[_Pass, ScaleConclusion, float]:
        """Try scale free; where it cannot be measured keep the prior's; where the IMU disagrees, trust it less."""
        policy = self.config.scale.policy
        if policy == "fixed" or self.problem.scale_log_sd == 0:
            reason = "asked for" if policy == "fixed" else "the source declares its scale exactly known"
            return self._held(fixed, "fixed", start_scale, reason, 1.0)
        if policy == "prior":
            calm = fixed.imu_chi2 <= self.config.scale.imu_chi2_limit
            return (self._held(fixed, "prior", start_scale, "asked for", 1.0) if calm
                    else self._down_weighted(start_scale, "a prior was asked for and the IMU disagrees"))
        final, free = self._free_pass(fixed, start_scale)
        objection = scale_policy.reasons_against(free, self.problem, self.config.scale)
        if policy == "free":
            conclusion = scale_policy.conclude_free(free, self.problem)
            return final, replace(conclusion, policy="free", reason=f"asked for; {objection or conclusion.reason}"), 1.0
        if free.signal < scale_policy.LEAST_SIGNAL:
            return self._held(fixed, "prior", start_scale, scale_policy.hardly_moved(free), 1.0)
        if objection is None:
            return final, scale_policy.conclude_free(free, self.problem), 1.0
        return self._down_weighted(start_scale, objection)

    def _down_weighted(self, start_scale: float, why: str) -> tuple[_Pass, ScaleConclusion, float]:
        """Take periodic motion of the body out of the accelerometer, let biases wander, then raise its noise."""
        noise = self.problem.noise
        with self.stages("accelerometer_down_weighted"):
            loose = self._fixed_pass(self._start(start_scale, scale_policy.LOOSE), start_scale)
            self.problem, motion = self._without_body_motion(loose)
        if motion.hz > 0:
            why = f"{why}; a sway of the body of {1e3 * motion.amplitude_m:.2g} mm at {motion.hz:.2g} Hz was taken out"
        for remedy in scale_policy.remedies(motion, noise):
            self.problem = replace(self.problem, noise=remedy.noise)
            with self.stages("accelerometer_down_weighted"):
                fixed = self._fixed_pass(self._start(start_scale, remedy.inflation), start_scale)
            if fixed.imu_chi2 > scale_policy.CALM_CHI2:
                continue
            final, free = self._free_pass(fixed, start_scale)
            if scale_policy.reasons_against(free, self.problem, self.config.scale) is None:
                reason = f"scale near its prior, {remedy.words}: {why}"
                conclusion = scale_policy.widened(scale_policy.conclude_free(free, self.problem), motion, remedy)
                return final, replace(conclusion, policy="prior", reason=reason), remedy.inflation
        with self.stages("accelerometer_down_weighted"):
            fixed = self._fixed_pass(self._start(start_scale, scale_policy.GRAVITY_ONLY), start_scale)
        reason = f"held at the prior, the accelerometer serves for the direction of gravity only: {why}"
        return self._held(fixed, "fixed", start_scale, reason, scale_policy.GRAVITY_ONLY)

    def _without_body_motion(self, loose: _Pass) -> tuple[Problem, BodyMotion]:
        states, motions = read_states(loose.solution.values, 0, len(self.problem)), self.problem.motions
        trusted = np.zeros(len(self.problem) - 1, bool)
        trusted[motions.i[loose.solution.squared_norm < self.config.robust.gate]] = True
        return without_body_motion(self.problem, states.R, states.p, states.accel_bias, states.gyro_bias, trusted)

    def _held(self, fixed: _Pass, policy: ScalePolicy, log_scale: float, reason: str,
              inflation: float) -> tuple[_Pass, ScaleConclusion, float]:
        with self.stages("gate"):
            final = self._gated(fixed)
        sd = scale_policy.assumed_sd(self.problem, self.config.scale)
        return final, ScaleConclusion(policy, log_scale, sd, reason, assumed_sd=sd), inflation

    def _free_pass(self, fixed: _Pass, start_scale: float) -> tuple[_Pass, FreePass]:
        scale, problem = self.config.scale, self.problem
        native = gtsam.NonlinearFactorGraph(fixed.native)
        add_scale_walk(native, self.segments.t_s, problem.scale_log_mean, problem.scale_log_sd, scale.walk_per_sqrt_s)
        values = gtsam.Values(fixed.solution.values)
        for k in range(len(self.segments.t_s)):
            values.insert(S(k), start_scale)
        term = replace(fixed.term, segment=self.segments.of_node[problem.motions.i])
        with self.stages("free_scale"):
            solution = gauss_newton(native, values, term, self.config.solver.max_iterations, COARSE_TOLERANCE)
        with self.stages("gate"):
            final = self._gated(self._finished(native, term, solution))
        with self.stages("scale_uncertainty"):
            gaussian = linear_graph(final.native, final.solution.values, final.term)
            variance = marginal_covariances(gaussian, 0, len(self.segments.t_s))[1]
        log_scale = read_log_scales(final.solution.values, len(self.segments.t_s))
        share = len(final.rejected) / len(problem.motions)
        signal = final.term.signal(final.solution.values)
        return final, FreePass(final.imu_chi2, log_scale, np.sqrt(variance), share, signal)

    def _gated(self, huber: _Pass) -> _Pass:
        """Reject what lies beyond the gate, solve as Gaussian, and look again until the gate is settled."""
        current, gate, solver = huber, self.config.robust.gate, self.config.solver
        for _ in range(GATE_ROUNDS):
            squared = current.solution.squared_norm
            accepted = squared < gate
            if current.term.huber is None and (accepted == (current.term.weight == 1.0)).all():
                break
            weight = np.where(accepted, 1.0, GATED_SHARE / np.maximum(squared, gate))
            term = replace(current.term, huber=None, weight=weight)
            solution = gauss_newton(current.native, current.solution.values, term, solver.max_iterations,
                                    solver.relative_tolerance)
            current = self._finished(current.native, term, solution)
        return current

    def _read(self, final: _Pass, conclusion: ScaleConclusion, fixed_chi2: float, inflation: float) -> Estimate:
        m, segments = len(self.problem), len(self.segments.t_s)
        estimated = final.term.segment is not None
        gaussian = linear_graph(final.native, final.solution.values, final.term)
        cov, variance = marginal_covariances(gaussian, m, segments if estimated else 0)
        rng = np.random.default_rng(SEED)
        joint = sample_graph(gaussian, m, self.segments.of_node if estimated else None, rng)
        states = read_states(final.solution.values, 0, m)
        T = states.T_world_body
        assumed, T_body_camera = conclusion.assumed_sd, self.problem.motions.T_body_camera
        if estimated:
            of_node = self.segments.of_node
            log_scale = read_log_scales(final.solution.values, segments)[of_node]
            log_scale_sd = np.sqrt(variance[of_node] + assumed**2)
        else:
            log_scale, log_scale_sd = np.full(m, conclusion.log_mean), np.full(m, conclusion.log_sd)
        if assumed > 0:
            cov = add_scale_uncertainty(T, cov, assumed, T_body_camera)
            joint = None if joint is None else with_assumed_scale(joint, T, assumed, T_body_camera, rng)
        return Estimate(T, cov, states.v, states.gyro_bias, states.accel_bias, log_scale, log_scale_sd, conclusion,
                        final.rejected, fixed_chi2, inflation, joint)
