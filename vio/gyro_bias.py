"""The gyro's constant bias over a recording, and how surely it is known, from what it contradicts.

Two things tell of it. Gravity keeps its direction: with C_k the rotation from the frame k of a window to its first, by
the gyro freed of a bias b, the mean specific force f_k of the interval after frame k obeys

    C_k f_k = g + C_k b_a + a_k

with one g a window, one accelerometer bias b_a, and accelerations a_k whose mean is nought because velocities are
bounded. And rotations seen by other means, such as a network's, must agree with the gyro's: e_k = Log(R_kᵀ G_k(b)).

Both residuals are weighted after Cauchy, believed as far as they scatter and not as far as someone claims, and counted
for less where neighbours err alike: of N residuals that correlate by ρ with the next, N (1 - ρ) / (1 + ρ) count
(Bartlett, 1946). So a shaking patient, a dead accelerometer or a network that knows nothing widen the answer instead of
moving it. Prior, gravity and rotations together are one Gaussian about the minimum of their sum (Gauss-Newton).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.imu import ImuNoise, ImuPieces, ImuSamples, preintegrate_rotation

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

GYRO_BIAS_SD_RAD_S = float(np.deg2rad(0.5))
"""Prior: zero-rate offset of a small MEMS gyro by its data sheet (Bosch BMI270)."""
ACCEL_BIAS_SD_M_S2 = 0.3
WINDOW_S = 20.0
"""Longest time over which the gyro's drift is followed at once: a bias of 1 deg/s turns by 20 deg in it."""
FEWEST_INTERVALS = 8
"""In a window, and of rotations that are compared."""
ITERATIONS = 8
CAUCHY = 3.0
MEDIAN_CHI2_3 = 2.366
MOST_CORRELATED = 0.95
CUT_VARIANCE = 2.5
"""Fitted to the gyros of 126 simulated recordings of all kinds and levels of vibration."""
LEAST_FORCE_SD_M_S2, LEAST_SPREAD = 1e-3, 0.1
"""Of the noise of gravity's direction, and of the scatter of rotations over what they claim: less is no knowledge but
too few numbers."""


@dataclass(frozen=True)
class GyroBias:
    """What is known of it, in body axes."""

    bias_rad_s: Array
    """(3,)"""
    cov: Array
    """(3, 3) of the same, one error for the whole recording; a walk of the bias about its mean is included."""
    force_sd_m_s2: float | None
    """Scatter of the specific force about gravity; None without a window to follow it in."""
    rotation_spread: float | None
    """Scatter of the seen rotations over what they claim; None where too few were given."""

    @property
    def sd_rad_s(self) -> Array:
        """(3,)"""
        return np.asarray(np.sqrt(np.diag(self.cov)))


@dataclass(frozen=True)
class SeenRotations:
    """K rotations of the body between neighbouring frames, by something else than the gyro."""

    interval: Indices
    """(K,) from frame `interval` to the next, increasing."""
    R: Array
    """(K, 3, 3) `R_body_k_body_k1`."""
    cov: Array
    """(K, 3, 3) of its error, perturbed on the right [rad²]."""


@dataclass(frozen=True)
class _Term:
    """One linearised source: its normal equations, and what they are to be divided by."""

    H: Array
    """(6, 6) for gyro and accelerometer bias."""
    g: Array
    """(6,)"""
    variance: float
    """Of a residual of weight 1."""
    correlation: float
    """Of neighbouring residuals."""

    def information(self) -> tuple[Array, Array]:
        share = (1 - self.correlation) / ((1 + self.correlation) * self.variance)
        return self.H * share, self.g * share


