"""Whether inertial samples can be believed: stamps, units, gravity, saturation, gaps. Run before any estimate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vio.errors import ImuError
from vio.imu import Gap, ImuNoise, ImuSamples, find_gaps
from vio.imu_axes import AXES, check_axes, check_dead_axes, lost_direction, turned_windows

Array = NDArray[np.float64]

STANDARD_G = 9.80665
GRAVITY_RANGE_M_S2 = (7.5, 12.5)
ACCEL_UNITS = (("g", (0.75, 1.3), STANDARD_G), ("mg", (750.0, 1300.0), 1e-3 * STANDARD_G))
GYRO_PEAK_RAD_S = 35.0
"""2000 deg/s, the full scale of common gyros."""

LOST_DIRECTION = 0.25  # mean directions of force this much shorter than 1 would take linear accelerations near 1 g
UNIT_RATIO = 3.0

SMALLEST_FULL_SCALE = (2.0, 17.5)  # rad/s, m/s²: just below the 125 deg/s and 2 g of common sensors
SATURATED_RUN = 3
SATURATED_SHARE = 0.05
"""Of an axis's samples at full scale; above it the signal is lost, below it only those moments are."""
OUTLIER_SPREADS = 5.0
RATE_TOLERANCE = 0.2


@dataclass(frozen=True)
class ImuReport:
    """What was found in samples that passed."""

    rate_hz: float
    """One over the median distance of the stamps."""
    gaps: tuple[Gap, ...]
    """Holes over 0.5 s, in seconds after the first sample."""
    gravity_m_s2: float
    """Median length of the specific force."""
    saturated: dict[str, int]
    """Samples at full scale, by axis; axes without any are left out."""
    warnings: tuple[str, ...]
    """One line for everything that is odd but not fatal."""


def check_imu(samples: ImuSamples, noise: ImuNoise) -> ImuReport:
    """Check samples against physics and their calibration.

    Raises:
        ImuError: fewer than two samples, wrong shapes, a value that is not finite, stamps that do not increase, no
            gravity in the accelerometer (or in other units), a gyro in deg/s, an axis that is dead, swapped or
            reversed, an axis at full scale for more than 5 % of the samples; each with row, time, limit and remedy.
    """
    t_s = _check_stamps(samples)
    _check_finite(samples, t_s)
    check_dead_axes(samples)
    gravity_m_s2 = _check_gravity(samples)
    _check_gyro_unit(samples, t_s)
    rate_hz = 1.0 / float(np.median(np.diff(t_s)))
    gaps = tuple(find_gaps(t_s))
    saturated = find_saturation(samples, noise)
    _check_saturation(saturated, len(samples))
    check_axes(samples, t_s)
    return ImuReport(rate_hz, gaps, gravity_m_s2, saturated, _warnings(samples, noise, rate_hz, gaps, saturated))


