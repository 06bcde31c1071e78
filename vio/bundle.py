"""Bundle adjustment of a window of camera poses and points, for tracks whose errors drift.

A tracker that follows a patch from frame to frame hands its error on: the error of a track is a slow random
walk rather than fresh noise in every frame. Here it is first-order autoregressive, `e_k = a e_{k-1} + n_k`
along every track, with `a` and the scale of `n` estimated from the residuals; `a = 0` is ordinary white noise.
Points are homogeneous 4-vectors of unit length, so that a point without parallax is a direction and no
special case. Levenberg-Marquardt on the Schur complement of the points (Triggs et al., "Bundle adjustment:
a modern synthesis", 2000); Cauchy loss on the whitened residual; all residuals are in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.rays import Rays

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MAD_TO_SIGMA = 1.4826
CAUCHY = 2.0
"""Whitened residual, in sigmas, at which the weight has fallen to one half."""
DEPTH_PRIOR_SD = 2.0
"""Sd of a point's inverse distance, in units of the window's median: keeps points without parallax finite."""
SIGMA_FLOOR_PX = 1e-4
FIRST_DAMPING, LEAST_DAMPING, DAMPING_TRIES = 1e-4, 1e-9, 6
SETTLED = 1e-5  # relative fall of the cost at which the iteration ends


@dataclass(frozen=True)
class Window:
    """M poses, P points and O observations, sorted by point and then by pose.

    World axes are arbitrary; coordinates should be of the size of the scene and near its middle.
    """

    T_world_camera: Array
    """(M, 4, 4)"""
    points: Array
    """(P, 4) homogeneous, unit length; its sign makes the direction seen from a camera point outward."""
    pose: Ints
    """(O,) row of `T_world_camera`."""
    point: Ints
    """(O,) row of `points`, never decreasing."""
    rays: Rays
    """O measured directions."""
    fixed: NDArray[np.bool_]
    """(M,) poses that are taken as known."""

    @property
    def starts_track(self) -> NDArray[np.bool_]:
        """(O,) the first observation of every point."""
        return np.append(True, self.point[1:] != self.point[:-1])[: len(self.point)]


@dataclass(frozen=True)
class NoiseModel:
    """How the errors of tracks behave."""

    correlation: float = 0.9
    """`a` in `e_k = a e_{k-1} + n_k`."""
    sigma_px: float | None = None
    """Sd of `n`; estimated when None."""


@dataclass(frozen=True)
class Adjustment:
    """What `adjust` found."""

    window: Window
    sigma_px: float
    """Robust sd of the whitened residual."""
    residual: Array
    """(O, 2) pixels, before whitening."""
    weight: Array
    """(O,) Cauchy weights of the whitened residuals, 1 = fully believed."""
    covariance: Array = field(repr=False)
    """(6F, 6F) of the free poses in their order, right perturbation, rotation first."""


def direction_residuals(T: Array, points: Array, rays: Rays) -> tuple[Array, Array, Array]:
    """Residuals (O, 2) [px] and their derivatives (O, 2, 6) by the pose and (O, 2, 4) by the point.

    Args:
        T: (O, 4, 4) pose of the camera of every observation.
        points: (O, 4) homogeneous point of every observation.
        rays: O measured directions.
    """
    R_t, t, scale = np.swapaxes(T[:, :3, :3], 1, 2), T[:, :3, 3], points[:, 3:]
    q = (R_t @ (points[:, :3] - scale * t)[..., None])[..., 0]
    length = np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12)
    d = q / length
    by_q = rays.to_pixels @ (np.eye(3) - d[:, :, None] * d[:, None, :]) / length[..., None]
    by_pose = np.concatenate([by_q @ se3.skew(q), -by_q * scale[..., None]], axis=2)
    by_point = by_q @ np.concatenate([R_t, -(R_t @ t[..., None])], axis=2)
    return (rays.to_pixels @ (d - rays.bearing)[..., None])[..., 0], by_pose, by_point


def tangent_basis(points: Array) -> Array:
    """(P, 4, 3) orthonormal complement of unit 4-vectors (P, 4), by a Householder reflection."""
    v = points.copy()
    v[:, 3] += np.where(v[:, 3] >= 0, 1.0, -1.0)
    H = np.eye(4) - 2 * v[:, :, None] * v[:, None, :] / (v * v).sum(axis=1)[:, None, None]
    return H[:, :, :3]


def whiten(values: Array, starts: NDArray[np.bool_], correlation: float) -> Array:
    """`v_k - a v_{k-1}` along every track of (O, ...) values; a track's first value is scaled to the same variance."""
    shifted = np.roll(values, 1, axis=0) * correlation
    expand = starts.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(np.where(expand, values * np.sqrt(1 - correlation**2), values - shifted))