def estimate_gyro_bias(pieces: ImuPieces, interval_s: ArrayLike, usable: ArrayLike, noise: ImuNoise,
                       seen: SeenRotations | None = None, prior_sd_rad_s: float = GYRO_BIAS_SD_RAD_S) -> GyroBias:
    """The bias of the gyro.

    Args:
        pieces: inertial samples between M + 1 frames, from `vio.imu.split_at_frames`.
        interval_s: (M,) between the frames.
        usable: (M,) whether the stream has no hole there.
        noise: of the IMU; its bias walk widens the answer for long recordings.
        seen: rotations to compare with; None = gravity alone.
        prior_sd_rad_s: per axis.
    """
    dt, good = np.asarray(interval_s, float), np.asarray(usable, bool)
    windows = _windows(dt, good)
    seen = None if seen is None else _believable(seen, good)
    prior = np.repeat([prior_sd_rad_s**-2, ACCEL_BIAS_SD_M_S2**-2], 3)
    x, terms = np.zeros(6), list[_Term]()
    for last in [*[False] * ITERATIONS, True]:
        terms = _terms(pieces, dt, windows, seen, x)
        parts = [term.information() if last else (term.H / term.variance, term.g / term.variance) for term in terms]
        H = np.diag(prior) + sum((part[0] for part in parts), np.zeros((6, 6)))
        x = x - np.linalg.solve(H, prior * x + sum((part[1] for part in parts), np.zeros(6)))
    walked = noise.gyro_walk_rad_s2_rthz**2 * dt.sum() / 6  # of a random walk about its own mean over that time
    cov = np.linalg.inv(H)[:3, :3] + walked * np.eye(3)
    gravity = float(np.sqrt(terms[0].variance)) if windows.size else None
    return GyroBias(x[:3], cov, gravity, None if seen is None else float(np.sqrt(terms[-1].variance)))


def gyro_noise_var(samples: ImuSamples, imu_t_s: ArrayLike, frame_t_s: ArrayLike, noise: ImuNoise) -> Array:
    """(M,) variance per axis [rad²] of the gyro's rotation between M + 1 frames, its bias apart.

    White noise of the sensor, and what a frame time hides that cuts a sample's cell: of a cell of length h cut at the
    share q, a signal with second difference d between samples may put about q (1 - q) h d more into one part.

    Args:
        samples: N ≥ 3 samples.
        imu_t_s: (N,) their stamps on the frames' clock [s].
        frame_t_s: (M + 1,).
        noise: of the IMU.
    """
    t, frames, gyro = np.asarray(imu_t_s, float), np.asarray(frame_t_s, float), samples.gyro_rad_s
    middle = 0.5 * (t[1:] + t[:-1])
    n = np.clip(np.searchsorted(middle, frames), 1, len(t) - 2)
    length = middle[n] - middle[n - 1]
    share = np.clip((frames - middle[n - 1]) / length, 0.0, 1.0)
    second = ((gyro[n + 1] - 2 * gyro[n] + gyro[n - 1]) ** 2).mean(axis=1)
    hidden = CUT_VARIANCE * (share * (1 - share) * length) ** 2 * second
    return np.asarray(noise.gyro_density_rad_s_rthz**2 * np.diff(frames) + hidden[:-1] + hidden[1:])


def _windows(dt: Array, usable: NDArray[np.bool_]) -> Indices:
    """(windows, intervals) numbers of neighbouring usable intervals, no longer than `WINDOW_S`; -1 behind the last."""
    length = max(round(WINDOW_S / max(float(np.median(dt)), 1e-6)), FEWEST_INTERVALS)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], usable.astype(int), [0]])))
    found = [np.array_split(np.arange(a, b), max(int(np.ceil((b - a) / length)), 1))
             for a, b in zip(edges[::2], edges[1::2], strict=True)]
    kept = [part for parts in found for part in parts if len(part) >= FEWEST_INTERVALS]
    out = np.full((len(kept), max((len(part) for part in kept), default=0)), -1, np.int64)
    for row, part in zip(out, kept, strict=True):
        row[: len(part)] = part
    return out


def _believable(seen: SeenRotations, usable: NDArray[np.bool_]) -> SeenRotations | None:
    kept = usable[seen.interval]
    if kept.sum() < FEWEST_INTERVALS:
        return None
    return SeenRotations(seen.interval[kept], seen.R[kept], seen.cov[kept])


def _terms(pieces: ImuPieces, dt: Array, windows: Indices, seen: SeenRotations | None, x: Array) -> list[_Term]:
    out = []
    if windows.size:
        out.append(_gravity(pieces, dt, windows, x[:3], x[3:]))
    if seen is not None:
        out.append(_rotations(pieces, dt, seen, x[:3]))
    return out


