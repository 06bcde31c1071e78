"""The factor-graph recipe: chunks, fixed scale, scale policy, Huber, gate, Gaussian, rest, loops, covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion import scale as scale_policy
from fusion.bias_changes import BiasChanges, find_bias_changes, suspect_stretches
from fusion.body_motion import BodyMotion, without_body_motion
from fusion.chain_engine import ChainEngine
from fusion.chain_state import ChainState
from fusion.checkpoint import Checkpoint, ResumableEngine
from fusion.config import RefineConfig
from fusion.correlated_noise import lasting, with_lasting_errors
from fusion.engine import Begin, Engine, Uncertainty
from fusion.estimate import Estimate, add_scale_uncertainty
from fusion.graph import read_log_scales, read_states
from fusion.initialization import search_log_scale
from fusion.joint import SEED, with_assumed_scale
from fusion.loops import GraphLoops, close_loops, none_held
from fusion.motion_noise import bounded, is_right, translation_noise, with_noise
from fusion.native_engine import NativeEngine
from fusion.problem import Problem
from fusion.rest import find_rests, with_rests
from fusion.result import NO_REST, LoopConclusion, RestConclusion, ScaleConclusion, ScalePolicy
from fusion.scale import FreePass, Segments
from fusion.solve import MotionTerm, Solution
from fusion.stages import Stages
from fusion.stretches import contradicted, demoted
from vio.errors import EstimationError

Array = NDArray[np.float64]

COARSE_TOLERANCE = 2e-2
"""Of the Huber passes: they only have to tell outliers from the rest, and Huber alone would bias the scale."""
GATED_SHARE = 0.1
"""A rejected motion weighs this over its squared norm: the true step still lies within a few of its errors."""
GATE_NARROWS = (16.0, 4.0, 1.0, 1.0)
"""Multiples of the gate, round after round. The Huber pass leaves a scale that is off by a quarter its mark on the
surest motions; a gate that is narrow at once would reject them, and without them the graph cannot tell that they are
right (measured: 228 and 190 of 10,000 good motions lost on two recordings, 14 and 14 so)."""
NOISE_ROUNDS, SETTLED = 5, 0.07
"""How often the motions' noise may be corrected, and by how little at last."""


@dataclass(frozen=True)
class _Pass:
    """A finished optimisation with its factors, ready for covariances."""

    model: Any
    term: MotionTerm
    solution: Solution
    imu_chi2: float
    uncertainty: Uncertainty | None = None
    """Where it was needed already."""

    @property
    def rejected(self) -> NDArray[np.int64]:
        return np.flatnonzero(self.term.weight < 1.0)


