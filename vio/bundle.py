"""Bundle adjustment of a window of camera poses and points.

Points are homogeneous 4-vectors of unit length, so that a point without parallax is a direction and no special
case. Levenberg-Marquardt on the Schur complement of the points (Triggs et al., "Bundle adjustment: a modern
synthesis", 2000) with the noise of `vio.track_noise`; all residuals are in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.rays import Rays
from vio.track_noise import TrackNoise, whiten

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

DEPTH_PRIOR_SD = 2.0
"""Sd of a point's inverse distance, in units of the window's median: keeps points without parallax finite."""
FIRST_DAMPING, LEAST_DAMPING, DAMPING_TRIES = 1e-4, 1e-9, 6
SETTLED = 1e-5  # relative fall of the cost at which the iteration ends


@dataclass(frozen=True)
class Window:
    """M poses, P points and O observations, sorted by point and then by pose.

    World axes are arbitrary; their origin should be near the cameras.
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
    fixed: Bools
    """(M,) poses that are taken as known."""

    @property
    def starts(self) -> Bools:
        """(O,) the first observation of every point."""
        return np.append(True, self.point[1:] != self.point[:-1])[: len(self.point)]

    @property
    def unknowns(self) -> int:
        """Numbers that `adjust` determines."""
        return int(6 * (~self.fixed).sum() + 3 * len(self.points))

    def residuals(self) -> Array:
        """(O, 2) pixels."""
        return direction_residuals(self.T_world_camera[self.pose], self.points[self.point], self.rays)[0]


@dataclass(frozen=True)
class Adjustment:
    """What `adjust` found."""

    window: Window
    residual: Array
    """(O, 2) pixels, before whitening."""
    covariance: Array = field(repr=False)
    """(6F, 6F) of the free poses in their order, right perturbation, rotation first; fixed poses count as exact."""


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
    basis: Array = H[:, :, :3]
    return basis


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


class _Problem:
    """A window with everything that stays the same over the iterations."""

    def __init__(self, window: Window, noise: TrackNoise) -> None:
        self.window, self.noise, self.starts = window, noise, window.starts
        self.free = int((~window.fixed).sum())
        rows = np.full(len(window.fixed), -1)
        rows[~window.fixed] = np.arange(self.free)
        self.row = rows[window.pose]
        self.row_before = np.where(self.starts, -1, np.roll(self.row, 1))
        self.inverse_distance = _median_inverse_distance(window)

    def whitened(self, window: Window) -> Array:
        return whiten(window.residuals(), self.starts, self.noise.correlation)

    def depth_prior(self, points: Array) -> tuple[Array, Array]:
        """Residual (P,) of the weak prior on the inverse distance from the origin, and its derivative (P, 4)."""
        sd = DEPTH_PRIOR_SD * self.inverse_distance
        length = np.maximum(np.linalg.norm(points[:, :3], axis=1), 1e-9)
        value = points[:, 3] / length
        slope = np.concatenate([-(value / length**2)[:, None] * points[:, :3], 1 / length[:, None]], axis=1)
        return (value - self.inverse_distance) / sd, slope / sd

    def cost(self, window: Window) -> float:
        return self.noise.cost(self.whitened(window)) + float((self.depth_prior(window.points)[0] ** 2).sum())

    def normal_equations(self, window: Window) -> _Normal:
        """Weighted normal equations at a window, with the whitened residuals' coupling of neighbouring poses."""
        a, starts, basis = self.noise.correlation, self.starts, tangent_basis(window.points)
        r, J_pose, J_point = direction_residuals(
            window.T_world_camera[window.pose], window.points[window.point], window.rays)
        r, J_point = whiten(r, starts, a), whiten(J_point @ basis[window.point], starts, a)
        J_now = J_pose * np.where(starts, np.sqrt(1 - a * a), 1.0)[:, None, None]
        J_before = -a * np.roll(J_pose, 1, axis=0)
        weight = self.noise.weights(r) / self.noise.sigma_px**2
        wr, wJ_point = weight[:, None] * r, weight[:, None, None] * J_point

        prior, slope = self.depth_prior(window.points)
        slope = (slope[:, None, :] @ basis)[:, 0]
        first = np.flatnonzero(starts)
        H_pp = np.add.reduceat(np.swapaxes(J_point, 1, 2) @ wJ_point, first) + slope[:, :, None] * slope[:, None]
        g_p = np.add.reduceat((np.swapaxes(J_point, 1, 2) @ wr[..., None])[..., 0], first) + slope * prior[:, None]

        F, P = self.free, len(window.points)
        H_cc, H_cp, g_c = np.zeros((F * F, 36)), np.zeros((F, P, 6, 3)), np.zeros((F, 6))
        sides = ((self.row, J_now), (self.row_before, J_before))
        for row, J in sides:
            use = row >= 0
            H_cp[row[use], window.point[use]] += np.swapaxes(J[use], 1, 2) @ wJ_point[use]
            np.add.at(g_c, row[use], (np.swapaxes(J[use], 1, 2) @ wr[use][..., None])[..., 0])
            for column, K in sides:
                both = use & (column >= 0)
                block = np.swapaxes(J[both], 1, 2) @ (weight[both, None, None] * K[both])
                np.add.at(H_cc, row[both] * F + column[both], block.reshape(-1, 36))
        H_cc = H_cc.reshape(F, F, 6, 6).transpose(0, 2, 1, 3).reshape(6 * F, 6 * F)
        return _Normal(H_cc, H_cp.transpose(0, 2, 1, 3).reshape(6 * F, P, 3), H_pp, g_c.ravel(), g_p, basis)


def _median_inverse_distance(window: Window) -> float:
    offset = window.points[window.point, :3]
    offset = offset - window.points[window.point, 3:] * window.T_world_camera[window.pose, :3, 3]
    inverse = np.abs(window.points[window.point, 3]) / np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
    return max(float(np.median(inverse)), 1e-6)


def adjust(window: Window, noise: TrackNoise, iterations: int = 15, tolerance: float = SETTLED) -> Adjustment:
    """Move the free poses and all points to the most likely ones under `noise`."""
    problem, damping = _Problem(window, noise), FIRST_DAMPING
    for _ in range(iterations):
        cost, normal = problem.cost(window), problem.normal_equations(window)
        for _ in range(DAMPING_TRIES):
            step = normal.step(damping)
            if step is not None:
                moved = _moved(window, normal.basis, *step)
                new_cost = problem.cost(moved)
                if new_cost < cost:
                    break
            damping *= 10
        else:
            break
        window, damping = moved, max(damping / 10, LEAST_DAMPING)
        if cost - new_cost < tolerance * cost:
            break
    S = problem.normal_equations(window).reduced(0.0)[0] * noise.information_loss
    return Adjustment(window, window.residuals(), np.asarray(np.linalg.pinv(S, hermitian=True), float))


def _moved(window: Window, basis: Array, d_poses: Array, d_points: Array) -> Window:
    T, free = window.T_world_camera.copy(), ~window.fixed
    T[free] = T[free] @ se3.exp(d_poses)
    points = window.points + (basis @ d_points[..., None])[..., 0]
    return replace(window, T_world_camera=T, points=points / np.linalg.norm(points, axis=1, keepdims=True))