def _gravity(pieces: ImuPieces, dt: Array, windows: Indices, bias: Array, accel_bias: Array) -> _Term:
    """Gravity's own direction, its mean in every window eliminated."""
    R, force = _turned_forces(pieces, bias)
    inside = windows >= 0
    at = np.where(inside, windows, 0)
    C = np.broadcast_to(np.eye(3), (len(windows), windows.shape[1] + 1, 3, 3)).copy()
    for k in range(windows.shape[1]):
        C[:, k + 1] = C[:, k] @ R[at[:, k]]
    middle = 0.5 * (C[:, :-1] + C[:, 1:])
    swept = np.cumsum(middle * dt[at][..., None, None], axis=1)
    swept -= 0.5 * middle * dt[at][..., None, None]  # at the middle of the interval
    u = np.einsum("wkij,wkj->wki", C[:, :-1], force[at] / dt[at][..., None])
    J = np.concatenate([se3.skew(u) @ swept, -middle], axis=3)
    r = u - np.einsum("wkij,j->wki", middle, accel_bias)
    weight = inside.astype(float)
    for _ in range(2):
        squared = (_centred(r, weight) ** 2).sum(axis=2)
        variance = max(float(np.median(squared[inside])) / MEDIAN_CHI2_3, LEAST_FORCE_SD_M_S2**2)
        weight = inside / (1 + squared / (CAUCHY**2 * variance))
    J, r = _centred(J, weight), _centred(r, weight)
    neighbours = inside[:, 1:] & inside[:, :-1]
    return _Term(np.einsum("wkni,wk,wknj->ij", J, weight, J), np.einsum("wkni,wk,wkn->i", J, weight, r), variance,
                 _correlation(r[:, 1:][neighbours], r[:, :-1][neighbours]))


def _turned_forces(pieces: ImuPieces, bias: Array) -> tuple[Array, Array]:
    """Rotation (M, 3, 3) over every interval, and integral (M, 3) of the force in the axes of its start."""
    steps = se3.so3_exp((pieces.gyro_rad_s - bias) * pieces.dt_s[:, None])
    counts = np.diff(pieces.first)
    R = np.broadcast_to(np.eye(3), (len(counts), 3, 3)).copy()
    total = np.zeros((len(counts), 3))
    for offset in range(int(counts.max(initial=0))):
        active = counts > offset
        k = pieces.first[:-1][active] + offset
        total[active] += np.einsum("kij,kj,k->ki", R[active], pieces.accel_m_s2[k], pieces.dt_s[k])
        R[active] = R[active] @ steps[k]
    return R, total


def _centred(values: Array, weight: Array) -> Array:
    """Values (W, K, …) less their weighted mean in every window."""
    w = weight.reshape(*weight.shape, *[1] * (values.ndim - 2))
    return np.asarray(values - (values * w).sum(axis=1, keepdims=True) / w.sum(axis=1, keepdims=True))


def _rotations(pieces: ImuPieces, dt: Array, seen: SeenRotations, bias: Array) -> _Term:
    """Seen rotations against the gyro's."""
    gyro = preintegrate_rotation(pieces, bias)[seen.interval]
    e = se3.so3_log(np.swapaxes(seen.R, 1, 2) @ gyro)
    whiten = np.linalg.inv(np.linalg.cholesky(seen.cov))
    J = np.zeros((len(e), 3, 6))
    J[:, :, :3] = -whiten @ se3.so3_right_jacobian_inverse(e) * dt[seen.interval, None, None]
    r = (whiten @ e[:, :, None])[:, :, 0]
    squared = (r**2).sum(axis=1)
    variance = max(float(np.median(squared)) / MEDIAN_CHI2_3, LEAST_SPREAD**2)
    weight = 1 / (1 + squared / (CAUCHY**2 * variance))
    neighbours = np.diff(seen.interval) == 1
    return _Term(np.einsum("kni,k,knj->ij", J, weight, J), np.einsum("kni,k,kn->i", J, weight, r), variance,
                 _correlation(r[1:][neighbours], r[:-1][neighbours]))


def _correlation(later: Array, earlier: Array) -> float:
    """Of neighbouring residuals (K, 3) that vary about nought; what looks less than none counts as none."""
    norm = float(np.sqrt((later**2).sum() * (earlier**2).sum()))
    return float(np.clip((later * earlier).sum() / max(norm, 1e-30), 0.0, MOST_CORRELATED))
