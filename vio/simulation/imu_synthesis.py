"""What an IMU at the body's origin reports of a continuous motion.

A real sensor low-passes before it samples; here each sample is the exact mean over its cell (point samples
of a collision alias 6 to 12 times worse). Bias, noise and saturation follow after that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vio.imu import GRAVITY_M_S2, ImuNoise, ImuSamples
from vio.simulation.motion import CapsuleMotion

Array = NDArray[np.float64]

SIMULATED_IMU = ImuNoise(gyro_range_rad_s=float(np.deg2rad(2000.0)), accel_range_m_s2=4 * GRAVITY_M_S2)
"""BMI270 noise with full scales of 2000 deg/s and 4 g."""

_NODES_PER_PANEL = 10
_CELLS_PER_CHUNK = 1024


@dataclass(frozen=True)
class ImuBiases:
    """True biases at every sample."""

    gyro_rad_s: Array
    """(N, 3)"""
    accel_m_s2: Array
    """(N, 3)"""


def ideal_imu(motion: CapsuleMotion, centre_s: Array, rate_hz: float) -> tuple[Array, Array]:
    """Mean angular rate and specific force (N, 3), (N, 3) over cells of 1/rate around their centres (N,) [s].

    Ten Gauss-Legendre nodes per cell (400 per second at 40 Hz), and per part of a cell that is cut by the onset
    of a collision. `centre_s` increases by at least the cell. Evaluated in chunks: memory does not grow with N
    beyond the result.
    """
    node, weight = np.polynomial.legendre.leggauss(_NODES_PER_PANEL)
    gyro, force = np.empty((len(centre_s), 3)), np.empty((len(centre_s), 3))
    for first in range(0, len(centre_s), _CELLS_PER_CHUNK):
        cells = slice(first, first + _CELLS_PER_CHUNK)
        start, length, first_panel = _panels(centre_s[cells], 1 / rate_hz, motion.vibration.kinks_s)
        state = motion.evaluate((start[:, None] + length[:, None] * (0.5 + 0.5 * node)).ravel())
        share = (0.5 * rate_hz * length)[:, None] * weight
        for values, out in ((state.gyro_rad_s, gyro), (state.specific_force_m_s2, force)):
            panels = np.einsum("pq,pqc->pc", share, values.reshape(*share.shape, 3))
            out[cells] = np.add.reduceat(panels, first_panel)
    return gyro, force


def _panels(centre: Array, cell: float, kinks: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """Cells cut at the kinks inside them: starts (p,), lengths (p,) and the first panel of every cell (N,)."""
    start, end = centre - 0.5 * cell, centre + 0.5 * cell
    owner = np.searchsorted(start, kinks) - 1
    inside = (owner >= 0) & (kinks < end[owner])
    starts = np.concatenate([start, kinks[inside]])
    owners = np.concatenate([np.arange(len(start)), owner[inside]])
    order = np.lexsort((starts, owners))
    starts, owners = starts[order], owners[order]
    ends = end[owners]
    shared = owners[1:] == owners[:-1]
    ends[:-1][shared] = starts[1:][shared]
    return starts, ends - starts, np.searchsorted(owners, np.arange(len(start)))


def draw_biases(count: int, noise: ImuNoise, rng: np.random.Generator, *, accel_bias_sd_m_s2: float = 0.2,
                gyro_bias_sd_rad_s: float = float(np.deg2rad(0.5))) -> ImuBiases:
    """Biases of `count` samples: a normal start and a random walk of the noise model's density."""
    step = np.sqrt(1 / noise.rate_hz)
    start_g, start_a = gyro_bias_sd_rad_s * rng.standard_normal(3), accel_bias_sd_m_s2 * rng.standard_normal(3)
    walk_g = np.cumsum(noise.gyro_walk_rad_s2_rthz * step * rng.standard_normal((count, 3)), axis=0)
    walk_a = np.cumsum(noise.accel_walk_m_s3_rthz * step * rng.standard_normal((count, 3)), axis=0)
    return ImuBiases(start_g + walk_g, start_a + walk_a)


def corrupt(t_ns: NDArray[np.int64], gyro_rad_s: Array, force_m_s2: Array, biases: ImuBiases, noise: ImuNoise,
            rng: np.random.Generator) -> ImuSamples:
    """Add biases and white noise to ideal samples (N, 3), then clip them at the sensor's full scale."""
    root_rate = np.sqrt(noise.rate_hz)
    white_g = noise.gyro_density_rad_s_rthz * root_rate * rng.standard_normal(gyro_rad_s.shape)
    white_a = noise.accel_density_m_s2_rthz * root_rate * rng.standard_normal(force_m_s2.shape)
    gyro = _saturate(gyro_rad_s + biases.gyro_rad_s + white_g, noise.gyro_range_rad_s)
    accel = _saturate(force_m_s2 + biases.accel_m_s2 + white_a, noise.accel_range_m_s2)
    return ImuSamples(t_ns, gyro, accel)


def _saturate(values: Array, limit: float | None) -> Array:
    return values if limit is None else np.clip(values, -limit, limit)
