"""Noise that a coarse IMU adds under vibration: what a sample's average cannot show.

A box-averaged 40 Hz sample of a 5-45 Hz shake hides motion inside its cell. The hidden part grows with
the signal's energy near the Nyquist frequency, which the second difference of the samples measures. Energy that is
there all the time (rotors, electronics) is plain noise above the data sheet's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vio.imu import ImuNoise, ImuSamples

Array = NDArray[np.float64]

ACCEL_SHARE, GYRO_SHARE = 0.1, 0.5
"""Share of the excess second difference that ends up as integration error. Chosen on simulated collisions of levels 3
and 5, seeds 1-10: with 0.15 and 0.3 the scale came out 1.5 % short and the poses' NEES was 1.45 per degree of freedom,
with these 0.5 % and 1.25; with 0.07 the scale came out long."""
FLOOR_PERCENTILE = 20.0
"""The power that four of five intervals exceed is noise that is always there, whatever the data sheet says."""
QUIET = 2.0
"""Power over the floor below which nothing is inflated: a dozen samples scatter that much."""
SECOND_DIFFERENCE_GAIN = np.sqrt(6.0)
"""Sd of x[n-1] - 2 x[n] + x[n+1] over the sd of white x."""


def vibration_inflation(samples: ImuSamples, imu_t_s: Array, node_t_s: Array, noise: ImuNoise) -> tuple[Array, Array]:
    """Factors (M-1,), (M-1,) on the accelerometer and gyro densities of every interval, at least 1."""
    root_rate = np.sqrt(noise.rate_hz)
    span = np.searchsorted(imu_t_s, node_t_s)
    accel = _excess(samples.accel_m_s2, span, noise.accel_density_m_s2_rthz * root_rate, ACCEL_SHARE)
    gyro = _excess(samples.gyro_rad_s, span, noise.gyro_density_rad_s_rthz * root_rate, GYRO_SHARE)
    return accel, gyro


def _excess(signal: Array, span: NDArray[np.int64], white_sd: float, share: float) -> Array:
    """Factor on the density per interval `span[k]:span[k+1]`: the recording's own floor, and a share of the rest.

    All powers in units of the calibrated white noise's.
    """
    second = np.zeros(len(signal) + 1)
    difference = signal[2:] - 2 * signal[1:-1] + signal[:-2]
    second[1:-2] = np.einsum("nk,nk->n", difference, difference) / 3 / SECOND_DIFFERENCE_GAIN**2
    total = np.concatenate([[0.0], np.cumsum(second)])
    counts = np.maximum(np.diff(span), 1)
    power = np.diff(total[span]) / counts
    power = power / white_sd**2
    floor = max(1.0, float(np.percentile(power, FLOOR_PERCENTILE)))
    inflation: Array = np.sqrt(floor + share**2 * np.maximum(power - QUIET * floor, 0.0))
    return inflation
