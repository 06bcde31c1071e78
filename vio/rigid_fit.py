"""Rigid motion between two clouds of matched points, for many pairs of frames at once.

Robust weighted Kabsch to start (Umeyama, "Least-squares estimation of transformation parameters between two point
patterns", 1991, without scale), then Gauss-Newton with each point's own 3 x 3 information: a depth map knows a point
far better across the ray than along it. Cauchy weights; the covariance is that of an M-estimator (Huber, "Robust
Statistics", 1981), so it follows the residuals rather than the sigmas it was told.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.errors import TrackingError

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

CAUCHY = 2.4
"""Whitened distance, in sigmas, at which a point's weight has fallen to one half."""
ITERATIONS = 5
LEAST_POINTS = 3
PRIOR_DOF = 6.0
"""How many residuals the given sigmas are worth when they are compared with the data."""
OBSERVABLE = 1e-6
"""Smallest eigenvalue of the scaled information, relative to the largest, that counts as measured."""
UNOBSERVED_SD = 10.0
"""Sd of what is not measured: radians, and extents of the cloud."""
MEDIAN_CHI2_3 = 2.366  # of the squared length of a 3-vector of standard normals


@dataclass(frozen=True)
class RigidFit:
    """Motions of N pairs of clouds."""

    T_i_j: Array
    """(N, 4, 4): `points_i = T_i_j points_j`."""
    cov: Array
    """(N, 6, 6) right perturbation, rotation first, rad and units of the points; huge along what is not measured."""
    weight: Array
    """(N, P) in 0..1, 0 where invalid: which points were believed."""
    observable: Bools
    """(N,) all six numbers are measured. False for fewer than three points, and for points on a line."""


def fit_rigid(points_i: ArrayLike, points_j: ArrayLike, sigma: ArrayLike = 1.0, valid: ArrayLike | None = None,
              information: ArrayLike | None = None) -> RigidFit:
    """The rigid motions that take clouds j onto clouds i.

    Args:
        points_i: (N, P, 3) points in the axes of the first frame of every pair.
        points_j: (N, P, 3) the same points in the axes of the second.
        sigma: sd of `points_i - T points_j` per axis; broadcast to (N, P).
        valid: (N, P) entries to use; all when None. Entries that are not may hold anything, also NaN.
        information: (N, P, 3, 3) inverse covariance of the difference in the axes of i; replaces `sigma`.

    Raises:
        TrackingError: shapes disagree, a used number is not finite, a sigma is not positive, or no pair has three
            points.
    """
    p, q, use = _checked(points_i, points_j, valid)
    omega = _information(sigma, information, use)
    size = np.trace(omega, axis1=2, axis2=3) / 3  # (N, P)
    weight = use.astype(float)
    for _ in range(ITERATIONS):
        T = _kabsch(p, q, weight * size)
        weight = _cauchy(_distance2(T, p, q, omega), use)
    for _ in range(ITERATIONS):
        T, _ = _gauss_newton(T, p, q, omega, weight)
        weight = _cauchy(_distance2(T, p, q, omega), use)
    cov, observable = _covariance(T, p, q, omega, use)
    return RigidFit(T, cov, weight, observable)


def _checked(points_i: ArrayLike, points_j: ArrayLike, valid: ArrayLike | None) -> tuple[Array, Array, Bools]:
    p, q = np.array(points_i, float), np.array(points_j, float)
    if p.ndim != 3 or p.shape[-1] != 3 or p.shape != q.shape:
        raise TrackingError(f"rigid fit: points of shape {p.shape} and {q.shape}; expected (N, P, 3) twice")
    use: Bools = np.ones(p.shape[:2], bool) if valid is None else np.array(valid, bool)
    if use.shape != p.shape[:2]:
        raise TrackingError(f"rigid fit: valid has shape {use.shape}, expected {p.shape[:2]}")
    broken = use & ~(np.isfinite(p).all(axis=2) & np.isfinite(q).all(axis=2))
    if broken.any():
        n, k = np.argwhere(broken)[0]
        raise TrackingError(f"rigid fit: point {k} of pair {n} is not finite; mark it invalid")
    if use.size == 0 or use.sum(axis=1).max() < LEAST_POINTS:
        most = int(use.sum(axis=1).max(initial=0)) if use.size else 0
        raise TrackingError(f"rigid fit: at most {most} points per pair; a rigid motion needs {LEAST_POINTS}")
    p[~use] = q[~use] = 0.0
    return p, q, use


def _information(sigma: ArrayLike, information: ArrayLike | None, use: Bools) -> Array:
    """(N, P, 3, 3), zero where unused."""
    if information is not None:
        omega = np.array(information, float)
        if omega.shape != (*use.shape, 3, 3) or not np.isfinite(omega[use]).all():
            raise TrackingError(f"rigid fit: information must be finite with shape {(*use.shape, 3, 3)}")
        omega[~use] = 0.0
        return omega
    try:
        sd = np.broadcast_to(np.asarray(sigma, float), use.shape)
    except ValueError:
        raise TrackingError(f"rigid fit: sigma has shape {np.shape(sigma)}, expected {use.shape}") from None
    if not (np.isfinite(sd[use]) & (sd[use] > 0)).all():
        raise TrackingError("rigid fit: a sigma is not a positive number; mark points without one invalid")
    return np.asarray(np.where(use, 1 / np.where(use, sd, 1.0) ** 2, 0.0)[..., None, None] * np.eye(3))


