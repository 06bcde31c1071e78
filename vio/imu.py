"""Inertial samples, their noise, and how they are cut at frame times.

Conventions: gyro in rad/s, accelerometer = specific force in m/s² (at rest +9.81 upward), both in
body axes. A stamp is the CENTRE of the time the sensor averaged over, so a sample speaks for the
span half-way to its neighbours (its cell). Noise figures are continuous densities.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.errors import ImuError

Array = NDArray[np.float64]

GRAVITY_M_S2 = 9.81
GAP_LIMIT_S = 0.5
LEAST_LEVER = 0.02
"""Of a ramp over an interval, whose pieces of no length would have 1/12."""


@dataclass(frozen=True)
class ImuNoise:
    """Continuous noise of one IMU. Defaults: Bosch BMI270 data sheet, as a capsule might carry.

    A data sheet's "angle random walk" is the *density* here; the `*_walk_*` fields are bias walks.
    """

    gyro_density_rad_s_rthz: float = 1.22e-4
    accel_density_m_s2_rthz: float = 1.57e-3
    gyro_walk_rad_s2_rthz: float = 2e-6
    accel_walk_m_s3_rthz: float = 1e-4
    rate_hz: float = 40.0
    gyro_range_rad_s: float | None = None
    """Full scale of the gyro; None when unknown (saturation is then found by repeated extremes)."""
    accel_range_m_s2: float | None = None
    """Full scale of the accelerometer; None when unknown."""

    def __post_init__(self) -> None:
        for name in ("gyro_density_rad_s_rthz", "accel_density_m_s2_rthz", "gyro_walk_rad_s2_rthz",
                     "accel_walk_m_s3_rthz", "rate_hz"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ImuError(f"imu noise: {name} is {value}, must be a positive number; see the sensor's data sheet")


@dataclass(frozen=True)
class ImuSamples:
    """N inertial samples in body axes."""

    t_ns: NDArray[np.int64]
    """(N,) stamps in nanoseconds, on the clock of the recording."""
    gyro_rad_s: Array
    """(N, 3) angular rate."""
    accel_m_s2: Array
    """(N, 3) specific force."""

    def __len__(self) -> int:
        return len(self.t_ns)

    @classmethod
    def none(cls) -> ImuSamples:
        """No samples: what a recording without an IMU holds."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True)
class Gap:
    """A hole in the IMU stream, in seconds on the clock the caller used."""

    start_s: float
    end_s: float


@dataclass(frozen=True)
class ImuPieces:
    """The IMU between consecutive frames, as constant pieces: what a preintegrator is fed.

    Interval k (frame k to k+1) owns pieces `first[k]:first[k+1]`.
    """

    gyro_rad_s: Array
    """(P, 3)"""
    accel_m_s2: Array
    """(P, 3) specific force in body axes at the START of the piece."""
    dt_s: Array
    """(P,) lengths, all positive; they add up to the frame interval."""
    first: NDArray[np.int64]
    """(M+1,) index of each interval's first piece."""
    longest_s: Array = field(repr=False)
    """(M,) distance between neighbouring stamps at its largest within each interval."""


def find_gaps(t_s: ArrayLike, limit_s: float = GAP_LIMIT_S) -> list[Gap]:
    """Holes longer than `limit_s` between consecutive stamps (N,) [s]."""
    t = np.asarray(t_s, float)
    return [Gap(float(t[k]), float(t[k + 1])) for k in np.flatnonzero(np.diff(t) > limit_s)]


def check_coverage(imu_t_s: Array, frame_t_s: Array) -> None:
    """Make sure that the samples reach from the first frame to the last.

    Raises:
        ImuError: a frame lies more than one sample period before or after all samples.
    """
    if len(imu_t_s) == 0:
        raise ImuError("imu: no samples; give a stream that covers all frames")
    period = float(np.median(np.diff(imu_t_s))) if len(imu_t_s) > 1 else 0.0
    slack = 1.5 * period
    late, early = imu_t_s[0] - frame_t_s[0], frame_t_s[-1] - imu_t_s[-1]
    if late > slack or early > slack:
        raise ImuError(
            f"imu covers {imu_t_s[0]:.3f} to {imu_t_s[-1]:.3f} s but frames run from {frame_t_s[0]:.3f} to "
            f"{frame_t_s[-1]:.3f} s; give the whole IMU log or cut the frames (limit: one sample, {slack:.3f} s)"
        )


