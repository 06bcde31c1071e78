"""Metric scale: when the data may free it, when a prior carries it, when it is held, and why."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.body_motion import BodyMotion
from fusion.config import ScaleConfig
from fusion.problem import Problem
from fusion.result import ScaleConclusion
from vio.imu import ImuNoise

Array = NDArray[np.float64]

VAGUE_PRIOR_SD = 0.5
"""Prior sd of the log scale above which the fixed-scale pass starts from a search instead of the mean."""
PLAUSIBLE_SDS = 4.0
"""How many prior sds the freed scale may move before it is disbelieved."""
PLAUSIBLE_REJECTED = 0.4
"""Share of motions that may be gated before the freed scale is disbelieved."""
INFORMATIVE = 0.5
"""The freed scale's sd must be below this share of the prior's to count as measured."""
LEAST_SIGNAL = 1.5
"""Steps over noise below which noise alone would pass for a larger scale: nothing is measured then."""
CALM_CHI2 = 0.75
"""Inertial chi² that a down-weighted accelerometer must reach: a little above the clean value."""
WANDERING = ((1e-4, 2e-3, 0.03), (3e-4, 1e-2, 0.08))
"""Random walks of gyro [rad/s²/√Hz] and accelerometer [m/s³/√Hz] bias that follow a sensor that warms up, and one
whose bias jumps; and what they cost the log scale: it came out 2 % and 5 to 11 % short (measured, 1000 frames)."""
INFLATION_LADDER = (3.0, 10.0, 30.0)
"""Factors on the accelerometer density that are tried when the IMU disagrees with the motions."""
LOUDER_SD = 0.05
"""What an accelerometer that is trusted so much less may cost the log scale: it came out 5 % short in the mean of 12
recordings with uneven breathing (measured, 1000 frames)."""
SWAY_SD = 0.02
"""What taking out a sway may cost the log scale: it came out 2 % short after 2 m/s² had been taken out (measured)."""
QUIET_EXCESS = 3.0
"""Density of the acceleration that the camera does not see, over the accelerometer's: the camera's own noise reaches
2.5 in it (measured, 1000 frames)."""
LOOSE = 30.0
"""Factor with which the accelerometer shows its bias and no longer bends the track that the motions describe."""
GRAVITY_ONLY = 2500.0
"""Factor that leaves the accelerometer nothing but the mean direction of gravity."""


@dataclass(frozen=True)
class Segments:
    """Stretches of the recording that share one log scale."""

    of_node: NDArray[np.int64]
    """(M,) segment of every node."""
    t_s: Array
    """(K,) centre of every segment."""


@dataclass(frozen=True)
class FreePass:
    """What freeing the scale led to, for the policy to judge."""

    imu_chi2: float
    log_scale: Array
    log_scale_sd: Array
    segment_s: Array
    """Centres of the segments, from the first frame."""
    rejected_share: float
    signal: float
    """Root mean square of the steps over their noise."""


def make_segments(t_s: Array, length_s: float) -> Segments:
    """Cut nodes into equal stretches of about `length_s`, at least one."""
    span = max(float(t_s[-1] - t_s[0]), 1e-9)
    count = max(1, round(span / length_s))
    of_node = np.minimum(((t_s - t_s[0]) / span * count).astype(np.int64), count - 1)
    centres = t_s[0] + (np.arange(count) + 0.5) * span / count
    # Sparse frames can leave a stretch empty: renumber what is there.
    present, of_node = np.unique(of_node, return_inverse=True)
    return Segments(of_node.astype(np.int64), centres[present])


def imu_chi2(native_error: float, usable_intervals: int) -> float:
    """2 × cost of the inertial factors and priors over six per interval.

    A rough normaliser, not a true number of degrees of freedom: about 0.5 when all is well.
    """
    return 2 * native_error / (6 * max(usable_intervals, 1))


def reasons_against(free: FreePass, problem: Problem, config: ScaleConfig) -> str | None:
    """Why the freed scale must not be believed; None when it may."""
    if free.imu_chi2 > config.imu_chi2_limit:
        return (f"the IMU disagrees with the motions even with free scale (chi² {free.imu_chi2:.2f} per dof, "
                f"limit {config.imu_chi2_limit:g}): the body moves in ways the camera does not see, or the IMU is not "
                "what its calibration says")
    for end_s in (min(prior_lasts_s(problem, config), free.segment_s[-1]), free.segment_s[-1]):
        part = free.segment_s <= max(end_s, free.segment_s[0])
        moved = abs(float(free.log_scale[part].mean()) - problem.scale_log_mean)
        prior_sd = float(np.hypot(problem.scale_log_sd, walked_sd(end_s, config)))
        allowed = PLAUSIBLE_SDS * prior_sd + 3 * float(free.log_scale_sd[part].mean())
        if moved > allowed:
            return (f"freed scale moved {moved:.2f} in log from the prior in the mean of the first {end_s:.0f} s, more "
                    f"than {PLAUSIBLE_SDS:g} sds of the prior and the walk away from it ({allowed:.2f})")
    if free.rejected_share > PLAUSIBLE_REJECTED:
        return (f"freeing the scale rejected {100 * free.rejected_share:.0f} % of the motions "
                f"(limit {100 * PLAUSIBLE_REJECTED:.0f} %)")
    return None


@dataclass(frozen=True)
class Remedy:
    """One way of trusting the IMU less."""

    inflation: float
    """Factor on the accelerometer density."""
    noise: ImuNoise
    words: str
    scale_sd: float = 0.0
    """What it may cost the log scale beyond what the graph claims."""


def remedies(motion: BodyMotion, noise: ImuNoise) -> list[Remedy]:
    """Ways of trusting the IMU less, least first: not at all where a sway was all, biases that wander, more noise.

    The inertial chi² judges single frame intervals; a slow sway is hardly visible in one and bends the track all
    the same, so no factor below its density at its own frequency is tried.
    """
    excess = motion.left_density_m_s2_rthz / noise.accel_density_m_s2_rthz
    out = []
    if motion.hz > 0 and excess <= QUIET_EXCESS:
        out.append(Remedy(1.0, noise, "accelerometer noise × 1"))
    if motion.hz == 0 or excess <= QUIET_EXCESS:
        for gyro_walk, accel_walk, scale_sd in WANDERING:
            wander = replace(noise, gyro_walk_rad_s2_rthz=max(noise.gyro_walk_rad_s2_rthz, gyro_walk),
                             accel_walk_m_s3_rthz=max(noise.accel_walk_m_s3_rthz, accel_walk))
            out.append(Remedy(1.0, wander, "biases that wander more than the noise card says", scale_sd))
    return out + [Remedy(factor, noise, f"accelerometer noise × {factor:g}", LOUDER_SD)
                  for factor in INFLATION_LADDER if factor >= excess]


def widened(conclusion: ScaleConclusion, motion: BodyMotion, remedy: Remedy) -> ScaleConclusion:
    """The conclusion with the uncertainty of what was taken out of the accelerometer, or may have wandered in it."""
    extra = float(np.hypot(SWAY_SD if motion.hz > 0 else 0.0, remedy.scale_sd))
    return replace(conclusion, log_sd=float(np.hypot(conclusion.log_sd, extra)), assumed_sd=extra)


def with_gain(conclusion: ScaleConclusion, gain_sd: float) -> ScaleConclusion:
    """The conclusion for a source whose single steps, which the IMU measures, are scaled otherwise than its path."""
    if gain_sd == 0:
        return conclusion
    reason = f"{conclusion.reason}; {gain_sd:.2f} in log added, for the source scales quick motion otherwise than slow"
    return replace(conclusion, log_sd=float(np.hypot(conclusion.log_sd, gain_sd)), reason=reason,
                   assumed_sd=float(np.hypot(conclusion.assumed_sd, gain_sd)))


def assumed_sd(problem: Problem, config: ScaleConfig) -> float:
    """Sd of the recording's mean log scale where it is not measured: the prior's, and the walk away from it."""
    if problem.scale_log_sd == 0:
        return 0.0
    return float(np.hypot(problem.scale_log_sd, walked_sd(float(problem.t_s[-1] - problem.t_s[0]), config)))


def walked_sd(span_s: float, config: ScaleConfig) -> float:
    """How far the mean log scale over a time walks from where it began: walk² T / 3 is its mean square."""
    return float(config.walk_per_sqrt_s * np.sqrt(span_s / 3))


def prior_lasts_s(problem: Problem, config: ScaleConfig) -> float:
    """Time until the log scale has walked as far as its prior is wide."""
    return (problem.scale_log_sd / config.walk_per_sqrt_s) ** 2


def hardly_moved(free: FreePass) -> str:
    """The reason for keeping the prior's scale of a capsule at rest."""
    return (f"the capsule hardly moved: its steps are {free.signal:.2f} times the motions' noise "
            f"(limit {LEAST_SIGNAL:g}), so the prior's scale is kept")


def conclude_free(free: FreePass, problem: Problem) -> ScaleConclusion:
    """Name the outcome of an accepted free pass: measured by the IMU, or carried by the prior."""
    mean, sd = float(free.log_scale.mean()), float(np.sqrt(np.mean(free.log_scale_sd**2)))
    if sd > INFORMATIVE * problem.scale_log_sd:
        return ScaleConclusion("prior", mean, sd,
                               f"too little acceleration to measure scale: its sd {sd:.3f} is more than half the "
                               f"prior's {problem.scale_log_sd:.3f}, so the prior carries it")
    return ScaleConclusion("free", mean, sd,
                           f"measured by the IMU: sd {sd:.3f} in log against the prior's {problem.scale_log_sd:.3f}, "
                           f"IMU chi² {free.imu_chi2:.2f} per dof")