def robust_sigma(whitened: Array, starts: NDArray[np.bool_], unknowns: int) -> float:
    """Sd of the whitened residuals (O, 2) from their median size, corrected for the unknowns they were fitted with."""
    inner = whitened[~starts]
    if len(inner) == 0:
        return SIGMA_FLOOR_PX
    dof = max(1.0 - unknowns / whitened.size, 0.2)
    return max(float(MAD_TO_SIGMA * np.median(np.abs(inner)) / np.sqrt(dof)), SIGMA_FLOOR_PX)


class _Problem:
    """The window with everything that stays the same over the iterations."""

    def __init__(self, window: Window, noise: NoiseModel) -> None:
        self.window, self.a = window, noise.correlation
        self.starts = window.starts_track
        self.rows = np.full(len(window.fixed), -1)
        self.rows[~window.fixed] = np.arange((~window.fixed).sum())
        self.free = int((~window.fixed).sum())
        self.row = self.rows[window.pose]
        self.before = np.where(self.starts, -1, np.roll(self.row, 1))
        self.inverse_distance = self._median_inverse_distance()
        self.unknowns = 6 * self.free + 3 * len(window.points)

    def _median_inverse_distance(self) -> float:
        w = self.window
        offset = w.points[w.point, :3] - w.points[w.point, 3:] * w.T_world_camera[w.pose, :3, 3]
        inverse = np.abs(w.points[w.point, 3]) / np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
        return max(float(np.median(inverse)), 1e-6) if len(inverse) else 1.0

    def whitened(self, T: Array, points: Array) -> tuple[Array, Array]:
        w = self.window
        r = direction_residuals(T[w.pose], points[w.point], w.rays)[0]
        return r, whiten(r, self.starts, self.a)

    def depth_prior(self, points: Array) -> tuple[Array, Array]:
        """Residual (P,) of the weak prior on the inverse distance from the origin, and its derivative (P, 4)."""
        sd = DEPTH_PRIOR_SD * self.inverse_distance
        length = np.maximum(np.linalg.norm(points[:, :3], axis=1), 1e-9)
        value = points[:, 3] / length
        slope = np.concatenate([-(value / length**2)[:, None] * points[:, :3], 1 / length[:, None]], axis=1)
        return (value - self.inverse_distance) / sd, slope / sd

    def cost(self, T: Array, points: Array, sigma: float) -> float:
        z2 = (self.whitened(T, points)[1] ** 2).sum(axis=1) / sigma**2
        prior = self.depth_prior(points)[0]
        return float((CAUCHY**2 * np.log1p(z2 / CAUCHY**2)).sum() + (prior**2).sum())

    def normal_equations(self, T: Array, points: Array, sigma: float) -> _Normal:
        w, a, F, P = self.window, self.a, self.free, len(points)
        r, J_pose, J_point = direction_residuals(T[w.pose], points[w.point], w.rays)
        basis = tangent_basis(points)
        J_point = J_point @ basis[w.point]
        r, J_point = whiten(r, self.starts, a), whiten(J_point, self.starts, a)
        J_now = J_pose * np.where(self.starts, np.sqrt(1 - a * a), 1.0)[:, None, None]
        J_old = -a * np.roll(J_pose, 1, axis=0)
        weight = 1 / (1 + (r**2).sum(axis=1) / (sigma * CAUCHY) ** 2) / sigma**2
        wr, wJ_point = weight[:, None] * r, weight[:, None, None] * J_point

        prior, prior_slope = self.depth_prior(points)
        prior_slope = (prior_slope[:, None, :] @ basis)[:, 0]
        first = np.flatnonzero(self.starts)
        H_pp = np.add.reduceat(np.swapaxes(J_point, 1, 2) @ wJ_point, first) + prior_slope[:, :, None] * prior_slope[:, None]
        g_p = np.add.reduceat(np.einsum("oij,oi->oj", J_point, wr), first) + prior_slope * prior[:, None]

        H_cc, H_cp, g_c = np.zeros((F * F, 36)), np.zeros((F, P, 6, 3)), np.zeros((F, 6))
        sides = ((self.row, J_now), (self.before, J_old))
        for row, J in sides:
            use = row >= 0
            H_cp[row[use], w.point[use]] += np.swapaxes(J[use], 1, 2) @ wJ_point[use]
            np.add.at(g_c, row[use], np.einsum("oij,oi->oj", J[use], wr[use]))
            for column, K in sides:
                both = use & (column >= 0)
                block = np.swapaxes(J[both], 1, 2) @ (weight[both, None, None] * K[both])
                np.add.at(H_cc, row[both] * F + column[both], block.reshape(-1, 36))
        H_cc = H_cc.reshape(F, F, 6, 6).transpose(0, 2, 1, 3).reshape(6 * F, 6 * F)
        H_cp = H_cp.transpose(0, 2, 1, 3).reshape(6 * F, P, 3)
        return _Normal(H_cc, H_cp, H_pp, g_c.ravel(), g_p, basis)


