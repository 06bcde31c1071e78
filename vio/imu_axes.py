"""Axes that are dead, swapped or reversed, from physics alone: turning every force back by the gyro keeps gravity."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.errors import ImuError
from vio.imu import ImuSamples

Array = NDArray[np.float64]

AXES = ("gyro x", "gyro y", "gyro z", "accelerometer x", "accelerometer y", "accelerometer z")
WINDOW_S = 5.0
SHORTEST_WINDOW_S = 1.0
MAX_WINDOWS = 100
TURNED_RAD = 0.3
LEAST_WINDOWS = 4
"""In which the gyro turned, before its axes are judged."""
LEAST_SAMPLES = 100
"""Before a value that never changes counts as a dead axis."""
MOVING = (0.02, 0.3)
"""Spread [rad/s, m/s²] of a sensor's other axes at which none can stand still; a quantised sensor at rest may."""
LOST_DIRECTION = 0.01
"""1 - |mean direction of gravity| that a sound IMU stays below: 8 degrees of scatter."""
RATIO = 9.0
"""By how much an explanation must shorten the scatter."""


@dataclass(frozen=True)
class GravityWindows:
    """W windows of a few seconds in which the gyro turned, of L samples."""

    turns_rad: Array
    """(W, L-1, 3) rotation from sample to sample, as the gyro reports it."""
    force_m_s2: Array
    """(W, L, 3)"""


def check_axes(samples: ImuSamples, t_s: Array) -> None:
    """Refuse axes that are swapped or reversed.

    Raises:
        ImuError: gyro and accelerometer contradict each other, and agree once two axes are swapped or one is reversed;
            named, in one line.
    """
    windows = turned_windows(samples, t_s)
    if len(windows.turns_rad) < LEAST_WINDOWS or lost_direction(windows.turns_rad, windows.force_m_s2) < LOST_DIRECTION:
        return
    as_is = lost_direction(windows.turns_rad, windows.force_m_s2)
    scatter = {name: lost_direction(windows.turns_rad @ gyro.T, windows.force_m_s2 @ accel.T)
               for name, gyro, accel in _explanations()}
    best = min(scatter, key=lambda name: scatter[name])
    if scatter[best] < as_is / RATIO:
        degrees = np.rad2deg(np.sqrt(2 * np.array([as_is, scatter[best]])))
        raise ImuError(f"imu: {best}: gravity turned back by the gyro scatters by {degrees[0]:.0f} degrees as it is, "
                       f"by {degrees[1]:.1f} when that is undone; correct the axes in imu0/data.csv")


def check_dead_axes(samples: ImuSamples) -> None:
    """Refuse an axis that never changes while its sensor's others do.

    Raises:
        ImuError: naming it.
    """
    if len(samples) < LEAST_SAMPLES:
        return
    values = np.hstack([samples.gyro_rad_s, samples.accel_m_s2])
    still = np.ptp(values, axis=0) == 0
    moving = values.std(axis=0)
    for sensor, least in zip((slice(0, 3), slice(3, 6)), MOVING, strict=True):
        if still[sensor].any() and moving[sensor].max() > least:
            k = sensor.start + int(np.argmax(still[sensor]))
            raise ImuError(f"imu: {AXES[k]} is dead: it reads {values[0, k]:.6g} in all {len(samples)} samples while "
                           "its sensor's other axes move; repair the sensor, or predict without it")


def _explanations() -> list[tuple[str, Array, Array]]:
    """Name, and the matrices that undo it for gyro and accelerometer."""
    out = []
    for sensor, is_gyro in (("gyro", True), ("accelerometer", False)):
        for first, second in combinations(range(3), 2):
            swap = np.eye(3)
            swap[[first, second]] = swap[[second, first]]
            out.append((f"{sensor} {'xyz'[first]} and {'xyz'[second]} are swapped", swap, is_gyro))
        for axis in range(3):
            flip = np.diag([-1.0 if k == axis else 1.0 for k in range(3)])
            out.append((f"{sensor} {'xyz'[axis]} is reversed", flip, is_gyro))
    eye = np.eye(3)
    return [(name, matrix if is_gyro else eye, eye if is_gyro else matrix) for name, matrix, is_gyro in out]


def turned_windows(samples: ImuSamples, t_s: Array) -> GravityWindows:
    """Windows of about 5 s without gaps, at most 100, spread over the recording, in which the gyro turned 0.3 rad."""
    windows = _windows(t_s)
    if len(windows) == 0:
        return GravityWindows(np.zeros((0, 0, 3)), np.zeros((0, 0, 3)))
    gyro = samples.gyro_rad_s[windows]
    turns = 0.5 * (gyro[:, 1:] + gyro[:, :-1]) * np.diff(t_s[windows], axis=1)[..., None]
    turned = np.linalg.norm(np.cumsum(turns, axis=1), axis=2).max(axis=1) > TURNED_RAD
    return GravityWindows(turns[turned], samples.accel_m_s2[windows][turned])


def _windows(t_s: Array) -> NDArray[np.int64]:
    """Sample indices (W, L)."""
    steps = np.diff(t_s)
    span = min(WINDOW_S, float(t_s[-1]))
    length = int(span / np.median(steps)) + 1
    if span < SHORTEST_WINDOW_S or length < 3 or length > len(t_s):
        return np.zeros((0, 0), np.int64)
    starts = np.unique(np.linspace(0, len(t_s) - length, min(MAX_WINDOWS, len(t_s) // length)).astype(np.int64))
    windows = starts[:, None] + np.arange(length)
    whole = t_s[windows[:, -1]] - t_s[windows[:, 0]] < 1.5 * span
    return np.asarray(windows[whole])


def lost_direction(turns_rad: Array, force: Array) -> float:
    """Median over W windows of 1 - |mean direction| of forces (W, L, 3), turned back by vectors (W, L-1, 3) [rad]."""
    direction = force / np.maximum(np.linalg.norm(force, axis=2, keepdims=True), 1e-9)
    steps = se3.so3_exp(turns_rad)
    R = np.broadcast_to(np.eye(3), (len(force), 3, 3))
    total = direction[:, 0].copy()
    for k in range(steps.shape[1]):
        R = R @ steps[:, k]
        total += (R @ direction[:, k + 1, :, None])[..., 0]
    return float(np.median(1 - np.linalg.norm(total, axis=1) / force.shape[1]))
