"""IMU pieces → one inertial step per frame interval, for all intervals at once in numpy.

What a preintegrator of gtsam does piece by piece, in closed form. With R_t the attitude at the start of piece t in the
body axes of the interval's first frame, f_t = R_t (a_t - b_a) and τ_t the time left after piece t:

    ΔR = Π Exp((ω_t - b_g) dt_t),   Δv = Σ f_t dt_t,   Δp = Σ f_t dt_t (τ_t + dt_t/2)

A gyro error in piece s turns everything after it by φ_s, so that δv = -[F_v,s]× φ_s and δp = -[F_p,s]× φ_s, where
F_v,s and F_p,s are the parts of Δv and Δp still to come. White gyro noise makes the φ_s independent and isotropic, and
the covariance is a sum over pieces, without propagation. Same model as Forster, Carlone, Dellaert, Scaramuzza,
"On-Manifold Preintegration for Real-Time Visual-Inertial Odometry" (2017), section VI.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.preintegration import INTEGRATION_DENSITY
from vio import se3
from vio.imu import ImuNoise, ImuPieces

Array = NDArray[np.float64]

BLOCK_PIECES = 40_000
"""Pieces handled at a time: what stays in a processor's cache is several times faster."""
EYE = np.eye(3)


@dataclass(frozen=True)
class InertialSteps:
    """N preintegrated intervals, linearised at one bias. Rows of `whiten`: rotation, velocity, position."""

    dt_s: Array
    """(N,)"""
    R: Array
    """(N, 3, 3) rotation from the first frame of the interval to its second."""
    v: Array
    """(N, 3) velocity change without gravity, in body axes of the first frame [m/s]."""
    p: Array
    """(N, 3) position change without gravity and initial velocity [m]."""
    R_bg: Array
    """(N, 3, 3) derivative of the rotation (right perturbation) with respect to the gyro bias."""
    v_bg: Array
    v_ba: Array
    p_bg: Array
    p_ba: Array
    whiten: Array
    """(N, 9, 9) inverse Cholesky factor of the covariance of (rotation, velocity, position)."""
    free_fall: Array
    """(N,) 1 where the step is inertial; 0 where it only links two states across a gap."""
    bias_walk_sd: Array
    """(N, 6) random walk of accelerometer and gyro bias over the interval."""
    accel_bias: Array
    """(3,) linearisation point."""
    gyro_bias: Array
    """(3,)"""

    def __len__(self) -> int:
        return len(self.dt_s)

    def part(self, first: int, last: int) -> InertialSteps:
        """Intervals `first` to `last` (exclusive), as views."""
        cut = slice(first, last)
        return InertialSteps(self.dt_s[cut], self.R[cut], self.v[cut], self.p[cut], self.R_bg[cut], self.v_bg[cut],
                             self.v_ba[cut], self.p_bg[cut], self.p_ba[cut], self.whiten[cut], self.free_fall[cut],
                             self.bias_walk_sd[cut], self.accel_bias, self.gyro_bias)

    def loosened(self, bias_slack: Array) -> InertialSteps:
        """The same with biases that may change by more than their random walk: (N, 2), see `Problem.bias_slack`."""
        return replace(self, bias_walk_sd=np.hypot(self.bias_walk_sd, np.repeat(bias_slack, 3, axis=1)))

    def rotations(self, gyro_bias_rad_s: Array) -> Array:
        """(N, 3, 3) rotations corrected to another gyro bias (3,)."""
        return np.asarray(self.R @ se3.so3_exp(self.R_bg @ (gyro_bias_rad_s - self.gyro_bias)))


def preintegrate_steps(pieces: ImuPieces, noise: ImuNoise, gyro_bias_rad_s: Array, accel_inflation: Array,
                       gyro_inflation: Array) -> InertialSteps:
    """Preintegrate all N intervals at a zero accelerometer bias and one gyro bias.

    Args:
        pieces: the cut IMU, forces in the axes at their piece's start.
        noise: continuous densities and walks.
        gyro_bias_rad_s: (3,) linearisation point; corrections to it are of first order.
        accel_inflation: (N,) factor on the accelerometer density in every interval, at least 1.
        gyro_inflation: (N,) factor on the gyro density.
    """
    n = len(pieces.first) - 1
    out = {name: np.empty((n, 3, 3)) for name in ("R", "R_bg", "v_bg", "v_ba", "p_bg", "p_ba")}
    dt, v, p = np.empty(n), np.empty((n, 3)), np.empty((n, 3))
    cov = np.empty((n, 9, 9))
    gyro_var = (noise.gyro_density_rad_s_rthz * np.maximum(gyro_inflation, 1.0)) ** 2
    accel_var = (noise.accel_density_m_s2_rthz * np.maximum(accel_inflation, 1.0)) ** 2
    for first, last in _blocks(pieces.first):
        cut = slice(first, last)
        block = _integrate(pieces, first, last, gyro_bias_rad_s, gyro_var[cut], accel_var[cut])
        dt[cut], v[cut], p[cut], cov[cut] = block["dt"], block["v"], block["p"], block["cov"]
        for name, values in out.items():
            values[cut] = block[name]
    walk = np.repeat([noise.accel_walk_m_s3_rthz, noise.gyro_walk_rad_s2_rthz], 3)
    return InertialSteps(dt, out["R"], v, p, out["R_bg"], out["v_bg"], out["v_ba"], out["p_bg"], out["p_ba"],
                         _whiten(cov), np.ones(n), walk * np.sqrt(dt)[:, None], np.zeros(3),
                         np.array(gyro_bias_rad_s, float))


