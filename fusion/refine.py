"""The policy: graph → EKF → motions alone; every step down with its recorded reason."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.checkpoint import Checkpoint, refinement_key
from fusion.config import RefineConfig
from fusion.correlated_noise import long_run
from fusion.ekf import ekf_estimate
from fusion.estimate import Estimate, motions_estimate
from fusion.graph_estimator import GraphEstimator
from fusion.initialization import level_rotation
from fusion.loops import GraphLoops, check_loops, make_loops, none_held
from fusion.prepare import prepare
from fusion.problem import Problem
from fusion.result import NO_LOOPS, Estimator, ImuConclusion, LoopConclusion, Refinement, View
from fusion.stages import Stages
from vio import se3
from vio.errors import EstimationError
from vio.imu import preintegrate_rotation
from vio.inertial_levels import inertial_levels
from vio.loops import Loops
from vio.motions import RelativeMotions, chain_motions
from vio.recording import Recording
from vio.trajectory import Trajectory

Array = NDArray[np.float64]


def refine(recording: Recording, motions: RelativeMotions, config: RefineConfig | None = None,
           announce: Callable[[str], None] | None = None, resume: str | Path | None = None,
           loops: Loops | None = None) -> Refinement:
    """Turn relative motions and inertial samples into one globally consistent trajectory.

    Args:
        recording: frames' times, IMU and calibration; images are not read.
        motions: measured motions of the camera, from any source.
        config: every knob; defaults when None.
        announce: called with the name of every stage as it begins.
        resume: folder that keeps finished stages of the graph. The same call after a kill reads them back and ends
            with the same bytes; whoever asked for the folder removes it in the end (`checkpoint.unfinished`).
        loops: motions between frames that show the same place again, such as `learned.find_loops` finds; each is used
            only where the graph finds nothing against it. None = none are looked for.

    Returns:
        The refined trajectory with covariances, beside the trajectory of the motions alone at the
        same frames, and the reasons for every choice.

    Raises:
        VioError: an input that cannot be used, in one line.
        EstimationError: a forced estimator failed, or none produced a trajectory.
    """
    config = config or RefineConfig()
    stages = Stages(announce)
    with stages("checks"):
        recording, problem, camera_imu = prepare(recording, motions)
        of_graph = None if loops is None else _of_graph(recording, problem, loops)
    checkpoint = None if resume is None else Checkpoint(resume, refinement_key(recording, motions, config, loops))
    estimate, estimator, reason = _first_that_works(problem, motions, config, stages, checkpoint, of_graph)
    refined = conclude(recording, motions, problem, estimate, estimator, reason, stages)
    return replace(refined, camera_imu=camera_imu, loops=_loop_conclusion(estimate, of_graph))


def _of_graph(recording: Recording, problem: Problem, loops: Loops) -> GraphLoops:
    check_loops(loops, recording.frame_t_s)
    return make_loops(loops, recording.frame_t_s, problem.t_s, problem.motions.T_body_camera, problem.scale_log_mean)


def _loop_conclusion(estimate: Estimate, loops: GraphLoops | None) -> LoopConclusion:
    if estimate.loops is not None:
        return estimate.loops
    return NO_LOOPS if loops is None else none_held(loops.conclusion, "only the graph can use it")


def _first_that_works(problem: Problem, motions: RelativeMotions, config: RefineConfig, stages: Stages,
                      checkpoint: Checkpoint | None,
                      loops: GraphLoops | None) -> tuple[Estimate, Estimator, str | None]:
    reasons: list[str] = []
    if config.estimator in ("auto", "graph"):
        try:
            estimate = _sane(GraphEstimator(problem, config, stages, checkpoint, loops).estimate(), "graph")
            return estimate, "graph", "; ".join(estimate.notes) or None
        except EstimationError as error:
            if config.estimator == "graph":
                raise
            reasons.append(str(error))
    first_R = _level_first(problem)
    try:
        with stages("ekf"):
            estimate = _sane(ekf_estimate(long_run(problem), first_R, config.initial), "ekf")
        return estimate, "ekf", "; ".join(reasons) or None
    except EstimationError as error:
        if config.estimator == "ekf":
            raise
        reasons.append(str(error))
    with stages("motions"):
        first = se3.transform(first_R, np.zeros(3))
        estimate = _sane(motions_estimate(long_run(problem), motions, first, config.initial.tilt_sd_rad), "motions")
    return estimate, "motions", "; ".join(reasons)


def _level_first(problem: Problem) -> Array:
    """Attitude (3, 3) of the first node from gravity and the gyro's first seconds."""
    gyro = preintegrate_rotation(problem.pieces, problem.gyro_bias_rad_s)
    return level_rotation(problem, se3.chain(se3.transform(gyro, np.zeros(3)))[:, :3, :3], 0)


def _sane(estimate: Estimate, name: str) -> Estimate:
    """Reject results that are numbers but not an answer."""
    if not (np.isfinite(estimate.T_world_body).all() and np.isfinite(estimate.cov).all()):
        raise EstimationError(f"{name}: a pose or covariance is not finite")
    smallest = np.diagonal(estimate.cov, axis1=1, axis2=2).min()
    if smallest <= 0:
        raise EstimationError(f"{name}: a pose variance is {smallest:.2g}, must be positive")
    return estimate


def conclude(recording: Recording, motions: RelativeMotions, problem: Problem, estimate: Estimate,
             estimator: Estimator, reason: str | None, stages: Stages) -> Refinement:
    """A refinement from an estimate: beside the motions alone, with truth where there is any."""
    times = problem.t_s
    only, bridged = chain_motions(motions, times, problem.motions.T_body_camera, estimate.T_world_body[0])
    return Refinement(
        name=recording.name, estimator=estimator, fallback_reason=reason,
        trajectory=Trajectory(times, estimate.T_world_body, estimate.cov), velocity_m_s=estimate.velocity_m_s,
        gyro_bias_rad_s=estimate.gyro_bias_rad_s, accel_bias_m_s2=estimate.accel_bias_m_s2,
        log_scale=estimate.log_scale, log_scale_sd=estimate.log_scale_sd, motions_only=only, scale=estimate.scale,
        motion_noise=(problem.motion_noise[0], problem.motion_noise[1] * estimate.translation_noise),
        imu=ImuConclusion(estimate.imu_chi2_per_dof, estimate.imu_inflation, problem.gaps,
                          estimate.bias_steps, estimate.bias_wanders),
        motions_used=len(motions) - len(estimate.rejected), rejected=estimate.rejected, bridged=bridged,
        time_offset_s=recording.calibration.time_offset_s, truth=_truth(recording, times),
        timing_s=dict(stages.seconds), peak_rss_bytes=_peak_rss_bytes(), joint=estimate.joint,
        view=View(problem.first_frame, problem.motions.T_body_camera, recording.calibration.camera,
                  motions.scale_log_mean),
        inertial=inertial_levels(recording.imu, recording.imu_t_s), rest=estimate.rest,
    )


def _truth(recording: Recording, times: Array) -> Trajectory | None:
    if recording.truth is None:
        return None
    inside = (times >= recording.truth.t_s[0] - 1e-9) & (times <= recording.truth.t_s[-1] + 1e-9)
    return recording.truth.interpolate(times[inside]) if inside.any() else None


def _peak_rss_bytes() -> int:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
