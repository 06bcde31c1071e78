"""Relative motions as a learned network would report them, drawn from the truth: an unbiased test bench.

The error model: the scale is unknown and drifts, noise grows with the step and varies from frame to frame,
the reported covariance is miscalibrated, and a few motions are grossly wrong while reporting nothing unusual.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.errors import SimulationError
from vio.motions import RelativeMotions
from vio.trajectory import Trajectory

Array = NDArray[np.float64]

OUTLIER_STEPS = (3.0, 15.0)  # length of an outlier's extra translation, in median steps
OUTLIER_ROTATION_RAD = float(np.deg2rad(10.0))  # per axis, standard deviation


@dataclass(frozen=True)
class NetworkMotions:
    """Motions between consecutive frames with everything that an estimator must not know."""

    motions: RelativeMotions
    true_log_scale: Array
    """(N,) s of every motion: metric translation = exp(s) · motion units."""
    is_outlier: NDArray[np.bool_]
    """(N,)"""


def network_like_motions(
    truth: Trajectory,
    T_body_camera: ArrayLike,
    seed: int | np.random.Generator,
    *,
    scale_log_mean: float = float(np.log(0.8)),
    scale_prior_sd: float = 0.10,
    scale_walk_per_sqrt_1000_frames: float = 0.10,
    rotation_sd_rad: float = float(np.deg2rad(0.3)),
    translation_rel: float = 0.03,
    translation_abs_m: float = 5e-5,
    heteroscedastic_sd: float = 0.4,
    reported_sd: float = 0.2,
    outliers: float = 0.02,
    burst_length: int = 1,
) -> NetworkMotions:
    """Camera motions between consecutive poses of `truth`, in motion units, with 6×6 covariances as reported.

    Args:
        truth: poses of the body at M frames; N = M - 1 motions come out.
        T_body_camera: (4, 4) camera pose in the body, with its lever arm [m].
        seed: integer or generator; the same seed gives the same motions.
        scale_log_mean: mean of the reported prior of s = ln(metres per motion unit).
        scale_prior_sd: its standard deviation; the true first s is drawn from this prior.
        scale_walk_per_sqrt_1000_frames: standard deviation of the change of s over 1000 frames (random walk).
        rotation_sd_rad: rotation noise per axis.
        translation_rel: translation noise per axis, as a share of the camera's step.
        translation_abs_m: translation noise per axis that is always there [m].
        heteroscedastic_sd: log-normal spread of the true noise from frame to frame.
        reported_sd: log-normal error of the reported standard deviations; NEES per dof is exp(2 reported_sd²).
        outliers: expected share of gross errors, in [0, 1).
        burst_length: how many motions in a row an outlier spoils.

    Raises:
        SimulationError: fewer than 2 poses, a negative standard deviation, or an impossible share or burst length.
    """
    _check(truth, outliers, burst_length, {
        "scale_prior_sd": scale_prior_sd, "scale_walk_per_sqrt_1000_frames": scale_walk_per_sqrt_1000_frames,
        "rotation_sd_rad": rotation_sd_rad, "translation_rel": translation_rel, "translation_abs_m": translation_abs_m,
        "heteroscedastic_sd": heteroscedastic_sd, "reported_sd": reported_sd})
    rng = np.random.default_rng(seed)
    T_world_camera = truth.T_world_body @ np.asarray(T_body_camera, float)
    T_true = se3.inverse(T_world_camera[:-1]) @ T_world_camera[1:]
    n = len(T_true)
    step_m = np.linalg.norm(T_true[:, :3, 3], axis=1)

    change = scale_walk_per_sqrt_1000_frames / np.sqrt(1000.0) * rng.standard_normal(n)
    change[0] = scale_prior_sd * rng.standard_normal()
    log_scale = scale_log_mean + np.cumsum(change)
    unit_per_m = np.exp(-log_scale)
    spread = np.exp(heteroscedastic_sd * rng.standard_normal(n))
    sd = np.empty((n, 6))
    sd[:, :3] = (rotation_sd_rad * spread)[:, None]
    sd[:, 3:] = ((translation_rel * step_m + translation_abs_m) * unit_per_m * spread)[:, None]
    error = sd * rng.standard_normal((n, 6))
    reported = sd * np.exp(reported_sd * rng.standard_normal(n))[:, None]

    is_outlier = _outlier_mask(n, outliers, burst_length, rng)
    gross = rng.standard_normal((n, 6))
    gross[:, :3] *= OUTLIER_ROTATION_RAD
    size = np.median(step_m) * rng.uniform(*OUTLIER_STEPS, n) * unit_per_m
    gross[:, 3:] *= (size / np.linalg.norm(gross[:, 3:], axis=1))[:, None]
    error[is_outlier] += gross[is_outlier]

    T_true[:, :3, 3] *= unit_per_m[:, None]
    cov = np.zeros((n, 6, 6))
    cov[:, np.arange(6), np.arange(6)] = reported**2
    motions = RelativeMotions(truth.t_s[:-1] - truth.t_s[0], truth.t_s[1:] - truth.t_s[0], T_true @ se3.exp(error), cov,
                              float(scale_log_mean), float(scale_prior_sd), meta={"method": "network_like_motions"})
    return NetworkMotions(motions, log_scale, is_outlier)


def _outlier_mask(count: int, share: float, burst_length: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(count,) bool: bursts start at random so that about `share` of all motions are spoiled."""
    start_share = 1 - (1 - share) ** (1 / burst_length)
    starts = rng.random(count + burst_length - 1) < start_share
    mask = np.zeros(count, bool)
    for offset in range(burst_length):
        mask |= starts[offset:offset + count]
    return mask


def _check(truth: Trajectory, outliers: float, burst_length: int, deviations: dict[str, float]) -> None:
    if len(truth) < 2:
        raise SimulationError(f"network-like motions: {len(truth)} pose in the truth; at least 2 make a motion")
    for name, value in deviations.items():
        if not (np.isfinite(value) and value >= 0):
            raise SimulationError(f"network-like motions: {name} is {value}; give a number ≥ 0")
    if not deviations["rotation_sd_rad"] > 0 or not deviations["translation_abs_m"] > 0:
        raise SimulationError("network-like motions: rotation_sd_rad and translation_abs_m must be above 0; "
                              "a reported covariance cannot be singular")
    if not 0 <= outliers < 1:
        raise SimulationError(f"network-like motions: outliers is {outliers}; give a share in [0, 1)")
    if isinstance(burst_length, bool) or burst_length != int(burst_length) or burst_length < 1:
        raise SimulationError(f"network-like motions: burst_length is {burst_length}; give a whole number ≥ 1")
