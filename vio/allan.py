"""Noise of a resting IMU from its Allan deviation: density, bias instability and bias walk.

Overlapping Allan variance of a signal whose integral is theta, at tau = m t0 (IEEE Std 952-1997, annex C; Riley,
"Handbook of frequency stability analysis", NIST SP 1065, 2008):

    sigma²(tau) = 1 / (2 tau² (N - 2m)) · sum_k (theta_{k+2m} - 2 theta_{k+m} + theta_k)²

White noise of density n gives n²/tau, a bias that flickers with instability b gives (2 ln 2 / pi) b², and one that
walks with density k gives k² tau / 3. The three are fitted together, none below zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls

from vio.errors import ImuError
from vio.imu import ImuNoise, ImuSamples

Array = NDArray[np.float64]

PER_DECADE = 8
FEWEST_SPANS = 9
"""An averaging time that fits fewer times into the log says too little."""
FEWEST_SAMPLES = 1000
FLICKER = 2 * np.log(2) / np.pi
SHORTEST_S = 0.1
"""Shorter averages see the sensor's own filter, not its noise."""
REGULAR = 0.05


@dataclass(frozen=True)
class AllanNoise:
    """Noise of one axis; units are those of the signal, with s for the rest."""

    tau_s: Array
    """(T,) averaging times."""
    deviation: Array
    """(T,) Allan deviation at them, in units of the signal."""
    density: float
    """White noise, unit/√Hz: angle or velocity random walk of a data sheet."""
    instability: float
    """Flicker of the bias, in units of the signal."""
    walk: float
    """Random walk of the bias, unit/s/√Hz; 0 where the log is too short to show one."""


def allan_deviation(signal: ArrayLike, rate_hz: float) -> tuple[Array, Array]:
    """Averaging times (T,) [s] and overlapping Allan deviations (T,) of a signal (N,).

    Raises:
        ImuError: fewer than 1000 samples, a value that is not finite, or a rate that is not positive.
    """
    values = np.asarray(signal, float)
    if values.ndim != 1 or len(values) < FEWEST_SAMPLES:
        raise ImuError(f"allan: {values.shape} samples of one axis, needed are {FEWEST_SAMPLES} or more; log for hours")
    if not np.isfinite(values).all():
        raise ImuError(f"allan: sample {int(np.argmin(np.isfinite(values)))} is not finite; drop or repair it")
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise ImuError(f"allan: the rate is {rate_hz} Hz; give a positive number")
    theta = np.concatenate([[0.0], np.cumsum(values - values.mean())]) / rate_hz
    longest = len(values) // FEWEST_SPANS
    spans = np.unique(np.logspace(0, np.log10(longest), int(PER_DECADE * np.log10(longest)) + 1).round()).astype(int)
    variance = [np.mean((theta[2 * m:] - 2 * theta[m:-m] + theta[:-2 * m]) ** 2) / (2 * (m / rate_hz) ** 2)
                for m in spans.tolist()]
    return spans / rate_hz, np.sqrt(np.array(variance))


def allan_noise(signal: ArrayLike, rate_hz: float) -> AllanNoise:
    """Allan deviation of one axis (N,) at rest, and the noise that explains it.

    Raises:
        ImuError: as `allan_deviation`.
    """
    tau, deviation = allan_deviation(signal, rate_hz)
    used = (tau >= SHORTEST_S) & (deviation > 0)
    t, variance = tau[used], deviation[used] ** 2
    if len(t) < 3:
        return AllanNoise(tau, deviation, float(deviation[0] * np.sqrt(tau[0])), 0.0, 0.0)
    spans = len(np.asarray(signal)) / rate_hz / t
    weight = np.sqrt(spans) / variance  # a variance from s spans is good to about 1 / √s of itself
    terms = np.column_stack([1 / t, np.full(len(t), FLICKER), t / 3])
    size = np.linalg.norm(terms * weight[:, None], axis=0)
    found, _ = nnls(terms * weight[:, None] / size, variance * weight)
    density, instability, walk = np.sqrt(found / size)
    return AllanNoise(tau, deviation, float(density), float(instability), float(walk))


def calibrate_noise(samples: ImuSamples, start: ImuNoise | None = None) -> tuple[ImuNoise, list[AllanNoise]]:
    """Noise of an IMU that lay still for hours, for `imu0/sensor.yaml`.

    Of three axes the noisiest counts. Where no walk shows, the one of `start` is kept: a log of hours bounds it only.

    Args:
        samples: N samples at a constant rate, at rest.
        start: what is known already; ranges are taken over from it.

    Returns:
        The noise, and the Allan deviation of gyro x, y, z and accelerometer x, y, z.

    Raises:
        ImuError: too few samples, a value that is not finite, or stamps that are not regular.
    """
    start = start or ImuNoise()
    step = np.diff(samples.t_ns) * 1e-9
    if len(step) < FEWEST_SAMPLES - 1:
        raise ImuError(f"allan: {len(samples)} samples, needed are {FEWEST_SAMPLES} or more; log for hours")
    period = float(np.median(step))
    if period <= 0 or np.abs(step - period).max() > REGULAR * period + 1e-9:
        k = int(np.argmax(np.abs(step - period)))
        raise ImuError(f"allan: {step[k]:.6f} s between samples {k} and {k + 1}, {period:.6f} s elsewhere; cut the log "
                       "to a stretch without holes")
    axes = [allan_noise(signal[:, k], 1 / period) for signal in (samples.gyro_rad_s, samples.accel_m_s2)
            for k in range(3)]
    gyro, accel = axes[:3], axes[3:]
    return replace(
        start, rate_hz=1 / period,
        gyro_density_rad_s_rthz=max(axis.density for axis in gyro),
        accel_density_m_s2_rthz=max(axis.density for axis in accel),
        gyro_walk_rad_s2_rthz=max(axis.walk for axis in gyro) or start.gyro_walk_rad_s2_rthz,
        accel_walk_m_s3_rthz=max(axis.walk for axis in accel) or start.accel_walk_m_s3_rthz,
    ), axes
