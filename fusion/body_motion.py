"""Periodic motion of the whole body that the IMU feels and the camera does not see: breathing, walking, tremor.

The camera measures motion relative to the gut; the IMU, relative to the world. What the specific force shows beyond the
camera's motion is a residual acceleration, in which a swaying body stands out as narrow spectral lines. Those lines
are taken out of the accelerometer, so that what is left measures the capsule again.

Lines are looked for in overlapping windows, the strongest first, each fitted by least squares with an amplitude that
may change, and taken away before the next one is looked for (as CLEAN does: Högbom, A&A Suppl. 15, 1974).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.optimize import minimize_scalar
from scipy.signal import welch

from fusion.problem import Problem, with_accelerometer
from vio import se3
from vio.imu import GRAVITY_M_S2, ImuPieces, split_at_frames

Array = NDArray[np.float64]

WINDOW_S = 64.0
SHORTEST_S = 20.0
"""Of a recording in which lines can be told from noise."""
LOWEST_HZ, HIGHEST_HZ = 0.1, 5.0
"""Breathing is above, the capsule's own shaking beyond. Below, bias and tilt pass for acceleration."""
LINE_OVER_FLOOR = 25.0
"""Power of a line over the median of its neighbourhood; noise reaches about 10."""
MOTION_HZ, DENSITY_BINS = 0.6, 5
FLOOR_BINS = 31
SIDE_BAND, SIDE_OVER_FLOOR = 0.3, 8.0
"""An uneven sway spreads around its pace: there, less is needed."""
MOST_LINES = 24
LEAST_WEIGHT = 0.01
"""Of a window at its ends, where another one that overlaps it counts."""


@dataclass(frozen=True)
class BodyMotion:
    """What the body did that the camera did not see."""

    hz: float
    """Pace of the strongest periodic motion that was taken out; 0 where none stood out."""
    amplitude_m: float
    """Of a sine with its acceleration, all axes together."""
    left_density_m_s2_rthz: float
    """Acceleration that is left beyond the camera's motion, at the frequencies in which a capsule shows scale."""


def without_body_motion(problem: Problem, R_world_body: Array, p_world_m: Array, accel_bias_m_s2: Array,
                        gyro_bias_rad_s: Array, trusted: NDArray[np.bool_]) -> tuple[Problem, BodyMotion]:
    """The problem with periodic unseen accelerations taken out of its accelerometer.

    Args:
        problem: of M nodes.
        R_world_body: (M, 3, 3) attitudes.
        p_world_m: (M, 3) positions that the accelerometer has not bent.
        accel_bias_m_s2: (M, 3)
        gyro_bias_rad_s: (M, 3)
        trusted: (M-1,) intervals whose step is no outlier.

    Returns:
        The problem, itself where no line stands out; and what was found.
    """
    span = float(problem.t_s[-1] - problem.t_s[0])
    if span < SHORTEST_S or trusted.sum() < 3:
        return problem, BodyMotion(0.0, 0.0, 0.0)
    pieces = split_at_frames(problem.samples, problem.imu_t_s, problem.t_s, problem.gyro_bias_rad_s, ramps=False)
    owner = np.repeat(np.arange(len(problem) - 1), np.diff(pieces.first))
    R = _piece_attitudes(pieces, R_world_body, gyro_bias_rad_s, owner)
    t = _piece_centres(problem, pieces, owner)
    felt = (R @ (pieces.accel_m_s2 - accel_bias_m_s2[owner])[:, :, None])[:, :, 0] - [0, 0, GRAVITY_M_S2]
    residual = np.where(problem.imu_usable[owner, None], felt - _seen(problem, p_world_m, trusted, t), 0.0)
    rate_hz = 1.0 / float(np.median(pieces.dt_s))
    grid = np.arange(problem.t_s[0], problem.t_s[-1], 1.0 / rate_hz)
    uniform = CubicSpline(t, residual)(grid)
    lines = _lines(uniform, rate_hz)
    motion = _described(lines, uniform - lines, rate_hz)
    if not lines.any():
        return problem, motion
    inside = (problem.imu_t_s >= grid[0]) & (problem.imu_t_s <= grid[-1])
    at = problem.imu_t_s[inside]
    k = np.clip(np.searchsorted(t, at), 0, len(t) - 1)  # the nearest pieces' attitude, carried to the stamp
    turned = R[k] @ se3.so3_exp(pieces.gyro_rad_s[k] * (at - t[k] + 0.5 * pieces.dt_s[k])[:, None])
    unseen = CubicSpline(grid, lines)(at)
    accel = problem.samples.accel_m_s2.copy()
    accel[inside] -= (np.swapaxes(turned, 1, 2) @ unseen[:, :, None])[:, :, 0]
    return with_accelerometer(problem, accel), motion


