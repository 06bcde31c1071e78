"""Is what two frames show the same place, and from where does each look at it: matched keypoints with depth in both.

A pose is searched by PnP on the points of the one frame (RANSAC; Fischler and Bolles, Comm. ACM 24, 1981), then
adjusted on both frames at once: the points of i are seen by j, and those of j by i. The depth of every frame is right
only up to a scale of its own, and every pixel of it errs by itself; the scales are unknowns with a prior, the errors of
single pixels are part of the residuals' covariance, which they stretch along the epipolar line. 3D–3D alignment would
turn two different scales into a translation; directions do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.bundle import direction_residuals
from vio.keypoints import Keypoints, match_keypoints
from vio.rays import Rays

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

WIDEST_RAY = 0.2
"""Smallest forward component of a ray on OpenCV's plane of unit depth (about 78 degrees off axis)."""
SEARCHES = 100
ITERATIONS = 8
INLIER = 9.21
"""99 % of chi² with 2 degrees of freedom: squared distance, in sigmas, up to which a match agrees."""
SEARCH_FACTOR = 3.0
"""Threshold of the search over the sd of a pixel: depth errors are not known yet."""
TWICE = 2.0
"""Every match is used in both directions: factor on the covariance."""


@dataclass(frozen=True)
class RevisitNoise:
    """How well matched keypoints with predicted depth are known."""

    pixel_share: float = 0.008
    """Sd of a matched pixel over the image's width, each axis; what the wall has moved since is part of it."""
    depth_log_sd: float = 0.15
    """Sd of ln depth of a pixel once the frame's scale is right."""
    scale_log_sd: float = 0.2
    """Sd of ln scale of one frame's depth."""
    least: tuple[float, float] = (0.01, 0.03)
    """What no number of matches improves on, for depth errs in common and the wall moves: sd of the rotation [rad], and
    of the translation over the median distance of what is seen."""


@dataclass(frozen=True)
class RevisitLimits:
    """What two frames must share to count as one place."""

    matches: int = 10
    inliers: int = 10
    inlier_share: float = 0.4
    """Of the matches."""
    spread: float = 0.08
    """Smallest extent (sd along the narrower direction) of the inliers, over the image's width."""
    scale_ratio: float = 0.7
    """Largest |ln| of the one frame's depth over the other's, of what both see: two looks with next to no parallax fit
    whatever the depth."""
    far: float = 1.2
    """Largest distance of the two cameras over the median distance of what both see."""


REASONS = {
    "few matches": "hardly a detail of one frame was found in the other",
    "no common pose": "details match, but no position of the camera explains them together",
    "few agree": "too few of the matches agree on one position of the camera",
    "no spread": "the matches that agree lie in one spot or on a line",
    "depths contradict": "the predicted depths of the two frames do not fit the match",
    "too far apart": "the cameras would be further apart than they see",
}
"""Why a pair is refused, in words."""


@dataclass(frozen=True)
class View:
    """One frame as it is compared: K keypoints with rays and distances."""

    keypoints: Keypoints
    rays: Rays
    distance: Array
    """(K,) along the ray, motion units; 0 where unknown."""
    width_px: int


@dataclass(frozen=True)
class Revisit:
    """Two frames that show one place."""

    T_i_j: Array
    """(4, 4) pose of the camera at j in the camera at i, in the unit of the depth."""
    cov: Array
    """(6, 6) right perturbation, rotation first."""
    matches: int
    inliers: int
    log_scale_ratio: float
    """ln of i's depth over j's, of what both see."""


def compare_views(first: View, second: View, noise: RevisitNoise | None = None,
                  limits: RevisitLimits | None = None) -> Revisit | str:
    """The pose between two frames that show the same place, or a key of `REASONS` where they do not show it clearly."""
    noise, limits = noise or RevisitNoise(), limits or RevisitLimits()
    pairs = match_keypoints(first.keypoints, second.keypoints)
    known = (first.distance[pairs[:, 0]] > 0) & (second.distance[pairs[:, 1]] > 0)
    i, j = pairs[known].T
    if len(i) < limits.matches:
        return "few matches"
    sides = (_Side(first, i), _Side(second, j))
    T = _searched(sides, noise, limits)
    if T is None:
        return "no common pose"
    fit = _adjusted(sides, T, noise)
    if fit is None or fit.good.sum() < max(limits.inliers, limits.inlier_share * len(i)):
        return "few agree"
    if min(_narrow(side.pixel[fit.good]) / side.width_px for side in sides) < limits.spread:
        return "no spread"
    ratio = _depth_ratio(sides, fit)
    if abs(ratio) > limits.scale_ratio:
        return "depths contradict"
    seen = np.median(np.concatenate([side.distance[fit.good] for side in sides]))
    if np.linalg.norm(fit.T[:3, 3]) > limits.far * seen:
        return "too far apart"
    least = np.repeat(np.square(noise.least) * np.array([1.0, seen**2]), 3)
    return Revisit(fit.T, fit.cov + np.diag(least), len(i), int(fit.good.sum()), ratio)