@dataclass(frozen=True)
class _Normal:
    """Blocks of the normal equations: poses c (6F), points p (P, 3)."""

    H_cc: Array
    H_cp: Array
    H_pp: Array
    g_c: Array
    g_p: Array
    basis: Array

    def reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """Schur complement (6F, 6F), the inverse point blocks (P, 3, 3) and H_cp times them (6F, P, 3)."""
        trace = np.trace(self.H_pp, axis1=1, axis2=2)[:, None, None]
        H_inv = np.linalg.inv(self.H_pp + (damping * trace / 3 + 1e-12) * np.eye(3))
        weighted = np.einsum("cpi,pij->cpj", self.H_cp, H_inv)
        n, k = self.H_cc.shape[0], self.H_cp.shape[1] * 3
        S = self.H_cc - weighted.reshape(n, k) @ self.H_cp.reshape(n, k).T
        S[np.diag_indices(n)] += damping * np.diag(self.H_cc) + 1e-12
        return 0.5 * (S + S.T), H_inv, weighted

    def step(self, damping: float) -> tuple[Array, Array] | None:
        """Changes of the poses (F, 6) and points (P, 3); None where the system is not positive definite."""
        S, H_inv, weighted = self.reduced(damping)
        n, k = S.shape[0], self.g_p.size
        try:
            L = np.linalg.cholesky(S)
        except np.linalg.LinAlgError:
            return None
        g = self.g_c - weighted.reshape(n, k) @ self.g_p.ravel()
        d_c = -np.linalg.solve(L.T, np.linalg.solve(L, g))
        d_p = -np.einsum("pij,pj->pi", H_inv, self.g_p + np.einsum("cpi,c->pi", self.H_cp, d_c))
        return d_c.reshape(-1, 6), d_p


def adjust(window: Window, noise: NoiseModel, iterations: int = 15, tolerance: float = SETTLED) -> Adjustment:
    """Minimise the reprojection error over the free poses and all points.

    Returns:
        The window at the minimum. Its covariance counts the fixed poses as exact.
    """
    problem = _Problem(window, noise)
    T, points = window.T_world_camera.copy(), window.points.copy()
    free = ~window.fixed
    damping = FIRST_DAMPING

    def sigma_at(T: Array, points: Array) -> float:
        if noise.sigma_px is not None:
            return noise.sigma_px
        return robust_sigma(problem.whitened(T, points)[1], problem.starts, problem.unknowns)

    sigma = sigma_at(T, points)
    for _ in range(iterations):
        cost = problem.cost(T, points, sigma)
        normal = problem.normal_equations(T, points, sigma)
        for _ in range(DAMPING_TRIES):
            step = normal.step(damping)
            if step is not None:
                T_new, points_new = T.copy(), points + (normal.basis @ step[1][..., None])[..., 0]
                T_new[free] = T[free] @ se3.exp(step[0])
                points_new /= np.linalg.norm(points_new, axis=1, keepdims=True)
                new_cost = problem.cost(T_new, points_new, sigma)
                if new_cost < cost:
                    break
            damping *= 10
        else:
            break
        T, points = T_new, points_new
        damping = max(damping / 10, LEAST_DAMPING)
        sigma = sigma_at(T, points)
        if cost - new_cost < tolerance * cost:
            break
    residual, white = problem.whitened(T, points)
    weight = 1 / (1 + (white**2).sum(axis=1) / (sigma * CAUCHY) ** 2)
    S = problem.normal_equations(T, points, sigma).reduced(0.0)[0]
    done = replace(window, T_world_camera=T, points=points)
    return Adjustment(done, sigma, residual, weight, np.linalg.pinv(S, hermitian=True))
