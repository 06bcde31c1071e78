"""Everything an estimator needs, checked and aligned: nodes, IMU pieces, whitened motions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.scaled_motion import ScaledMotions, make_motions
from fusion.vibration import vibration_inflation
from vio import se3
from vio.errors import MotionsError
from vio.imu import Gap, ImuNoise, ImuPieces, ImuSamples, find_gaps, gyro_rotations, split_at_frames
from vio.imu_checks import check_imu, saturated_samples
from vio.motions import RelativeMotions, match_frames
from vio.recording import Recording, check_refinable

Array = NDArray[np.float64]

SATURATION_INFLATION = 50.0
"""Factor on a sensor's density in intervals where one of its axes sits at full scale."""
HOLE_RATIO = 1.5
"""Sample spacing over the nominal one above which an interval's noise is inflated."""
UNCHECKED = 3.0
"""Factor on the noise of motions in an IMU gap: one motion in fifty that is ten degrees off, spread over all."""
CARRIED_S = 10.0
"""For which inertial samples alone carry a position; after it, half a metre is lost."""
BIAS_FRAMES = 3000
"""Frames used for the robust initial gyro bias."""


@dataclass(frozen=True)
class Problem:
    """One estimation problem of M nodes (frames) and N motions."""

    name: str
    t_s: Array
    """(M,) node times."""
    first_frame: int
    """Number of node 0's frame in the recording."""
    pieces: ImuPieces
    """IMU of the M-1 intervals."""
    imu_usable: NDArray[np.bool_]
    """(M-1,) False where a gap, or a long stretch without motions, makes the interval's inertial factor worthless."""
    gaps: tuple[Gap, ...]
    accel_inflation: Array
    """(M-1,) factor on the accelerometer density: missing samples, vibration inside a sample."""
    gyro_inflation: Array
    """(M-1,) factor on the gyro density."""
    motions: ScaledMotions
    scale_log_mean: float
    scale_log_sd: float
    noise: ImuNoise
    gyro_bias_rad_s: Array
    """(3,) robust initial value: median disagreement of measured and gyro rotation."""
    samples: ImuSamples
    """What `pieces` were cut from, whole recording."""
    imu_t_s: Array
    """(S,) their stamps on the frames' clock."""
    scale_gain_sd: float = 0.0
    """How far the motions' single steps may be scaled otherwise than the path, in log (`meta` of the motions)."""
    error_correlation_s: float = 0.0
    """How long errors of the motions' translations last (`meta` of the motions); 0 = no longer than a motion."""
    motion_noise: tuple[float, float] = (1.0, 1.0)
    """Factors on the noise of rotation and translation that the motions claimed; already in `motions`."""
    bias_slack: Array | None = None
    """(M-1, 2) sd by which accelerometer [m/s²] and gyro bias [rad/s] may change over an interval beyond their random
    walk; None = nowhere."""

    @property
    def dt_s(self) -> Array:
        """(M-1,) interval lengths."""
        return np.diff(self.t_s)

    def __len__(self) -> int:
        return len(self.t_s)


def build_problem(recording: Recording, motions: RelativeMotions) -> Problem:
    """Check a recording and its motions, and align both on the frames the motions span.

    Raises:
        VioError: any input that cannot be used, in one line.
    """
    check_imu(recording.imu, recording.calibration.imu_noise)  # first: unsorted stamps would look like missing ones
    check_refinable(recording)
    i, j = match_frames(motions, recording.frame_t_s)
    lo, hi = int(i.min()), int(j.max())
    t = recording.frame_t_s[lo:hi + 1]
    imu_t = recording.imu_t_s
    gaps = tuple(find_gaps(imu_t))
    batch = make_motions(i - lo, j - lo, motions.T_i_j, motions.cov, recording.calibration.T_body_camera)
    usable = _usable(t, gaps)
    gyro_bias = _initial_gyro_bias(recording, batch, t, usable)
    batch = _unchecked(batch, usable)
    usable &= ~_blind(batch, t)
    pieces = split_at_frames(recording.imu, imu_t, t, gyro_bias)
    noise = recording.calibration.imu_noise
    holes = _hole_inflation(pieces, imu_t)
    clipped = _saturation_inflation(recording, t)
    accel_inflation, gyro_inflation = vibration_inflation(recording.imu, imu_t, t, noise)
    return Problem(
        name=recording.name, t_s=t, first_frame=lo, pieces=pieces, imu_usable=usable, gaps=gaps,
        accel_inflation=holes * clipped[1] * accel_inflation, gyro_inflation=holes * clipped[0] * gyro_inflation,
        motions=batch,
        scale_log_mean=motions.scale_log_mean, scale_log_sd=motions.scale_log_sd, noise=noise,
        gyro_bias_rad_s=gyro_bias, samples=recording.imu, imu_t_s=imu_t,
        scale_gain_sd=_said_of_itself(motions, "scale_gain_sd", "a standard deviation of the log scale"),
        error_correlation_s=_said_of_itself(motions, "error_correlation_s", "a time in seconds"),
    )