def saturated_samples(samples: ImuSamples, noise: ImuNoise) -> NDArray[np.bool_]:
    """Which samples sit at full scale: (N, 6), gyro axes first.

    With a known range: those within 0.1 % of it. Without: runs of three or more equal samples at the axis's
    extreme, if that is as large as a full scale can be and stands out from the rest of the axis.
    """
    values = np.hstack([samples.gyro_rad_s, samples.accel_m_s2])
    mask = np.zeros(values.shape, bool)
    for k in range(len(AXES)):
        full_scale = noise.gyro_range_rad_s if k < 3 else noise.accel_range_m_s2
        axis = values[:, k]
        if full_scale is not None:
            mask[:, k] = np.abs(axis) >= 0.999 * full_scale
        else:
            smallest = SMALLEST_FULL_SCALE[k // 3]
            mask[:, k] = _clipped(axis, smallest) | _clipped(-axis, smallest)
    return mask


def find_saturation(samples: ImuSamples, noise: ImuNoise) -> dict[str, int]:
    """How many samples of each axis sit at full scale; axes without any are left out."""
    counts = saturated_samples(samples, noise).sum(axis=0)
    return {name: int(count) for name, count in zip(AXES, counts, strict=True) if count}


def _check_saturation(saturated: dict[str, int], total: int) -> None:
    for name, count in saturated.items():
        if count > SATURATED_SHARE * total:
            raise ImuError(f"imu: {name} sits at full scale in {count} of {total} samples ({100 * count / total:.0f} %,"
                           f" limit {100 * SATURATED_SHARE:.0f} %); record with a larger range")


def gyro_in_degrees(samples: ImuSamples) -> bool:
    """Whether gravity says that the gyro is in deg/s: overwhelming evidence only, False when undecided.

    Turning every force back by the gyro leaves the direction of gravity, up to linear acceleration. In windows
    where the numbers, read as rad/s, turn by more than 0.3 rad, the mean direction must be lost when they are read
    as rad/s (shorter than 0.75) and kept when they are read as deg/s (its error at least three times smaller).
    """
    return _in_degrees(samples, (samples.t_ns - samples.t_ns[0]) * 1e-9)


def _check_stamps(samples: ImuSamples) -> Array:
    """Seconds after the first sample."""
    n = len(samples)
    for name in ("gyro_rad_s", "accel_m_s2"):
        shape = np.shape(getattr(samples, name))
        if shape != (n, 3):
            raise ImuError(f"imu: {n} stamps but {name} of shape {shape}; expected ({n}, 3)")
    if n < 2:
        raise ImuError(f"imu: {n} samples; at least 2 are needed, give a stream that covers all frames")
    t = samples.t_ns
    bad = t[1:] <= t[:-1]
    if bad.any():
        k = int(np.argmax(bad)) + 1
        word = "repeats" if t[k] == t[k - 1] else "is earlier than"
        raise ImuError(f"imu row {k}: stamp {t[k]} ns {word} {t[k - 1]} ns before it; sort the rows, drop duplicates")
    return np.asarray((t - t[0]) * 1e-9)


def _check_finite(samples: ImuSamples, t_s: Array) -> None:
    finite = np.isfinite(np.hstack([samples.gyro_rad_s, samples.accel_m_s2]))
    if not finite.all():
        k, axis = np.unravel_index(int(np.argmin(finite)), finite.shape)
        raise ImuError(f"imu row {k} at {t_s[k]:.3f} s: {AXES[axis]} is not finite; drop that row")


def _check_gravity(samples: ImuSamples) -> float:
    """Median length of the specific force."""
    median = float(np.median(np.linalg.norm(samples.accel_m_s2, axis=1)))
    low, high = GRAVITY_RANGE_M_S2
    if low <= median <= high:
        return median
    for unit, (least, most), factor in ACCEL_UNITS:
        if least <= median <= most:
            raise ImuError(f"imu: median specific force is {median:.4g}, which looks like {unit}; "
                           f"multiply the accelerometer by {factor:g} to get m/s²")
    raise ImuError(f"imu: median specific force is {median:.4g} m/s² (limits {low:g} to {high:g}): there is no gravity "
                   "in it; give specific force (9.81 upward at rest), not linear acceleration, in m/s²")


def _check_gyro_unit(samples: ImuSamples, t_s: Array) -> None:
    rate = np.abs(samples.gyro_rad_s)
    if rate.max() > GYRO_PEAK_RAD_S:
        k, axis = np.unravel_index(int(np.argmax(rate)), rate.shape)
        raise ImuError(f"imu row {k} at {t_s[k]:.3f} s: {AXES[axis]} is {rate[k, axis]:.4g} rad/s (limit "
                       f"{GYRO_PEAK_RAD_S:g} = 2000 deg/s); multiply by pi/180 if in deg/s, else drop the row")
    if _in_degrees(samples, t_s):
        raise ImuError("imu: turning with the gyro as rad/s scatters the direction of gravity, as deg/s it stays; "
                       "multiply the gyro by pi/180")


def _in_degrees(samples: ImuSamples, t_s: Array) -> bool:
    windows = turned_windows(samples, t_s)
    if len(windows.turns_rad) == 0:
        return False
    as_rad = lost_direction(windows.turns_rad, windows.force_m_s2)
    as_deg = lost_direction(np.deg2rad(windows.turns_rad), windows.force_m_s2)
    return as_rad > LOST_DIRECTION and as_rad > UNIT_RATIO**2 * as_deg


def _clipped(axis: Array, smallest_full_scale: float) -> NDArray[np.bool_]:
    """Samples (N,) in runs of equal values at the maximum of `axis`, if that can be a full scale and is an outlier."""
    top, middle = axis.max(), np.median(axis)
    spread = 1.4826 * np.median(np.abs(axis - middle))
    mask = np.zeros(len(axis), bool)
    if top < smallest_full_scale or top - middle <= OUTLIER_SPREADS * spread:
        return mask
    edges = np.diff(np.concatenate([[0], (axis == top).astype(np.int8), [0]]))
    for begin, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        mask[begin:end] = end - begin >= SATURATED_RUN
    return mask


def _warnings(samples: ImuSamples, noise: ImuNoise, rate_hz: float, gaps: tuple[Gap, ...],
              saturated: dict[str, int]) -> tuple[str, ...]:
    lines = []
    if abs(rate_hz / noise.rate_hz - 1) > RATE_TOLERANCE:
        lines.append(f"imu: samples come at {rate_hz:.4g} Hz but the calibration says {noise.rate_hz:.4g} Hz; "
                     "check that it belongs to this sensor")
    values = np.hstack([samples.gyro_rad_s, samples.accel_m_s2])
    dead = np.ptp(values, axis=0) == 0
    lines += [f"imu: {name} reads {value:.6g} in every sample; is that axis connected?"
              for name, value, constant in zip(AXES, values[0], dead, strict=True) if constant]
    lines += [f"imu: {name} sits at full scale in {count} samples; motion in them is underestimated"
              for name, count in saturated.items()]
    if gaps:
        longest = max(gap.end_s - gap.start_s for gap in gaps)
        lines.append(f"imu: {len(gaps)} gaps over 0.5 s, the longest {longest:.2f} s; motion is not bridged there")
    return tuple(lines)
