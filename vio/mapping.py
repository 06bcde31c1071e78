"""A map of tracked points: starts from two views, grows frame by frame, is adjusted in a sliding window."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.bundle import Adjustment, Window, adjust
from vio.camera import Camera
from vio.rays import rays_from_pixels
from vio.track_noise import TrackNoise
from vio.tracks import Tracks

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

WIDEST_RAY = 0.2
"""Smallest forward component of a ray on OpenCV's plane of unit depth (about 78 degrees off axis)."""
FARTHEST = 50.0
"""Distance of a point, in median distances, beyond which it counts as a direction and places no camera."""
START_ADJUSTMENTS = 3
COVARIANCE_FACTOR = 3.0
"""On the adjustment's covariances: the frames it holds count as exact and are not. Measured on EuRoC V1_01, where the
claimed covariances alone gave a median NEES per dof of 3 at 5 Hz and 1 at 20 Hz."""


@dataclass(frozen=True)
class MapSettings:
    """How a map is built."""

    window: int = 30
    """Frames adjusted together."""
    held: int = 12
    """Of these, the oldest that stay fixed and carry the scale."""
    hop: int = 3
    """New frames between adjustments."""
    start_parallax_deg: float = 2.0
    """Median parallax between the two views a map starts from."""
    point_parallax_deg: float = 1.0
    """Parallax from which a point may place a new frame."""
    min_tracks: int = 8
    """Tracks that two views must share, and points that must agree on a new pose."""
    threshold_px: float = 2.0
    """Residual at which a track counts as wrong while a pose is searched; later weights are soft."""
    noise: TrackNoise = field(default_factory=lambda: TrackNoise(sigma_px=0.3, correlation=0.9, dof=3.0))
    """Of the observations: a tracked patch hands its error on from frame to frame."""


@dataclass(frozen=True)
class MapMotions:
    """Motions between neighbouring frames k and k + 1 of one map, in units of its points' median distance."""

    first: Ints
    """(N,) frame k."""
    T: Array
    """(N, 4, 4) camera k + 1 in camera k."""
    cov: Array
    """(N, 6, 6) right perturbation, rotation first."""