def _kabsch(p: Array, q: Array, weight: Array) -> Array:
    w = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    mean_p, mean_q = (w[:, None] @ p), (w[:, None] @ q)  # (N, 1, 3)
    U, _, Vt = np.linalg.svd(np.swapaxes((p - mean_p) * w[..., None], 1, 2) @ (q - mean_q))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return se3.transform(R, mean_p[:, 0] - (R @ mean_q[:, 0, :, None])[..., 0])


def _difference(T: Array, p: Array, q: Array) -> Array:
    return np.asarray(p - (q @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]))


def _distance2(T: Array, p: Array, q: Array, omega: Array) -> Array:
    e = _difference(T, p, q)
    return np.asarray(np.einsum("npi,npij,npj->np", e, omega, e, optimize=True))


def _spread2(distance2: Array, use: Bools) -> Array:
    """(N, 1) variance of the whitened residuals from their median, at least that of exact data."""
    ordered = np.sort(np.where(use, distance2, np.inf), axis=1)
    middle = np.maximum(use.sum(axis=1) - 1, 0)[:, None] // 2
    median = np.where(use.any(axis=1, keepdims=True), np.take_along_axis(ordered, middle, axis=1), 0.0)
    return np.maximum(median / MEDIAN_CHI2_3, 1e-24)


def _cauchy(distance2: Array, use: Bools) -> Array:
    return np.where(use, 1 / (1 + distance2 / (CAUCHY**2 * _spread2(distance2, use))), 0.0)


def _jacobian(T: Array, q: Array) -> Array:
    """(N, P, 3, 6) of `p - T Exp(xi) q` by xi."""
    R = T[:, None, :3, :3]
    return np.concatenate([R @ se3.skew(q), -np.broadcast_to(R, (*q.shape, 3))], axis=3)


def _hessian(J: Array, omega: Array, weight: Array) -> tuple[Array, Array]:
    """(N, 6, 6) weighted information, and J with it applied, (N, P, 6, 3)."""
    JtO = np.swapaxes(J, 2, 3) @ (weight[..., None, None] * omega)
    return np.asarray((JtO @ J).sum(axis=1)), JtO


def _gauss_newton(T: Array, p: Array, q: Array, omega: Array, weight: Array) -> tuple[Array, Array]:
    H, JtO = _hessian(_jacobian(T, q), omega, weight)
    g = (JtO @ _difference(T, p, q)[..., None]).sum(axis=1)
    step = -np.linalg.pinv(H, rcond=1e-10, hermitian=True) @ g
    return T @ se3.exp(step[..., 0]), H


def _covariance(T: Array, p: Array, q: Array, omega: Array, use: Bools) -> tuple[Array, Bools]:
    distance2 = _distance2(T, p, q, omega)
    n = use.sum(axis=1)
    spread2 = _spread2(distance2, use)
    w = _cauchy(distance2, use)
    count = np.maximum(n, 1)
    score2 = (w**2 * distance2).sum(axis=1) / (3 * count)
    slope = (w - 2 / 3 * w**2 * distance2 / (CAUCHY**2 * spread2)).sum(axis=1) / count
    dof = np.maximum(3 * n - 6, 0)
    measured = score2 / np.maximum(slope, 0.1) ** 2 * 3 * n / np.maximum(dof, 1)
    factor = (PRIOR_DOF + dof * measured) / (PRIOR_DOF + dof)
    H = _hessian(_jacobian(T, q), omega, use.astype(float))[0]
    return _inverse_information(H, q, use, factor)


def _inverse_information(H: Array, q: Array, use: Bools, factor: Array) -> tuple[Array, Bools]:
    """Covariances and which are complete; translation is measured in extents of the cloud so that all six compare."""
    n = np.maximum(use.sum(axis=1), 1)[:, None]
    extent = np.sqrt((np.where(use, (q**2).sum(axis=2), 0).sum(axis=1)) / n[:, 0])
    extent = np.where(extent > 0, extent, 1.0)
    unit = np.concatenate([np.ones((len(q), 3)), np.repeat(extent[:, None], 3, axis=1)], axis=1)
    value, vector = np.linalg.eigh(H * unit[:, :, None] * unit[:, None, :])
    clear = value > OBSERVABLE * value[:, -1:]
    clear &= value[:, -1:] > 0
    variance = np.where(clear, factor[:, None] / np.where(clear, value, 1.0), UNOBSERVED_SD**2)
    cov = (vector * variance[:, None]) @ np.swapaxes(vector, 1, 2) * unit[:, :, None] * unit[:, None, :]
    return 0.5 * (cov + np.swapaxes(cov, 1, 2)), np.asarray(clear.all(axis=1) & (use.sum(axis=1) >= LEAST_POINTS))
