"""From IMU pieces to one gtsam preintegrated measurement per frame interval."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import gtsam
import numpy as np
from numpy.typing import NDArray

from vio.imu import GRAVITY_M_S2, ImuNoise, ImuPieces

Array = NDArray[np.float64]

INTEGRATION_DENSITY = 1e-5
"""Position noise of the integration scheme itself [m/sqrt(s)]; far below every sensor's."""
INFLATION_STEPS_PER_OCTAVE = 4


def make_bias(accel_m_s2: Array, gyro_rad_s: Array) -> gtsam.imuBias.ConstantBias:
    """gtsam's bias from accelerometer and gyro parts (3,), (3,)."""
    return gtsam.imuBias.ConstantBias(accel_m_s2, gyro_rad_s)


@lru_cache(maxsize=256)
def _params(noise: ImuNoise, accel_inflation: float, gyro_inflation: float) -> gtsam.PreintegrationCombinedParams:
    """Continuous densities, squared. Gravity is (0, 0, -9.81): the world's z axis points up."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_M_S2)
    eye = np.eye(3)
    params.setAccelerometerCovariance(eye * (noise.accel_density_m_s2_rthz * accel_inflation) ** 2)
    params.setGyroscopeCovariance(eye * (noise.gyro_density_rad_s_rthz * gyro_inflation) ** 2)
    params.setIntegrationCovariance(eye * INTEGRATION_DENSITY**2)
    params.setBiasAccCovariance(eye * noise.accel_walk_m_s3_rthz**2)
    params.setBiasOmegaCovariance(eye * noise.gyro_walk_rad_s2_rthz**2)
    return params


def _loosened(noise: ImuNoise, pieces: ImuPieces, k: int, slack: Array) -> ImuNoise:
    """Noise whose biases may change over interval k by (2,) beyond their random walk."""
    per_root_s = slack / np.sqrt(pieces.dt_s[pieces.first[k]:pieces.first[k + 1]].sum())
    return replace(noise, accel_walk_m_s3_rthz=float(np.hypot(noise.accel_walk_m_s3_rthz, per_root_s[0])),
                   gyro_walk_rad_s2_rthz=float(np.hypot(noise.gyro_walk_rad_s2_rthz, per_root_s[1])))


def _rounded(inflation: Array) -> Array:
    """Inflations on a logarithmic grid, so that few parameter sets serve all intervals."""
    steps: Array = np.round(np.log2(np.maximum(inflation, 1.0)) * INFLATION_STEPS_PER_OCTAVE)
    rounded: Array = 2.0 ** (steps / INFLATION_STEPS_PER_OCTAVE)
    return rounded


def preintegrate(pieces: ImuPieces, noise: ImuNoise, accel_bias_m_s2: Array, gyro_bias_rad_s: Array,
                 accel_inflation: Array, gyro_inflation: Array,
                 span: tuple[int, int],
                 bias_slack: Array | None = None) -> list[gtsam.PreintegratedCombinedMeasurements]:
    """Preintegrate the intervals `span[0]` to `span[1]` (exclusive), linearised at one bias.

    Args:
        pieces: all intervals of the recording, forces already in the axes at their piece's start.
        noise: continuous densities and walks.
        accel_bias_m_s2: (3,) linearisation point.
        gyro_bias_rad_s: (3,) linearisation point.
        accel_inflation: (M,) factor on the accelerometer density in every interval, at least 1.
        gyro_inflation: (M,) factor on the gyro density in every interval, at least 1.
        span: first interval and one past the last.
        bias_slack: (M, 2) as in `Problem`; None = nowhere.
    """
    bias = make_bias(accel_bias_m_s2, gyro_bias_rad_s)
    accel_factor, gyro_factor = _rounded(accel_inflation), _rounded(gyro_inflation)
    out = []
    for k in range(*span):
        walks = noise if bias_slack is None or not bias_slack[k].any() else _loosened(noise, pieces, k, bias_slack[k])
        params = _params(walks, float(accel_factor[k]), float(gyro_factor[k]))
        measurement = gtsam.PreintegratedCombinedMeasurements(params, bias)
        for n in range(pieces.first[k], pieces.first[k + 1]):
            measurement.integrateMeasurement(pieces.accel_m_s2[n], pieces.gyro_rad_s[n], pieces.dt_s[n])
        out.append(measurement)
    return out