class Map:
    """Poses of consecutive frames and the points they see. Grow it once, then read its motions."""

    def __init__(self, tracks: Tracks, camera: Camera, settings: MapSettings) -> None:
        rays, valid = rays_from_pixels(camera, tracks.pixel)
        valid &= np.nan_to_num(rays.bearing[:, 2]) > WIDEST_RAY
        self.settings, self.n_frames = settings, tracks.n_frames
        self.frame = tracks.frame[valid]
        self.track = np.unique(tracks.track[valid], return_inverse=True)[1].astype(np.int64)
        self.rays = rays.select(valid)
        self.plane = self.rays.bearing[:, :2] / self.rays.bearing[:, 2:]
        self.pixels_per_unit = float(np.median(self.rays.pixels_per_radian)) if len(self.frame) else 1.0
        self.rows = np.searchsorted(self.frame, np.arange(self.n_frames + 1))
        self._clear()

    def _clear(self) -> None:
        self.T = np.full((self.n_frames, 4, 4), np.nan)
        self.point = np.full((int(self.track.max(initial=-1)) + 1, 3), np.nan)
        self.cov = np.full((self.n_frames, 6, 6), np.nan)
        self.first = self.last = 0

    # ---- starting

    def begin(self, first: int) -> bool:
        """Start a new map at the earliest frame from `first` on whose tracks show parallax with a later one."""
        self._clear()
        for a in range(first, self.n_frames - 1):
            for b in range(a + 1, self.n_frames):
                i, j = self._common(a, b)
                if len(i) < self.settings.min_tracks:
                    break
                if self._parallax_deg(i, j) > self.settings.start_parallax_deg and self._start(a, b, i, j):
                    return True
        return False

    def _common(self, a: int, b: int) -> tuple[Ints, Ints]:
        """Observations of the tracks that frames a and b share."""
        rows_a, rows_b = np.arange(*self.rows[a : a + 2]), np.arange(*self.rows[b : b + 2])
        _, i, j = np.intersect1d(self.track[rows_a], self.track[rows_b], assume_unique=True, return_indices=True)
        return rows_a[i], rows_b[j]

    def _parallax_deg(self, i: Ints, j: Ints) -> float:
        """Median angle between the rays of two views once the best rotation is taken out."""
        U, _, Vt = np.linalg.svd(self.rays.bearing[j].T @ self.rays.bearing[i])
        R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
        sine = np.linalg.norm(np.cross(self.rays.bearing[i] @ R.T, self.rays.bearing[j]), axis=1)
        return float(np.degrees(np.median(np.arcsin(np.minimum(sine, 1)))))

    def _start(self, a: int, b: int, i: Ints, j: Ints) -> bool:
        """Pose of frame b in frame a by the essential matrix; then every frame between, and an adjustment of all."""
        self._clear()
        threshold = self.settings.threshold_px / self.pixels_per_unit
        cv2.setRNGSeed(0)
        E, _ = cv2.findEssentialMat(self.plane[i], self.plane[j], np.eye(3), cv2.RANSAC, 0.999, threshold)
        if E is None or E.shape != (3, 3):
            return False
        count, R, t, _ = cv2.recoverPose(E, self.plane[i], self.plane[j], np.eye(3))
        if count < max(self.settings.min_tracks, 0.6 * len(i)):
            return False
        self.T[a], self.T[b] = np.eye(4), se3.inverse(se3.transform(R, t[:, 0]))
        self.first, self.last = a, b
        self._triangulate(a, b)
        for k in range(a + 1, b):
            if not self._place(k, self.T[k - 1]):
                return False
        for _ in range(START_ADJUSTMENTS):
            if self._known() < self.settings.min_tracks:
                return False
            self._adjust(a, b, held=1)
            self._triangulate(a, b)
        self._normalise()
        return self._known() >= self.settings.min_tracks

    def _known(self) -> int:
        return int(np.isfinite(self.point[:, 0]).sum())

    def _normalise(self) -> None:
        """Make the median distance of the points from the first camera the unit."""
        known = np.isfinite(self.point[:, 0])
        unit = float(np.median(np.linalg.norm(self.point[known], axis=1))) if known.any() else 1.0
        self.point /= unit
        self.T[:, :3, 3] /= unit

    # ---- growing

    def grow(self) -> int:
        """Place frame after frame until one cannot be placed; returns the first frame that is not in the map."""
        waiting = 0
        for k in range(self.last + 1, self.n_frames):
            if not self._place(k, self.T[k - 1]):
                break
            self.last, waiting = k, waiting + 1
            self._triangulate(max(self.first, k - self.settings.window), k)
            if waiting == self.settings.hop:
                self._adjust_last(waiting)
                waiting = 0
        if waiting:
            self._adjust_last(waiting)
        return self.last + 1

    def _adjust_last(self, new: int) -> None:
        start = max(self.first, self.last - self.settings.window + 1)
        size = self.last - start + 1
        self._adjust(start, self.last, held=max(1, min(self.settings.held, size - new)))

    def _place(self, k: int, T_guess: Array) -> bool:
        """Pose of frame k from points in the map."""
        rows = np.arange(*self.rows[k : k + 2])
        rows = rows[np.isfinite(self.point[self.track[rows], 0])]
        if len(rows) < self.settings.min_tracks:
            return False
        guess = se3.inverse(T_guess)
        rotvec, t = se3.so3_log(guess[:3, :3]).reshape(3, 1), guess[:3, 3].reshape(3, 1).copy()
        points, plane = self.point[self.track[rows]], self.plane[rows]
        threshold = self.settings.threshold_px / self.pixels_per_unit
        cv2.setRNGSeed(0)
        found, rotvec, t, inliers = cv2.solvePnPRansac(points, plane, np.eye(3), None, rotvec, t, True, 200, threshold,
                                                       0.999, flags=cv2.SOLVEPNP_ITERATIVE)
        if not found or inliers is None or len(inliers) < max(self.settings.min_tracks - 2, 0.4 * len(rows)):
            return False
        inliers = inliers[:, 0]
        rotvec, t = cv2.solvePnPRefineLM(points[inliers], plane[inliers], np.eye(3), None, rotvec, t)
        pose = se3.inverse(se3.transform(se3.so3_exp(rotvec[:, 0]), t[:, 0]))
        if not np.isfinite(pose).all():
            return False
        self.T[k] = pose
        return True

    def _window_rows(self, start: int, end: int) -> Ints:
        """Observations of placed frames start..end of tracks seen there at least twice, by track and frame."""
        rows = np.arange(self.rows[start], self.rows[end + 1])
        rows = rows[np.isfinite(self.T[self.frame[rows], 0, 0])]
        rows = rows[np.lexsort((self.frame[rows], self.track[rows]))]
        _, inverse, count = np.unique(self.track[rows], return_inverse=True, return_counts=True)
        twice: Ints = rows[count[inverse] >= 2]
        return twice

    def _triangulate(self, start: int, end: int) -> None:
        """Points nearest to the rays of tracks that have none yet, where their parallax is large enough."""
        rows = self._window_rows(start, end)
        rows = rows[~np.isfinite(self.point[self.track[rows], 0])]
        if len(rows) == 0:
            return
        ids, group = np.unique(self.track[rows], return_inverse=True)
        T = self.T[self.frame[rows]]
        ray = (T[:, :3, :3] @ self.rays.bearing[rows, :, None])[:, :, 0]
        normal = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        A, b = np.zeros((len(ids), 3, 3)), np.zeros((len(ids), 3))
        np.add.at(A, group, normal)
        np.add.at(b, group, (normal @ T[:, :3, 3:])[:, :, 0])
        point = np.asarray(np.linalg.solve(A + 1e-12 * np.eye(3), b[:, :, None])[:, :, 0], float)
        self.point[ids] = np.where(self._good(point[group], T, ray, rows, group, len(ids))[:, None], point, np.nan)

    def _good(self, point: Array, T: Array, ray: Array, rows: Ints, group: Ints, count: int) -> Bools:
        """(count,) points with enough parallax, in front of all their cameras, and near their rays."""
        first = np.flatnonzero(np.append(True, group[1:] != group[:-1]))
        angle = np.maximum.reduceat(np.linalg.norm(np.cross(ray[first][group], ray), axis=1), first)
        local = (np.swapaxes(T[:, :3, :3], 1, 2) @ (point - T[:, :3, 3])[:, :, None])[:, :, 0]
        depth = np.linalg.norm(local, axis=1)
        off_ray = local / np.maximum(depth, 1e-12)[:, None] - self.rays.bearing[rows]
        miss_px = np.linalg.norm((self.rays.to_pixels[rows] @ off_ray[:, :, None])[:, :, 0], axis=1)
        wrong = (miss_px > 3 * self.settings.threshold_px) | (local[:, 2] <= 0)
        known = np.isfinite(self.point[:, 0])
        typical = np.median(np.linalg.norm(self.point[known] - T[-1, :3, 3], axis=1)) if known.any() else np.inf
        wrong |= depth > FARTHEST * typical
        enough = angle > np.sin(np.radians(self.settings.point_parallax_deg))
        return np.asarray(enough & ~np.maximum.reduceat(wrong, first))

    # ---- adjusting

    def _adjust(self, start: int, end: int, held: int) -> None:
        """Adjust the frames start..end with the first `held` of them fixed, and take the motions' covariances."""
        rows = self._window_rows(start, end)
        rows = rows[np.isfinite(self.point[self.track[rows], 0])]
        frames = np.arange(start, end + 1)
        frames = frames[np.isfinite(self.T[frames, 0, 0])]
        ids, group = np.unique(self.track[rows], return_inverse=True)
        origin = self.T[frames[len(frames) // 2]]
        local = (self.point[ids] - origin[:3, 3]) @ origin[:3, :3]
        points = np.column_stack([local, np.ones(len(ids))])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        fixed = np.arange(len(frames)) < held
        window = Window(se3.inverse(origin) @ self.T[frames], points, np.searchsorted(frames, self.frame[rows]), group,
                        self.rays.select(rows), fixed)
        done = adjust(window, self.settings.noise)
        moved_T = origin @ done.window.T_world_camera[~fixed]
        self.T[frames[~fixed]] = se3.transform(se3.so3_exp(se3.so3_log(moved_T[:, :3, :3])), moved_T[:, :3, 3])
        moved = done.window.points[:, :3] / np.maximum(done.window.points[:, 3:], 1e-9)
        self.point[ids] = moved @ origin[:3, :3].T + origin[:3, 3]
        self._judge(rows, group, ids)
        self._take_covariances(frames, fixed, done)

    def _judge(self, rows: Ints, group: Ints, ids: Ints) -> None:
        """Forget points that the adjustment moved behind a camera, too far, or off their rays."""
        T = self.T[self.frame[rows]]
        ray = (T[:, :3, :3] @ self.rays.bearing[rows, :, None])[:, :, 0]
        good = self._good(self.point[ids][group], T, ray, rows, group, len(ids))
        self.point[ids[~good]] = np.nan

    def _take_covariances(self, frames: Ints, fixed: Bools, done: Adjustment) -> None:
        """Covariance of every motion k → k + 1 whose second frame was free; the latest adjustment counts."""
        free = np.flatnonzero(~fixed)
        blocks = done.covariance.reshape(len(free), 6, len(free), 6) * COVARIANCE_FACTOR
        T = done.window.T_world_camera
        for n, f in enumerate(free):
            if f == 0 or frames[f] != frames[f - 1] + 1:
                continue
            cov = blocks[n, :, n].copy()
            if n > 0 and free[n - 1] == f - 1:
                back = -se3.adjoint(se3.inverse(T[f]) @ T[f - 1])
                cross = back @ blocks[n - 1, :, n]
                cov += back @ blocks[n - 1, :, n - 1] @ back.T + cross + cross.T
            self.cov[frames[f - 1]] = 0.5 * (cov + cov.T)

    # ---- reading

    def motions(self) -> MapMotions:
        """Motions between neighbouring placed frames with a covariance."""
        k = np.arange(self.n_frames - 1)
        placed = np.isfinite(self.T[:, 0, 0])
        k = k[placed[:-1] & placed[1:] & np.isfinite(self.cov[:-1, 0, 0])]
        return MapMotions(k, se3.inverse(self.T[k]) @ self.T[k + 1], self.cov[k])