def split_at_frames(samples: ImuSamples, imu_t_s: ArrayLike, frame_t_s: ArrayLike,
                    gyro_bias_rad_s: ArrayLike = (0.0, 0.0, 0.0), *, ramps: bool = True) -> ImuPieces:
    """Cut every sample's cell at the frame times, and turn each force into the axes at its piece's start.

    A piece takes its sample's average, carried along the signal's slope from the sample's stamp to the
    piece's centre: this leaves whole cells as they are and tells the two halves of a cut one apart.
    A zero-order-hold integrator rotates a force with the attitude at the START of the step, while a
    sensor averages over its whole cell. Rotating the force by the gyro from piece centre to piece
    start, `Exp(omega dt / 2) f`, removes the leak of gravity that would follow. What a slope within a piece
    does to the position is put into a ramp of the forces over the interval.

    Args:
        samples: N samples.
        imu_t_s: (N,) their stamps on the frames' clock [s], strictly increasing.
        frame_t_s: (M+1,) frame times [s], strictly increasing, covered by the samples.
        gyro_bias_rad_s: (3,) what is known of the gyro's bias; it is left out of that rotation (0.5 deg/s would
            tilt every force by 0.006 deg at 40 Hz) but stays in the pieces' rates.
        ramps: for forces that are integrated; without, they are what was felt.

    Raises:
        ImuError: the samples do not reach over all frames.
    """
    t, frames = np.asarray(imu_t_s, float), np.asarray(frame_t_s, float)
    dt, owner, offset, interval = _cut_cells(t, frames)
    m = len(frames) - 1
    gyro = samples.gyro_rad_s[owner] + offset * _slope(samples.gyro_rad_s, t)[owner]
    slope = _slope(samples.accel_m_s2, t)[owner]
    force = samples.accel_m_s2[owner] + offset * slope
    rate = gyro - np.asarray(gyro_bias_rad_s)
    turn = se3.so3_exp(rate * (0.5 * dt)[:, None])
    accel = (turn @ force[:, :, None])[:, :, 0]
    if ramps:
        jerk = (turn @ (slope + np.cross(rate, force))[:, :, None])[:, :, 0]
        accel = accel + _slopes_as_constants(jerk, dt, interval, m)
    first = np.searchsorted(interval, np.arange(m + 1))
    return ImuPieces(gyro, accel, dt, first.astype(np.int64), _longest_spacing(t, frames))


def _cut_cells(t: Array, frames: Array) -> tuple[Array, NDArray[np.int64], Array, NDArray[np.int64]]:
    """Cells of samples at t (N,) cut at frames (M+1,): P pieces' lengths, samples, centres after those, intervals.

    Raises:
        ImuError: the samples do not reach over all frames.
    """
    check_coverage(t, frames)
    middle = 0.5 * (t[1:] + t[:-1])
    inner = middle[np.searchsorted(middle, frames[0], "right"):np.searchsorted(middle, frames[-1], "left")]
    place = np.searchsorted(inner, frames, "left")
    cuts = np.insert(inner, place, frames)
    start, dt = cuts[:-1], np.diff(cuts)
    keep = dt > 1e-9  # stamps and frames closer than a nanosecond are the same instant
    start, dt = start[keep], dt[keep]
    owner = np.searchsorted(middle, start + 0.5 * dt)
    interval = np.searchsorted(frames, start + 0.5 * dt) - 1
    length = np.bincount(interval, weights=dt, minlength=len(frames) - 1)
    dt = dt * (np.diff(frames) / length)[interval]
    return dt, owner, (start + 0.5 * dt - t[owner])[:, None], interval