def _said_of_itself(motions: RelativeMotions, key: str, what: str) -> float:
    """A number that the source says of itself in `meta`; the largest of several."""
    sources = [motions.meta, *motions.meta.get("sources", [])]
    given = [meta[key] for meta in sources if key in meta]
    if not all(isinstance(value, (int, float)) and 0 <= value < np.inf for value in given):
        raise MotionsError(f"motions: meta {key} is {given[0]!r}; give {what}, 0 or more")
    return float(max(given, default=0.0))


def with_accelerometer(problem: Problem, accel_m_s2: Array) -> Problem:
    """The problem with other specific forces (S, 3): cut anew, and the vibration in them judged anew."""
    samples = replace(problem.samples, accel_m_s2=accel_m_s2)
    before, after = (vibration_inflation(imu, problem.imu_t_s, problem.t_s, problem.noise)[0]
                     for imu in (problem.samples, samples))
    return replace(problem, samples=samples, accel_inflation=problem.accel_inflation / before * after,
                   pieces=split_at_frames(samples, problem.imu_t_s, problem.t_s, problem.gyro_bias_rad_s))


def _usable(t: Array, gaps: tuple[Gap, ...]) -> NDArray[np.bool_]:
    usable = np.ones(len(t) - 1, bool)
    for gap in gaps:
        usable &= (t[1:] <= gap.start_s) | (t[:-1] >= gap.end_s)
    return usable


def _unchecked(motions: ScaledMotions, usable: NDArray[np.bool_]) -> ScaledMotions:
    """Where the IMU is missing nothing tells an outlier from motion: what is measured there counts less."""
    if usable.all():
        return motions
    missing = np.concatenate([[0], np.cumsum(~usable)])
    alone = missing[motions.j] > missing[motions.i]
    return replace(motions, whiten=motions.whiten / np.where(alone, UNCHECKED, 1.0)[:, None, None])


def _blind(motions: ScaledMotions, t: Array) -> NDArray[np.bool_]:
    """(M-1,) intervals over which the IMU alone would have to carry the position, and cannot."""
    crossed = np.zeros(len(t))
    np.add.at(crossed, motions.i, 1.0)
    np.add.at(crossed, motions.j, -1.0)
    return np.asarray((np.diff(t) > CARRIED_S) & (np.cumsum(crossed)[:-1] == 0))


def _hole_inflation(pieces: ImuPieces, imu_t_s: Array) -> Array:
    ratio = pieces.longest_s / np.median(np.diff(imu_t_s))
    return np.where(ratio > HOLE_RATIO, ratio, 1.0)


def _saturation_inflation(recording: Recording, t: Array) -> tuple[Array, Array]:
    """(M-1,) factors for gyro and accelerometer: large where one of their axes sits at full scale."""
    mask = saturated_samples(recording.imu, recording.calibration.imu_noise)
    edges = np.searchsorted(recording.imu_t_s, t)
    factors = []
    for sensor in (mask[:, :3].any(axis=1), mask[:, 3:].any(axis=1)):
        total = np.concatenate([[0], np.cumsum(sensor)])
        hit = np.diff(total[edges]) > 0
        factors.append(np.where(hit, SATURATION_INFLATION, 1.0))
    return factors[0], factors[1]


def _initial_gyro_bias(recording: Recording, motions: ScaledMotions, t: Array, usable: NDArray[np.bool_]) -> Array:
    """Median of `Log(R_measᵀ R_gyro) / dt` over consecutive motions: robust, needs no graph."""
    surest = motions.surest_neighbours(len(t))
    k = np.flatnonzero((surest >= 0) & usable)[:BIAS_FRAMES]
    if len(k) == 0:
        return np.zeros(3)
    gyro = gyro_rotations(recording.imu, recording.imu_t_s, t[:k[-1] + 2])[k]
    off = se3.so3_log(np.swapaxes(motions.select(surest[k]).body_rotation(), 1, 2) @ gyro)
    bias: Array = np.median(off / np.diff(t)[k, None], axis=0)
    return bias
