"""How an IMU's noise and vibration spread over frequency, and how much of it hides near the Nyquist frequency.

Power spectral densities by Welch's method ("The use of fast Fourier transform for the estimation of power spectra",
1967), one-sided, summed over the three axes. Samples of density d at a rate f have variance d² f per axis, so white
noise lies at 2 · 3 d².
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio.imu import ImuNoise, ImuSamples

Array = NDArray[np.float64]

SEGMENT_S = 25.0
SHORTEST = 64
"""Fewer samples without a hole have no spectrum worth looking at."""
TOP_BAND = 0.8
"""From this share of the Nyquist frequency on, what is seen may have been folded down from above."""
HOLE_PERIODS = 1.5


@dataclass(frozen=True)
class Spectrum:
    """Densities of the longest stretch without a hole, at F frequencies."""

    frequency_hz: Array
    """(F,) above 0."""
    accel: Array
    """(F,) m²/s⁴/Hz, summed over the axes."""
    gyro: Array
    """(F,) rad²/s²/Hz."""
    accel_over_noise: float
    """Amplitude near the Nyquist frequency over what the calibration's density says; 1 = as calibrated."""
    gyro_over_noise: float


def imu_spectrum(samples: ImuSamples, imu_t_s: ArrayLike, noise: ImuNoise) -> Spectrum | None:
    """Spectrum of N samples; None where no stretch of them is long enough.

    Args:
        samples: N samples, in order of time.
        imu_t_s: (N,) their stamps [s].
        noise: the calibration's densities.
    """
    t = np.asarray(imu_t_s, float)
    if len(t) < SHORTEST:
        return None
    first, last = _longest_stretch(t)
    if last - first < SHORTEST:
        return None
    rate_hz = 1.0 / float(np.median(np.diff(t[first:last])))
    accel, gyro = (_density(signal[first:last], rate_hz) for signal in (samples.accel_m_s2, samples.gyro_rad_s))
    frequency = accel[0]
    top = frequency >= TOP_BAND * rate_hz / 2
    over = [float(np.sqrt(np.mean(density[top]) / (6 * white**2))) for density, white in
            ((accel[1], noise.accel_density_m_s2_rthz), (gyro[1], noise.gyro_density_rad_s_rthz))]
    return Spectrum(frequency, accel[1], gyro[1], *over)


def _longest_stretch(t: Array) -> tuple[int, int]:
    """First sample, and one past the last, of the longest stretch without a hole."""
    step = np.diff(t)
    edges = np.concatenate([[0], np.flatnonzero(step > HOLE_PERIODS * np.median(step)) + 1, [len(t)]])
    k = int(np.argmax(np.diff(edges)))
    return int(edges[k]), int(edges[k + 1])


def _density(signal: Array, rate_hz: float) -> tuple[Array, Array]:
    from scipy.signal import welch  # slow to load

    segment = min(len(signal), max(SHORTEST, round(SEGMENT_S * rate_hz)))
    frequency, density = welch(signal, rate_hz, nperseg=segment, axis=0, detrend="constant")
    return frequency[1:], density[1:].sum(axis=1)