class GraphEstimator:
    """Solves one problem; holds what the passes share."""

    def __init__(self, problem: Problem, config: RefineConfig, stages: Stages,
                 checkpoint: Checkpoint | None = None, loops: GraphLoops | None = None) -> None:
        self.problem, self.config, self.stages, self.loops = problem, config, stages, loops
        self._felt = problem.samples
        self.engine: Engine = NativeEngine()
        if ChainEngine.suits(problem):
            self.engine = ChainEngine() if checkpoint is None else ResumableEngine(ChainEngine(), checkpoint)
        self.notes: list[str] = []
        self.bias_changes = BiasChanges()
        self.segments: Segments = scale_policy.make_segments(problem.t_s, config.scale.segment_s)

    def estimate(self) -> Estimate:
        """Run the whole recipe, on gtsam where the chain cannot be solved.

        Raises:
            EstimationError: a stage found no solution.
        """
        self._check_solvable()
        try:
            return self._estimate()
        except EstimationError as error:
            if isinstance(self.engine, NativeEngine):
                raise
            self.engine = NativeEngine()
            return replace(self._estimate(), notes=(*self.notes, f"{error}; solved by gtsam"))

    def _estimate(self) -> Estimate:
        """The recipe, repeated where the motions' noise turns out to be claimed wrongly."""
        given, noise = self.problem, 1.0
        for _ in range(NOISE_ROUNDS):
            final, conclusion, fixed_chi2, inflation = self._solve()
            with self.stages("motion_noise"):
                factor = translation_noise(self.engine, Begin(final.model, final.solution.values), final.term,
                                           np.random.default_rng(SEED), lasting(self.problem))
            corrected = bounded(noise * factor)
            if (is_right(factor) if noise == 1.0 else abs(factor - 1) < SETTLED) or corrected == noise:
                break
            noise = corrected
            self.problem = replace(given, motions=with_noise(given.motions, 1.0, noise))
        else:
            final, conclusion, fixed_chi2, inflation = self._solve()
        final, rest = self._rested(final, conclusion)
        final, closed = self._closed(final, conclusion)
        with self.stages("covariances"):
            return replace(self._read(final, conclusion, fixed_chi2, inflation), translation_noise=noise, loops=closed,
                           rest=rest)

    def _rested(self, final: _Pass, conclusion: ScaleConclusion) -> tuple[_Pass, RestConclusion]:
        """The solution that knows where the capsule lay still, the same where it never did."""
        if self.config.rest.policy == "off":
            return final, NO_REST
        values, m = final.solution.values, len(self.problem)
        log_scale = np.full(m, conclusion.log_mean)
        if final.term.segment is not None:
            log_scale = read_log_scales(values, len(self.segments.t_s))[self.segments.of_node]
        with self.stages("rest"):
            rests = find_rests(self.problem, self._felt, read_states(values, 0, m), final.term.weight == 1.0, log_scale,
                               self.config.rest)
            try:
                found = with_rests(self.engine, Begin(final.model, values), final.term, rests, self.config)
            except EstimationError as error:
                self.notes.append(f"{error}; refined without knowledge of rest")
                return final, NO_REST
        if found is None:
            return final, NO_REST
        term, solution, rests = found
        return self._finished(final.model, term, solution), rests.conclusion()

    def _closed(self, final: _Pass, conclusion: ScaleConclusion) -> tuple[_Pass, LoopConclusion | None]:
        """The solution with the loops that hold, the same where none does, and what became of all."""
        if self.loops is None:
            return final, None
        before = self.loops.conclusion
        if len(before.frames) == 0:
            return final, before
        with self.stages("loops"):
            unsure = final.uncertainty or self._uncertainty(final)
            if unsure.joint is None:
                return final, none_held(before, "how sure the graph is could not be sampled")
            joint, rng = unsure.joint, np.random.default_rng(SEED + 2)
            if conclusion.assumed_sd > 0:
                states = read_states(final.solution.values, 0, len(self.problem))
                joint = with_assumed_scale(joint, states.T_world_body, conclusion.assumed_sd,
                                           self.problem.motions.T_body_camera, rng)
            of_node = None if final.term.segment is None else self.segments.of_node
            try:
                found = close_loops(self.engine, Begin(final.model, final.solution.values), final.term, self.loops,
                                    joint, of_node, self.config)
            except EstimationError as error:
                self.notes.append(f"{error}; refined without loops")
                return final, none_held(before, "the graph has no solution with it")
        if found is None:
            return final, none_held(before)
        term, solution, closed = found
        return self._finished(final.model, term, solution), closed

    def _solve(self) -> tuple[_Pass, ScaleConclusion, float, float]:
        """Solution, what it says of scale, the IMU's chi² at fixed scale and the accelerometer's inflation."""
        start_scale = self._start_scale()
        with self.stages("initialization"):
            start = self._trusted_start(start_scale)
        with self.stages("fixed_scale"):
            fixed = self._fixed_pass(start, start_scale)
        final, conclusion, inflation = self._decide(fixed, start_scale)
        if final.term.segment is not None:
            conclusion = scale_policy.with_gain(conclusion, self.problem.scale_gain_sd)
        return final, conclusion, fixed.imu_chi2, inflation

    def _check_solvable(self) -> None:
        if not self.problem.imu_usable.any():
            raise EstimationError("graph: no frame interval has usable IMU data")

    def _start_scale(self) -> float:
        if self.problem.scale_log_sd <= scale_policy.VAGUE_PRIOR_SD or self.config.scale.policy == "fixed":
            return self.problem.scale_log_mean
        with self.stages("scale_search"):
            return search_log_scale(self.problem, self.config)

    def _trusted_start(self, log_scale: float) -> Begin:
        """A start in whose stretches the IMU agrees with the rest, or is trusted less."""
        self.problem = self.bias_changes.let_go(self.problem)
        start = self._start(log_scale, 1.0)
        suspects = suspect_stretches(start) if isinstance(start.values, ChainState) and not self.bias_changes else []
        if suspects:
            with self.stages("bias_changes"):
                self.bias_changes = find_bias_changes(self.problem, self.config, self.segments, start, suspects)
        if suspects and self.bias_changes:
            self.problem = self.bias_changes.let_go(self.problem)
            start = self._start(log_scale, 1.0)
        for without_imu in (False, True):
            bad = contradicted(start.stretches)
            if not bad:
                break
            self.problem, words = demoted(self.problem, bad, without_imu)
            self.notes += words
            start = self._start(log_scale, 1.0)
        return start

    def _start(self, log_scale: float, inflation: float) -> Begin:
        return self.engine.begin(self.problem, self.config, log_scale, inflation)

    def _fixed_pass(self, start: Begin, log_scale: float) -> _Pass:
        motions = self.problem.motions
        term = MotionTerm(motions, None, log_scale, self.config.robust.huber, np.ones(len(motions)))
        solution = self.engine.solve(start, term, self.config.solver.max_iterations, COARSE_TOLERANCE)
        return self._finished(start.model, term, solution)

    def _finished(self, model: Any, term: MotionTerm, solution: Solution) -> _Pass:
        chi2 = scale_policy.imu_chi2(solution.native_cost, int(self.problem.imu_usable.sum()))
        return _Pass(model, term, solution, chi2)

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
        count = len(self.segments.t_s)
        begin = self.engine.free(Begin(fixed.model, fixed.solution.values), self.problem, self.segments,
                                 self.config.scale.walk_per_sqrt_s, start_scale)
        term = replace(fixed.term, segment=self.segments.of_node[self.problem.motions.i])
        with self.stages("free_scale"):
            solution = self.engine.solve(begin, term, self.config.solver.max_iterations, COARSE_TOLERANCE)
        with self.stages("gate"):
            final = self._gated(self._finished(begin.model, term, solution))
        with self.stages("covariances"):
            final = replace(final, uncertainty=self._uncertainty(final))
        assert final.uncertainty is not None
        log_scale = read_log_scales(final.solution.values, count)
        share = len(final.rejected) / len(self.problem.motions)
        signal = final.term.signal(final.solution.values)
        return final, FreePass(final.imu_chi2, log_scale, np.sqrt(final.uncertainty.log_scale_variance),
                               self.segments.t_s - self.problem.t_s[0], share, signal)

    def _uncertainty(self, final: _Pass) -> Uncertainty:
        estimated = final.term.segment is not None
        begin = Begin(final.model, final.solution.values)
        segments = self.segments if estimated else None
        unsure = self.engine.uncertainty(begin, final.term, segments, np.random.default_rng(SEED))
        if self.problem.error_correlation_s == 0:
            return unsure
        return with_lasting_errors(self.engine, begin, final.term, self.problem, segments, unsure,
                                   np.random.default_rng(SEED + 3))

    def _gated(self, huber: _Pass) -> _Pass:
        """Reject what lies beyond the gate, solve as Gaussian, narrow the gate, and look again until it is settled."""
        current, gate, solver = huber, self.config.robust.gate, self.config.solver
        for wider in GATE_NARROWS:
            squared = current.solution.squared_norm
            accepted = squared < wider * gate
            if current.term.huber is None and wider == 1 and (accepted == (current.term.weight == 1.0)).all():
                break
            weight = np.where(accepted, 1.0, GATED_SHARE / np.maximum(squared, gate))
            term = replace(current.term, huber=None, weight=weight)
            tolerance = COARSE_TOLERANCE if wider > 1 else solver.relative_tolerance
            solution = self.engine.solve(Begin(current.model, current.solution.values), term, solver.max_iterations,
                                         tolerance)
            current = self._finished(current.model, term, solution)
        return current

    def _read(self, final: _Pass, conclusion: ScaleConclusion, fixed_chi2: float, inflation: float) -> Estimate:
        m, segments = len(self.problem), len(self.segments.t_s)
        estimated = final.term.segment is not None
        uncertainty = final.uncertainty or self._uncertainty(final)
        cov, joint = uncertainty.cov, uncertainty.joint
        states = read_states(final.solution.values, 0, m)
        T = states.T_world_body
        assumed, T_body_camera = conclusion.assumed_sd, self.problem.motions.T_body_camera
        if estimated:
            of_node = self.segments.of_node
            log_scale = read_log_scales(final.solution.values, segments)[of_node]
            log_scale_sd = np.sqrt(uncertainty.log_scale_variance[of_node] + assumed**2)
        else:
            log_scale, log_scale_sd = np.full(m, conclusion.log_mean), np.full(m, conclusion.log_sd)
        if assumed > 0:
            cov = add_scale_uncertainty(T, cov, assumed, T_body_camera)
            joint = None if joint is None else with_assumed_scale(
                joint, T, assumed, T_body_camera, np.random.default_rng(SEED + 1))
        return Estimate(T, cov, states.v, states.gyro_bias, states.accel_bias, log_scale, log_scale_sd, conclusion,
                        final.rejected, fixed_chi2, inflation, joint, tuple(self.notes),
                        bias_steps=self.bias_changes.steps, bias_wanders=self.bias_changes.told_wanders)
