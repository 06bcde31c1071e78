"""The one value every estimator returns, and the fallback that needs no estimator at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.joint import SEED, JointSamples, chain_samples, stretch_directions, with_assumed_scale
from fusion.problem import Problem
from fusion.result import NO_REST, BiasStep, BiasWander, LoopConclusion, RestConclusion, ScaleConclusion
from vio import se3
from vio.motions import RelativeMotions, chain_motions

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """States at all M nodes of a problem."""

    T_world_body: Array
    """(M, 4, 4)"""
    cov: Array
    """(M, 6, 6) right perturbation, rotation first."""
    velocity_m_s: Array
    """(M, 3)"""
    gyro_bias_rad_s: Array
    """(M, 3)"""
    accel_bias_m_s2: Array
    """(M, 3)"""
    log_scale: Array
    """(M,)"""
    log_scale_sd: Array
    """(M,)"""
    scale: ScaleConclusion
    rejected: NDArray[np.int64]
    """Motions that were gated or inflated as outliers."""
    imu_chi2_per_dof: float | None = None
    imu_inflation: float = 1.0
    joint: JointSamples | None = None
    """How the errors of all poses hang together; None where it could not be sampled."""
    notes: tuple[str, ...] = ()
    """Where less than the whole of the estimator was used, and why."""
    loops: LoopConclusion | None = None
    """What became of the loops; None where none was asked for, or the estimator takes none."""
    bias_steps: tuple[BiasStep, ...] = ()
    """Where the IMU's biases stepped."""
    bias_wanders: tuple[BiasWander, ...] = ()
    """Where they wander more than the noise card says."""
    rest: RestConclusion = NO_REST
    """Where the capsule lay still; nothing where the estimator does not ask."""
    translation_noise: float = 1.0
    """Factor by which the problem's noise of the translations was corrected; 1 where it was kept."""


def add_scale_uncertainty(T_world_body: Array, cov: Array, log_scale_sd: float, T_body_camera: Array) -> Array:
    """Covariances (M, 6, 6) widened for a scale that was assumed, not estimated.

    A scale error stretches the CAMERA's track about its first position and turns nothing, so the body is
    shifted by as much as the camera: d(position)/ds = camera's position - its first.
    """
    g = np.zeros((len(cov), 6))
    g[:, 3:] = stretch_directions(T_world_body, T_body_camera)
    widened: Array = cov + log_scale_sd**2 * g[:, :, None] * g[:, None, :]
    return widened


def motions_estimate(problem: Problem, motions: RelativeMotions, T_world_first: Array, tilt_sd_rad: float) -> Estimate:
    """Chain the motions alone at the prior scale, with propagated covariances: the last resort.

    Roll and pitch of the first pose come from gravity; nothing corrects them afterwards.
    """
    T_body_camera = problem.motions.T_body_camera
    trajectory, _ = chain_motions(motions, problem.t_s, T_body_camera, T_world_first)
    T = trajectory.T_world_body
    first_cov, step_cov = _step_covariances(problem, T, tilt_sd_rad)
    cov = _propagate(T, first_cov, step_cov)
    rng = np.random.default_rng(SEED)
    m = len(problem)
    sd = problem.scale_log_sd
    joint = with_assumed_scale(chain_samples(T, first_cov, step_cov, rng), T, sd, T_body_camera, rng)
    velocity = np.gradient(T[:, :3, 3], problem.t_s, axis=0)
    cov = add_scale_uncertainty(T, cov, sd, T_body_camera)
    return Estimate(
        T, cov, velocity, np.tile(problem.gyro_bias_rad_s, (m, 1)), np.zeros((m, 3)),
        np.full(m, problem.scale_log_mean), np.full(m, sd),
        ScaleConclusion("fixed", problem.scale_log_mean, sd, "no estimator ran; the prior scale is used as it is"),
        np.zeros(0, np.int64), joint=joint,
    )


def _step_covariances(problem: Problem, T: Array, tilt_sd_rad: float) -> tuple[Array, Array]:
    """Covariance (6, 6) of the first pose and (M-1, 6, 6) of the body's motions."""
    m = len(T)
    Q = np.zeros((m - 1, 6, 6))
    Q[:] = np.diag([0.5**2] * 3 + [0.05**2] * 3)  # a pair no motion measured
    motions, scale = problem.motions, np.exp(problem.scale_log_mean)
    surest = motions.surest_neighbours(m)
    measured = surest >= 0
    lower = np.linalg.inv(motions.whiten[surest[measured]])
    to_body = se3.adjoint(motions.T_body_camera) @ np.diag([1.0] * 3 + [scale] * 3)
    Q[measured] = to_body @ lower @ np.swapaxes(lower, 1, 2) @ to_body.T
    R0 = T[0, :3, :3]
    first = np.zeros((6, 6))
    first[:3, :3] = R0.T @ np.diag([tilt_sd_rad**2, tilt_sd_rad**2, 1e-12]) @ R0
    first[3:, 3:] = 1e-12 * np.eye(3)
    return first, Q


def _propagate(T: Array, first_cov: Array, step_cov: Array) -> Array:
    """Covariance of chained motions: Σ_{k+1} = Ad Σ_k Adᵀ + Q, in the body axes of each pose."""
    back = se3.adjoint(se3.inverse(se3.inverse(T[:-1]) @ T[1:]))
    cov = np.zeros((len(T), 6, 6))
    cov[0] = first_cov
    for k in range(len(T) - 1):
        cov[k + 1] = back[k] @ cov[k] @ back[k].T + step_cov[k]
    return cov