def _piece_attitudes(pieces: ImuPieces, R_world_body: Array, gyro_bias: Array, owner: NDArray[np.int64]) -> Array:
    """(P, 3, 3) attitude at the start of every piece: the node's, carried on by the gyro."""
    steps = se3.so3_exp((pieces.gyro_rad_s - gyro_bias[owner]) * pieces.dt_s[:, None])
    R = R_world_body[owner].copy()
    place = np.arange(len(owner)) - pieces.first[owner]
    for offset in range(1, int(place.max(initial=0)) + 1):
        at = np.flatnonzero(place == offset)
        R[at] = R[at - 1] @ steps[at - 1]
    return R


def _piece_centres(problem: Problem, pieces: ImuPieces, owner: NDArray[np.int64]) -> Array:
    dt = pieces.dt_s
    ends = np.cumsum(dt)
    begun = np.concatenate([[0.0], ends])[pieces.first[:-1]]
    centres: Array = problem.t_s[owner] + ends - 0.5 * dt - begun[owner]
    return centres


def _seen(problem: Problem, p_world_m: Array, trusted: NDArray[np.bool_], t: Array) -> Array:
    """(P, 3) acceleration of the nodes' track [m/s²], steps that are outliers bridged."""
    middle = 0.5 * (problem.t_s[1:] + problem.t_s[:-1])
    velocity = np.diff(p_world_m, axis=0) / problem.dt_s[:, None]
    out = np.empty((len(t), 3))
    for axis in range(3):
        smooth = np.interp(middle, middle[trusted], velocity[trusted, axis])
        out[:, axis] = np.interp(t, middle, np.gradient(smooth, middle))
    return out


def _lines(signal: Array, rate_hz: float) -> Array:
    """The part of a signal (N, 3) that stands out as spectral lines, zero where there is none."""
    size = min(int(WINDOW_S * rate_hz), len(signal))
    fade = np.hanning(size + 2)[1:-1] + LEAST_WEIGHT
    out, weight = np.zeros_like(signal), np.zeros(len(signal))
    for begin in np.unique(np.r_[np.arange(0, len(signal) - size, size // 2), len(signal) - size]):
        part = slice(begin, begin + size)
        out[part] += _lines_in_window(signal[part], rate_hz) * fade[:, None]
        weight[part] += fade
    lines: Array = out / weight[:, None]
    return lines


def _lines_in_window(signal: Array, rate_hz: float) -> Array:
    """The strongest lines one after the other, each with an amplitude that changes like a parabola."""
    window = np.hanning(len(signal) + 2)[1:-1, None]
    hz = np.fft.rfftfreq(len(signal), 1.0 / rate_hz)
    inside = (hz >= LOWEST_HZ) & (hz <= HIGHEST_HZ)
    u = np.linspace(-1.0, 1.0, len(signal))
    left, needed = signal.copy(), np.full(len(hz), LINE_OVER_FLOOR)
    for _ in range(MOST_LINES):
        power = (np.abs(np.fft.rfft(left * window, axis=0)) ** 2).sum(axis=1)
        over = np.where(inside, power / np.maximum(median_filter(power, FLOOR_BINS, mode="nearest"), 1e-30), 0.0)
        peak = int(np.argmax(over / needed))
        if over[peak] < needed[peak]:
            break
        needed[np.abs(hz - hz[peak]) < SIDE_BAND * hz[peak]] = SIDE_OVER_FLOOR
        found = minimize_scalar(_less_wave, args=(left * window, rate_hz), method="bounded",
                                bounds=(hz[peak] - hz[1], hz[peak] + hz[1]), options={"xatol": 1e-3 * hz[1]})
        angle = 2 * np.pi * float(found.x) / rate_hz * np.arange(len(signal))
        basis = np.column_stack([wave(angle) * u**power for power in range(3) for wave in (np.cos, np.sin)])
        left -= basis @ np.linalg.lstsq(basis, left, rcond=None)[0]
    return signal - left


def _less_wave(hz: float, signal: Array, rate_hz: float) -> float:
    """Minus the length of the Fourier coefficients (3,) at any frequency."""
    turn = np.exp(-2j * np.pi * hz / rate_hz * np.arange(len(signal)))
    return -float(np.linalg.norm(turn @ signal))


def _described(lines: Array, left: Array, rate_hz: float) -> BodyMotion:
    spectrum = np.fft.rfft(lines, axis=0)
    hz = np.fft.rfftfreq(len(lines), 1.0 / rate_hz)
    peak = float(hz[np.argmax((np.abs(spectrum) ** 2).sum(axis=1))])
    amplitude = float(np.sqrt(2 * (lines**2).sum(axis=1).mean())) / (2 * np.pi * max(peak, LOWEST_HZ)) ** 2
    return BodyMotion(peak, amplitude, _strongest_density(left, rate_hz))


def _strongest_density(signal: Array, rate_hz: float) -> float:
    """Largest amplitude density [unit/√Hz] of a signal (N, 3), per axis, from `LOWEST_HZ` to `MOTION_HZ`."""
    hz, psd = welch(signal, rate_hz, nperseg=min(int(WINDOW_S * rate_hz), len(signal)), axis=0)
    smooth = uniform_filter1d(psd.mean(axis=1), DENSITY_BINS)
    return float(np.sqrt(smooth[(hz >= LOWEST_HZ) & (hz <= MOTION_HZ)].max()))