class _Side:
    """The matched keypoints of one frame."""

    def __init__(self, view: View, index: NDArray[np.int64]) -> None:
        self.rays, self.distance = view.rays.select(index), view.distance[index]
        self.pixel, self.width_px = view.keypoints.pixel[index], view.width_px
        self.points = self.rays.bearing * self.distance[:, None]


def _depth_ratio(sides: tuple[_Side, _Side], fit: _Fit) -> float:
    """Median ln of the distance that i's depth gives a point from j over j's own."""
    first, second = (side.points[fit.good] for side in sides)
    moved = (first - fit.T[:3, 3]) @ fit.T[:3, :3]
    return float(np.median(np.log(np.linalg.norm(moved, axis=1) / np.linalg.norm(second, axis=1))))


def _searched(sides: tuple[_Side, _Side], noise: RevisitNoise, limits: RevisitLimits) -> Array | None:
    """Pose (4, 4) of j in i that most matches agree with, roughly; None where too few do."""
    first, second = sides
    bearing = second.rays.bearing
    ahead = bearing[:, 2] > WIDEST_RAY
    if ahead.sum() < limits.inliers:
        return None
    plane = bearing[ahead, :2] / bearing[ahead, 2:]
    per_radian = float(np.median(second.rays.pixels_per_radian))
    threshold = SEARCH_FACTOR * noise.pixel_share * second.width_px / per_radian
    cv2.setRNGSeed(0)
    found, rotvec, t, inliers = cv2.solvePnPRansac(first.points[ahead], plane, np.eye(3), None, None, None, False,
                                                   SEARCHES, threshold, 0.999, flags=cv2.SOLVEPNP_AP3P)
    if not found or inliers is None or len(inliers) < limits.inliers // 2:
        return None
    pose = se3.inverse(se3.transform(se3.so3_exp(rotvec[:, 0]), t[:, 0]))
    return pose if np.isfinite(pose).all() else None


@dataclass(frozen=True)
class _Fit:
    T: Array
    cov: Array
    scales: Array
    """(2,) log scales of the two depths."""
    good: Bools


def _adjusted(sides: tuple[_Side, _Side], T: Array, noise: RevisitNoise) -> _Fit | None:
    """Gauss-Newton over pose and the two scales, inliers chosen anew in every step."""
    scales = np.zeros(2)
    prior = np.diag(np.r_[np.zeros(6), np.full(2, noise.scale_log_sd**-2.0)])
    for _ in range(ITERATIONS):
        J, r, distance2 = _residuals(sides, T, scales, noise)
        good = np.asarray((distance2 < INLIER).all(axis=0))
        if good.sum() < 4:
            return None
        H = np.einsum("snki,snkj->ij", J[:, good], J[:, good]) + prior
        gradient = np.einsum("snki,snk->i", J[:, good], r[:, good]) + prior @ np.r_[np.zeros(6), scales]
        step = -np.linalg.solve(H + 1e-9 * np.diag(np.diag(H)), gradient)
        T, scales = T @ se3.exp(step[:6]), scales + step[6:]
    J, r, distance2 = _residuals(sides, T, scales, noise)
    good = np.asarray((distance2 < INLIER).all(axis=0))
    if good.sum() < 4:
        return None
    H = np.einsum("snki,snkj->ij", J[:, good], J[:, good]) + prior
    spread = float(distance2[:, good].mean()) / 2
    cov = np.linalg.inv(H)[:6, :6] * TWICE * max(spread, 1.0)
    return _Fit(T, 0.5 * (cov + cov.T), scales, good) if np.isfinite(cov).all() else None


def _residuals(sides: tuple[_Side, _Side], T: Array, scales: Array, noise: RevisitNoise) -> tuple[Array, Array, Array]:
    """Whitened Jacobians (2, N, 2, 8), residuals (2, N, 2) and their squares (2, N): i's points seen by j, and back."""
    parts = []
    for s, (here, there) in enumerate((sides, sides[::-1])):
        pose, turn = (T, np.eye(6)) if s == 0 else (se3.inverse(T), -se3.adjoint(T))
        points = np.column_stack([here.points * np.exp(scales[s]), np.ones(len(here.points))])
        count = len(points)
        r, by_pose, by_point = direction_residuals(np.broadcast_to(pose, (count, 4, 4)), points, there.rays)
        by_depth = (by_point[:, :, :3] @ points[:, :3, None])[:, :, 0]
        J = np.zeros((count, 2, 8))
        J[:, :, :6], J[:, :, 6 + s] = by_pose @ turn, by_depth
        sigma = noise.pixel_share * there.width_px
        cov = sigma**2 * np.eye(2) + noise.depth_log_sd**2 * by_depth[:, :, None] * by_depth[:, None, :]
        whiten = np.linalg.inv(np.linalg.cholesky(cov))
        parts.append((whiten @ J, (whiten @ r[:, :, None])[:, :, 0]))
    J, r = (np.stack(values) for values in zip(*parts, strict=True))
    return J, r, np.asarray((r**2).sum(axis=2))


def _narrow(pixel: Array) -> float:
    """Standard deviation of points (N, 2) along the direction in which they spread least."""
    return float(np.sqrt(max(np.linalg.eigvalsh(np.cov(pixel.T))[0], 0.0)))