def _slopes_as_constants(jerk: Array, dt: Array, interval: NDArray[np.int64], intervals: int) -> Array:
    """What to add to constant forces (P, 3) so that their double integral is that of forces with slopes.

    A slope within a piece of length h moves the body by -jerk h³/12 and leaves its velocity alone. Held constant, an
    oscillation of angular frequency w comes out shorter by (w h)²/12: 2 % at 3 Hz and 40 samples per second. A ramp
    over the whole interval, whose mean is zero, moves the body by their sum; that the body turns a little meanwhile
    is of higher order.

    Args:
        jerk: (P, 3) change of the force per second, in axes that do not turn.
        dt: (P,)
        interval: (P,) frame interval of each piece, from 0 to `intervals`, not decreasing.
        intervals: how many there are.
    """
    end = np.cumsum(dt)
    length = np.bincount(interval, dt, intervals)
    left = np.cumsum(length)[interval] - end + 0.5 * dt  # from the piece's middle to the interval's end
    centred = left - 0.5 * length[interval]
    lever = np.bincount(interval, dt * centred**2, intervals)
    moved = np.stack([np.bincount(interval, -jerk[:, k] * dt**3 / 12, intervals) for k in range(3)], axis=1)
    enough = lever > LEAST_LEVER * length**3  # an interval of one piece has no room for a ramp
    ramp = np.where(enough[:, None], moved / np.where(enough, lever, 1.0)[:, None], 0.0)
    return np.asarray(ramp[interval] * centred[:, None])


def _slope(signal: Array, t: Array) -> Array:
    """(N, 3) central differences per second; at the ends their neighbour's, for one-sided ones carry twice the noise.

    A live capsule's newest sample is an end: with one-sided differences its position came out up to twice as far
    off under collisions (measured).
    """
    if len(t) < 3:
        return np.zeros_like(signal) + (signal[-1:] - signal[:1]) / max(float(t[-1] - t[0]), 1e-9)
    slope = (signal[2:] - signal[:-2]) / (t[2:] - t[:-2])[:, None]
    return np.concatenate([slope[:1], slope, slope[-1:]])


def _longest_spacing(t: Array, frames: Array) -> Array:
    """(M,) largest distance between neighbouring stamps that touches each frame interval."""
    spacing = np.diff(t)
    lo = np.clip(np.searchsorted(t, frames[:-1], "right") - 1, 0, len(spacing) - 1)
    hi = np.clip(np.searchsorted(t, frames[1:], "left"), lo + 1, len(spacing))
    edges = np.column_stack([lo, hi]).ravel()
    padded = np.append(spacing, 0.0)
    return np.maximum.reduceat(padded, edges)[::2]


def gyro_rotations(samples: ImuSamples, imu_t_s: ArrayLike, frame_t_s: ArrayLike,
                   gyro_bias_rad_s: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Gyro rotation (M, 3, 3) from each frame to the next: `preintegrate_rotation` of `split_at_frames`, less work.

    Args:
        samples: N samples.
        imu_t_s: (N,) their stamps on the frames' clock [s], strictly increasing.
        frame_t_s: (M+1,) frame times [s], strictly increasing, covered by the samples.
        gyro_bias_rad_s: (3,) removed.

    Raises:
        ImuError: the samples do not reach over all frames.
    """
    t, frames = np.asarray(imu_t_s, float), np.asarray(frame_t_s, float)
    dt, owner, offset, interval = _cut_cells(t, frames)
    gyro = samples.gyro_rad_s[owner] + offset * _slope(samples.gyro_rad_s, t)[owner]
    return _rotations(gyro - np.asarray(gyro_bias_rad_s), dt, np.searchsorted(interval, np.arange(len(frames))))


def preintegrate_rotation(pieces: ImuPieces, gyro_bias_rad_s: ArrayLike) -> Array:
    """Gyro rotation (M, 3, 3) from each frame to the next, `R_body_k_body_k1`, with a constant bias removed."""
    return _rotations(pieces.gyro_rad_s - np.asarray(gyro_bias_rad_s, float), pieces.dt_s, pieces.first)


def _rotations(rate: Array, dt: Array, first: NDArray[np.int64]) -> Array:
    """Products (M, 3, 3) of the turns by pieces at rates (P, 3), interval k's from `first[k]` to `first[k+1]`."""
    steps = se3.so3_exp(rate * dt[:, None])
    counts = np.diff(first)
    out = np.broadcast_to(np.eye(3), (len(counts), 3, 3)).copy()
    for offset in range(int(counts.max(initial=0))):
        if (counts > offset).all():
            out = out @ steps[first[:-1] + offset]
        else:
            active = counts > offset
            out[active] = out[active] @ steps[first[:-1][active] + offset]
    return out
