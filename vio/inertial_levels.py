"""What the IMU felt along time, in spans short enough to see events and few enough to draw.

Vibration is what is left of the specific force after the parabola that fits it best over one second around (Savitzky
and Golay, Analytical Chemistry 36, 1964): turns under gravity and drifting biases are not vibration, tremor and bumps
are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import convolve1d

from vio.errors import ImuError
from vio.imu import ImuSamples

Array = NDArray[np.float64]

SHORTEST_SPAN_S, MOST_SPANS = 0.25, 2000
SLOW_S = 1.0
"""Length of the running parabola that vibration is measured from."""


@dataclass(frozen=True)
class InertialLevels:
    """Levels in B spans of equal length; NaN where a span holds no sample."""

    t_s: Array
    """(B,) centres of the spans, on the frames' clock."""
    rate_rad_s: Array
    """(B,) root mean square of the angular rate."""
    force_m_s2: Array
    """(B,) root mean square of the specific force."""
    vibration_m_s2: Array
    """(B,) root mean square of the specific force less a running parabola over one second."""

    def __post_init__(self) -> None:
        shapes = {np.shape(getattr(self, name)) for name in ("t_s", "rate_rad_s", "force_m_s2", "vibration_m_s2")}
        if len(shapes) != 1 or len(next(iter(shapes))) != 1:
            raise ImuError(f"inertial levels: four series of one length are needed, found shapes {sorted(shapes)}")


def inertial_levels(samples: ImuSamples, imu_t_s: ArrayLike) -> InertialLevels | None:
    """Levels of N samples; None where there are fewer than two.

    Args:
        samples: N samples, in order of time.
        imu_t_s: (N,) their stamps on the frames' clock [s].
    """
    t = np.asarray(imu_t_s, float)
    if len(t) < 2:
        return None
    span = max(SHORTEST_SPAN_S, float(t[-1] - t[0]) / MOST_SPANS)
    count = min(int((t[-1] - t[0]) / span) + 1, MOST_SPANS)
    owner = np.clip(((t - t[0]) / span).astype(np.int64), 0, count - 1)
    fast = samples.accel_m_s2 - _slow(samples.accel_m_s2, t)
    rate, force, vibration = (_rms(values, owner, count) for values in (samples.gyro_rad_s, samples.accel_m_s2, fast))
    return InertialLevels(t[0] + (np.arange(count) + 0.5) * span, rate, force, vibration)


def _slow(signal: Array, t: Array) -> Array:
    """(N, 3) the parabola fitted around every sample, at that sample."""
    period = max(float(np.median(np.diff(t))), 1e-9)
    half = min(max(1, round(0.5 * SLOW_S / period)), len(t) - 1)
    i = np.arange(-half, half + 1)
    weight = 3 * (3 * half**2 + 3 * half - 1 - 5 * i**2) / ((2 * half + 3) * (2 * half + 1) * (2 * half - 1))
    padded = np.pad(signal, ((half, half), (0, 0)), "reflect", reflect_type="odd")  # goes on with the same slope
    return np.asarray(convolve1d(padded, weight, axis=0)[half:-half])


def _rms(signal: Array, owner: NDArray[np.int64], count: int) -> Array:
    squares = np.bincount(owner, np.einsum("nk,nk->n", signal, signal), count)
    samples = np.bincount(owner, minlength=count)
    return np.asarray(np.sqrt(np.divide(squares, samples, out=np.full(count, np.nan), where=samples > 0)))
