"""Where the IMU feels nothing but its own noise: the generalised likelihood ratio test for rest, at two paces.

Rest against any motion (Skog et al., IEEE Trans. Biomed. Eng. 57, 2010, "SHOE"), with the noise card's densities: the
gyro about its bias, the accelerometer about its mean. Within a frame interval the samples' scatter shows shaking;
from interval to interval the means show what is too slow for that, turning and breathing. Both are χ² at rest. An
accelerometer about its mean cannot tell rest from steady motion: that is for the camera to say.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from vio.imu import ImuNoise, ImuSamples

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.int64]
Test = Callable[[Indices, Indices], tuple[Array, Array]]
"""Windows from `first` (K,) to `last` (K,), exclusive → statistic (K,) and degrees of freedom (K,)."""

LONGEST = 64
"""Intervals in the longest window of the IMU: half a minute, over which biases hardly walk."""
LEAST_SAMPLES = 3
"""Per interval; with fewer, nothing is said of it."""


def quiet_intervals(samples: ImuSamples, imu_t_s: Array, t_s: Array, gyro_bias_rad_s: Array, noise: ImuNoise,
                    false_alarm: float) -> Bools:
    """(M-1,) intervals between nodes at t_s (M,) in which the IMU is quiet, alone and with those around them.

    Args:
        samples: of the whole recording.
        imu_t_s: (S,) their stamps on the nodes' clock.
        t_s: (M,)
        gyro_bias_rad_s: (M, 3)
        noise: the card.
        false_alarm: how likely any interval of a recording at rest is called loud.
    """
    count = len(t_s) - 1
    owner = np.searchsorted(t_s, imu_t_s, "right") - 1
    inside = (owner >= 0) & (owner < count)
    owner = owner[inside]
    n = np.bincount(owner, minlength=count).astype(float)
    root_rate = np.sqrt(noise.rate_hz)
    fast, mean = np.zeros(count), []
    for values, density in ((samples.gyro_rad_s[inside], noise.gyro_density_rad_s_rthz),
                            (samples.accel_m_s2[inside] - samples.accel_m_s2.mean(axis=0),
                             noise.accel_density_m_s2_rthz)):
        unit = values / (density * root_rate)
        of_interval = np.stack([np.bincount(owner, unit[:, a], count) for a in range(3)], axis=1)
        mean.append(of_interval / np.maximum(n, 1)[:, None])
        apart = unit - mean[-1][owner]
        fast += np.bincount(owner, np.einsum("nk,nk->n", apart, apart), count)
    turning = mean[0] - 0.5 * (gyro_bias_rad_s[1:] + gyro_bias_rad_s[:-1]) / (noise.gyro_density_rad_s_rthz * root_rate)
    tests = (_shaking(fast, n), _drifting(turning, mean[1], n))
    still, level = n >= LEAST_SAMPLES, false_alarm / len(tests) / windows(count, 1, LONGEST)
    for test in tests:
        still = passing(still, 1, LONGEST, test, level)
    return still


def _shaking(fast: Array, n: Array) -> Test:
    """Scatter of both sensors about the intervals' means."""
    total, free = _summed(fast), _summed(6 * (n - 1))
    return lambda first, last: (total[last] - total[first], free[last] - free[first])


def _drifting(turning: Array, force: Array, n: Array) -> Test:
    """Intervals' means: of the gyro about its bias, of the accelerometer about the window's mean. In units of noise."""
    weight, turned = _summed(n), _summed(n * np.einsum("nk,nk->n", turning, turning))
    pushed, pushed2 = _summed(n[:, None] * force), _summed(n * np.einsum("nk,nk->n", force, force))

    def test(first: Indices, last: Indices) -> tuple[Array, Array]:
        mean = pushed[last] - pushed[first]
        about = pushed2[last] - pushed2[first] - np.einsum("nk,nk->n", mean, mean) / (weight[last] - weight[first])
        return turned[last] - turned[first] + about, np.asarray(3.0 * (2 * (last - first) - 1), float)

    return test


def passing(candidate: Bools, shortest: int, longest: int, test: Test, level: float) -> Bools:
    """(C,) candidates without those in a window that fails, windows of doubling length, from short to long.

    A window is tested while all in it are still candidates, so that a brief motion costs no more than it lasts.

    Args:
        candidate: (C,) in order of time.
        shortest: candidates in the shortest window.
        longest: in the longest.
        test: what is χ² at rest.
        level: false alarms of one window.
    """
    still, length = candidate.copy(), shortest
    while length <= min(longest, len(still)):
        first = np.arange(0, len(still) - length + 1, max(length // 2, 1))
        lacking = np.concatenate([[0], np.cumsum(~still)])
        first = first[lacking[first + length] == lacking[first]]
        statistic, free = test(first, first + length)
        failing = first[~(statistic <= chi2.isf(level, free))]
        still &= ~covered(failing, failing + length, len(still))
        length *= 2
    return still


def windows(count: int, shortest: int, longest: int) -> int:
    """How many windows `passing` tests at most."""
    total, length = 0, shortest
    while length <= min(longest, count):
        total += (count - length) // max(length // 2, 1) + 1
        length *= 2
    return max(total, 1)


def covered(first: Indices, last: Indices, count: int) -> Bools:
    """(count,) which lie in any span `first` to `last`, exclusive."""
    edges = np.zeros(count + 1)
    np.add.at(edges, first, 1.0)
    np.add.at(edges, last, -1.0)
    return np.asarray(np.cumsum(edges)[:-1] > 0)


def _summed(x: Array) -> Array:
    return np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)])