def _blocks(first: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Spans of intervals that hold about `BLOCK_PIECES` pieces each, padding to the longest interval included."""
    counts = np.diff(first)
    spans, begin, longest = [], 0, 1
    for k, count in enumerate(counts.tolist()):
        longest = max(longest, count)
        if k > begin and longest * (k + 1 - begin) > BLOCK_PIECES:
            spans.append((begin, k))
            begin, longest = k, max(1, count)
    spans.append((begin, len(counts)))
    return spans


def _integrate(pieces: ImuPieces, lo: int, hi: int, gyro_bias: Array, gyro_var: Array,
               accel_var: Array) -> dict[str, Array]:
    """All quantities of intervals lo to hi (exclusive); padded pieces have no length."""
    counts = np.diff(pieces.first[lo:hi + 1])
    steps = int(counts.max(initial=0))
    index = pieces.first[lo:hi] + np.arange(steps)[:, None]
    inside = np.arange(steps)[:, None] < counts
    index = np.where(inside, index, 0)
    dt = np.where(inside, pieces.dt_s[index], 0.0)
    turn = se3.so3_exp(((pieces.gyro_rad_s[index] - gyro_bias) * dt[:, :, None]).reshape(-1, 3))
    turn = turn.reshape(steps, hi - lo, 3, 3)
    R = np.empty((steps + 1, hi - lo, 3, 3))
    R[0] = EYE
    for t in range(steps):
        R[t + 1] = R[t] @ turn[t]
    force = (R[:-1] @ pieces.accel_m_s2[index][..., None])[..., 0]
    return _sums(R, force, dt, gyro_var, accel_var)


def _sums(R: Array, force: Array, dt: Array, gyro_var: Array, accel_var: Array) -> dict[str, Array]:
    """Backward over the pieces: what is still to come turns with every gyro error before it."""
    b = dt.shape[1]
    v, p, left = np.zeros((b, 3)), np.zeros((b, 3)), np.zeros(b)
    R_bg, v_ba, p_ba, v_bg, p_bg = (np.zeros((b, 3, 3)) for _ in range(5))
    v_phi, p_phi = np.zeros((b, 3)), np.zeros((b, 3))
    vv, vp, pp = (np.zeros((b, 3, 3)) for _ in range(3))
    lever, lever_squared = np.zeros(b), np.zeros(b)
    for t in range(len(dt) - 1, -1, -1):
        h = dt[t, :, None]
        G = 0.5 * h[:, :, None] * (R[t] + R[t + 1])
        R_bg -= G
        v_bg += _cross(v, G)
        p_bg += _cross(p, G)
        v_phi += h * v
        p_phi += h * p
        hv, hp = h * v, h * p
        vv += hv[:, :, None] * v[:, None, :]
        vp += hp[:, :, None] * v[:, None, :]
        pp += hp[:, :, None] * p[:, None, :]
        arm = left + 0.5 * dt[t]
        step = force[t] * h
        v = v + step
        p = p + step * arm[:, None]
        v_ba -= h[:, :, None] * R[t]
        p_ba -= (h[:, :, None] * arm[:, None, None]) * R[t]
        lever += dt[t] * arm
        lever_squared += dt[t] * (arm**2 + dt[t] ** 2 / 12)
        left = left + dt[t]
    cov = _covariance(R[-1], left, (v_phi, p_phi), (vv, vp, pp), (lever, lever_squared), gyro_var, accel_var)
    return {"dt": left, "R": R[-1], "v": v, "p": p, "R_bg": np.swapaxes(R[-1], 1, 2) @ R_bg, "v_bg": v_bg,
            "v_ba": v_ba, "p_bg": p_bg, "p_ba": p_ba, "cov": cov}


def _cross(a: Array, B: Array) -> Array:
    """[a]× B for vectors (b, 3) and matrices (b, 3, 3)."""
    return np.asarray(se3.skew(a) @ B)


def _covariance(R: Array, dt: Array, first: tuple[Array, Array], second: tuple[Array, Array, Array],
                levers: tuple[Array, Array], gyro_var: Array, accel_var: Array) -> Array:
    """(b, 9, 9) of rotation (right perturbation), velocity and position."""
    g, a = gyro_var[:, None, None], accel_var[:, None, None]
    cov = np.zeros((len(dt), 9, 9))
    cov[:, :3, :3] = g * dt[:, None, None] * EYE
    cov[:, 3:6, :3] = -g * se3.skew(first[0]) @ R
    cov[:, 6:, :3] = -g * se3.skew(first[1]) @ R
    traces = [np.trace(m, axis1=1, axis2=2)[:, None, None] * EYE - m for m in second]
    cov[:, 3:6, 3:6] = g * traces[0] + a * dt[:, None, None] * EYE
    cov[:, 3:6, 6:] = g * traces[1] + a * levers[0][:, None, None] * EYE
    cov[:, 6:, 6:] = (g * traces[2] + (a * levers[1][:, None, None] + INTEGRATION_DENSITY**2 * dt[:, None, None]) * EYE)
    cov[:, 6:, 3:6] = np.swapaxes(cov[:, 3:6, 6:], 1, 2)
    cov[:, :3, 3:] = np.swapaxes(cov[:, 3:, :3], 1, 2)
    return cov


def _whiten(cov: Array) -> Array:
    """Inverse Cholesky factors (N, 9, 9), block by block."""
    whiten = np.empty_like(cov)
    for first in range(0, len(cov), 2000):
        part = slice(first, first + 2000)
        whiten[part] = np.linalg.inv(np.linalg.cholesky(cov[part]))
    return whiten
