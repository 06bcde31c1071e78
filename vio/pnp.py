"""The pose of a camera that sees known points: three-point RANSAC on rays, then robust Gauss-Newton.

Three points: Grunert's quartic as reviewed by Haralick et al., "Review and analysis of solutions of the three
point perspective pose estimation problem" (1994). Works on unit rays of any field of view.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.bundle import direction_residuals
from vio.rays import Rays
from vio.track_noise import TrackNoise

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

SAMPLES = 150
REFINEMENTS = 12


def three_point_poses(points: Array, bearings: Array) -> Array:
    """Poses `T_world_camera` (K, 4, 4) of samples of three world points (N, 3, 3) and their unit rays (N, 3, 3)."""
    side = points[:, [1, 0, 0]] - points[:, [2, 2, 1]]
    a2, b2, c2 = np.moveaxis((side**2).sum(axis=2), 1, 0)
    cos_a, cos_b, cos_c = np.moveaxis((bearings[:, [1, 0, 0]] * bearings[:, [2, 2, 1]]).sum(axis=2), 1, 0)
    usable = np.minimum(np.minimum(a2, b2), c2) > 1e-12 * np.maximum(np.maximum(a2, b2), 1e-300)
    b2 = np.where(usable, b2, 1.0)
    d, s, p, q = (a2 - c2) / b2, (a2 + c2) / b2, a2 / b2, c2 / b2
    quartic = np.stack([
        (d - 1) ** 2 - 4 * q * cos_a**2,
        4 * (d * (1 - d) * cos_b - (1 - s) * cos_a * cos_c + 2 * q * cos_a**2 * cos_b),
        2 * (d**2 - 1 + 2 * d**2 * cos_b**2 + 2 * (1 - q) * cos_a**2 - 4 * s * cos_a * cos_b * cos_c
             + 2 * (1 - p) * cos_c**2),
        4 * (-d * (1 + d) * cos_b + 2 * p * cos_c**2 * cos_b - (1 - s) * cos_a * cos_c),
        (1 + d) ** 2 - 4 * p * cos_c**2], axis=1)
    usable &= np.abs(quartic[:, 0]) > 1e-12
    companion = np.zeros((len(points), 4, 4))
    companion[:, 1, 0] = companion[:, 2, 1] = companion[:, 3, 2] = 1
    companion[usable, :, 3] = -quartic[usable, :0:-1] / quartic[usable, :1]
    roots = np.linalg.eigvals(companion)
    n, k = np.nonzero((np.abs(roots.imag) < 1e-6) & (roots.real > 0) & usable[:, None])
    v = roots[n, k].real
    denominator = 2 * (cos_c[n] - v * cos_a[n])
    safe = np.abs(denominator) > 1e-9
    n, v, denominator = n[safe], v[safe], denominator[safe]
    u = ((d[n] - 1) * v**2 - 2 * d[n] * cos_b[n] * v + 1 + d[n]) / denominator
    first = np.sqrt(b2[n] / np.maximum(1 + v**2 - 2 * v * cos_b[n], 1e-12))
    front = u > 0
    n, distance = n[front], np.stack([first, u * first, v * first], axis=1)[front]
    return _align(points[n], bearings[n] * distance[..., None])


def _align(world: Array, camera: Array) -> Array:
    """Rigid `T_world_camera` (K, 4, 4) that takes triangles (K, 3, 3) in camera axes onto triangles in the world."""
    mean_w, mean_c = world.mean(axis=1, keepdims=True), camera.mean(axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd(np.swapaxes(world - mean_w, 1, 2) @ (camera - mean_c))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return se3.transform(R, mean_w[:, 0] - (R @ mean_c[:, 0, :, None])[..., 0])


def find_pose(points: Array, rays: Rays, usable: Bools, threshold_px: float, rng: np.random.Generator,
              guesses: Array | None = None) -> tuple[Array, Bools] | None:
    """The pose (4, 4) that most of n points agree with, and which ones (n,) do; None when there is no candidate.

    Args:
        points: (n, 4) homogeneous world points.
        rays: their directions as seen by the camera.
        usable: (n,) points whose distance is known well enough to sample from.
        threshold_px: residual at which a point counts as wrong.
        rng: source of the samples.
        guesses: (G, 4, 4) poses that compete with the samples.
    """
    candidates = [] if guesses is None else [guesses]
    known = np.flatnonzero(usable)
    if len(known) >= 3:
        sample = known[rng.random((SAMPLES, len(known))).argsort(axis=1)[:, :3]]
        world = points[sample, :3] / points[sample, 3:]
        candidates.append(three_point_poses(world, rays.bearing[sample]))
    poses = np.concatenate(candidates) if candidates else np.zeros((0, 4, 4))
    if len(poses) == 0:
        return None
    local = (points[:, :3] - points[:, 3:] * poses[:, None, :3, 3]) @ poses[:, :3, :3]
    direction = local / np.maximum(np.linalg.norm(local, axis=2, keepdims=True), 1e-12)
    miss = np.linalg.norm((rays.to_pixels @ (direction - rays.bearing)[..., None])[..., 0], axis=2)
    miss = np.where((direction * rays.bearing).sum(axis=2) > 0, miss, np.inf)
    best = int(np.minimum((miss / threshold_px) ** 2, 1).sum(axis=1).argmin())
    return poses[best], miss[best] < threshold_px


def refine_pose(T_world_camera: Array, points: Array, rays: Rays, noise: TrackNoise, offset: Array) -> Array:
    """The most likely pose (4, 4) near a first guess.

    Args:
        T_world_camera: the guess.
        points: (n, 4) homogeneous points.
        rays: n directions.
        noise: of the residuals around `offset`.
        offset: (n, 2) pixels, the residual expected from the past of each track.
    """
    T = T_world_camera
    for _ in range(REFINEMENTS):
        r, J, _ = direction_residuals(np.broadcast_to(T, (len(points), 4, 4)), points, rays)
        r = r - offset
        weight = noise.weights(r)
        H = np.einsum("nij,n,nik->jk", J, weight, J) + 1e-9 * np.eye(6)
        step = -np.linalg.solve(H, np.einsum("nij,n,ni->j", J, weight, r))
        T = T @ se3.exp(step)
        if np.abs(step).max() < 1e-9:
            break
    return np.asarray(T)
