"""Camera poses from tracks: a map that starts from two views, grows frame by frame and is adjusted in a sliding window.

One scale runs through: every new frame is placed by points that are already in the map. Where no pose can be
found the map is closed and a new one started; it takes over the scale of the old one from the points they share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.bundle import Adjustment, Window, adjust, direction_residuals
from vio.pnp import find_pose, refine_pose
from vio.rays import Rays
from vio.track_noise import TrackNoise, fit_noise
from vio.two_view import parallax, relative_pose

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class MapSettings:
    """How the map is built. Frames are those the map is built from, which may be a subset of the recording."""

    window: int = 40
    """Frames adjusted together."""
    held: int = 15
    """Of these, the oldest that are held fixed; they carry the scale."""
    hop: int = 4
    """New frames between adjustments."""
    start_parallax_deg: float = 2.0
    """Median parallax that is enough for the two views a map starts from."""
    least_parallax_deg: float = 0.5
    """Median parallax they must have where tracks end before it is enough."""
    point_parallax_deg: float = 0.5
    """Parallax from which a point may place a new camera."""
    min_common: int = 8
    """Tracks that two views must share to start a map."""
    min_points: int = 6
    """Tracks that must agree on a new pose."""
    min_known: int = 4
    """Of these, those with parallax of their own."""
    threshold_px: float = 3.0
    """Residual at which a track counts as wrong while a pose is searched; later weights are soft."""
    max_start_frames: int = 120
    """How far apart the two first views may be."""
    seed: int = 0
    """Of the random samples."""


class Map:
    """Poses and points of M frames and P tracks."""

    def __init__(self, frame: Ints, track: Ints, rays: Rays, n_frames: int, settings: MapSettings) -> None:
        """Observations (O,) sorted by frame; `track` counts from 0."""
        self.settings, self.rays, self.track, self.frame = settings, rays, track, frame
        self.begin = np.searchsorted(frame, np.arange(n_frames + 1))
        self.T = np.full((n_frames, 4, 4), np.nan)
        self.segment = np.full(n_frames, -1)
        n_tracks = int(track.max(initial=-1)) + 1
        self.points = np.full((n_tracks, 4), np.nan)
        self.known = np.zeros(n_tracks, bool)
        self.noise = TrackNoise()
        self.rng = np.random.default_rng(settings.seed)

    @property
    def placed(self) -> Bools:
        """(M,) frames with a pose."""
        return self.segment >= 0

    def seen(self, k: int) -> slice:
        """Observations of frame k."""
        return slice(self.begin[k], self.begin[k + 1])

    def common(self, a: int, b: int) -> tuple[Ints, Ints]:
        """Observations of the tracks that frames a and b share."""
        a_rows, b_rows = self.seen(a), self.seen(b)
        _, i, j = np.intersect1d(self.track[a_rows], self.track[b_rows], assume_unique=True, return_indices=True)
        return i + a_rows.start, j + b_rows.start

    def find_start(self, first: int) -> tuple[int, int, Array] | None:
        """The earliest two views from `first` on that show parallax, and the pose of the second in the first."""
        s, a = self.settings, first
        while a < len(self.T) - 1:
            best, best_parallax = a, np.radians(s.least_parallax_deg)
            for b in range(a + 1, min(len(self.T), a + s.max_start_frames + 1)):
                i, j = self.common(a, b)
                if len(i) < s.min_common or best_parallax >= np.radians(s.start_parallax_deg):
                    break
                angle = parallax(self.rays.bearing[i], self.rays.bearing[j])
                if angle > best_parallax:
                    best, best_parallax = b, angle
            if best > a:
                i, j = self.common(a, best)
                view = relative_pose(self.rays.select(i), self.rays.select(j), s.threshold_px, self.rng)
                if view is not None and view.inlier.sum() >= max(s.min_common - 2, 0.6 * len(i)):
                    return a, best, view.T_1_2
            a += 1
        return None

    def start(self, a: int, b: int, T_a_b: Array, back_to: int) -> Adjustment:
        """Build a map from two views, fill in the frames between and before them, and adjust it all."""
        self.known[:] = False
        self.points[:] = np.nan
        segment = int(self.segment.max()) + 1
        self.T[a], self.T[b] = np.eye(4), T_a_b
        self.segment[[a, b]] = segment
        self.triangulate(a, b + 1)
        for k in range(a + 1, b):
            self.place(k, k - 1)
        for k in range(a - 1, back_to - 1, -1):
            if not self.place(k, k + 1):
                break
        s = int(np.flatnonzero(self.segment == segment).min())
        for _ in range(3):
            done = self.adjust_window(s, b + 1, held=1, iterations=15)
        return done

    def place(self, k: int, neighbour: int) -> bool:
        """Find the pose of frame k from points in the map, starting from the neighbour's pose and motion."""
        s, rows = self.settings, np.arange(self.begin[k], self.begin[k + 1])
        rows = rows[np.isfinite(self.points[self.track[rows], 0])]
        points, rays, usable = self.points[self.track[rows]], self.rays.select(rows), self.known[self.track[rows]]
        found = find_pose(points, rays, usable, s.threshold_px, self.rng, self._guesses(k, neighbour))
        if found is None:
            return False
        offset = self._expected_residual(rows, neighbour) if self.segment[neighbour] >= 0 else np.zeros((len(rows), 2))
        T = refine_pose(found[0], points, rays, self.noise, offset)
        miss = direction_residuals(np.broadcast_to(T, (len(rows), 4, 4)), points, rays)[0] - offset
        agree = np.linalg.norm(miss, axis=1) < s.threshold_px
        if agree.sum() < max(s.min_points, 0.5 * len(rows)) or (agree & usable).sum() < s.min_known:
            return False
        self.T[k], self.segment[k] = T, self.segment.max()
        return True

    def _guesses(self, k: int, neighbour: int) -> Array | None:
        if self.segment[neighbour] < 0:
            return None
        before = 2 * neighbour - k
        guesses = [self.T[neighbour]]
        if 0 <= before < len(self.T) and self.segment[before] == self.segment[neighbour]:
            guesses.append(self.T[neighbour] @ se3.inverse(self.T[before]) @ self.T[neighbour])
        return np.array(guesses)

    def _expected_residual(self, rows: Ints, neighbour: int) -> Array:
        """(n, 2) pixels: what the tracks' past errors let one expect, 0 for tracks the neighbour does not see."""
        near = self.seen(neighbour)
        _, i, j = np.intersect1d(self.track[rows], self.track[near], assume_unique=True, return_indices=True)
        offset = np.zeros((len(rows), 2))
        j = j + near.start
        T = np.broadcast_to(self.T[neighbour], (len(j), 4, 4))
        residual = direction_residuals(T, self.points[self.track[j]], self.rays.select(j))[0]
        size = np.linalg.norm(residual, axis=1)
        offset[i] = np.where((size < self.settings.threshold_px)[:, None], self.noise.correlation * residual, 0)
        return offset

    def triangulate(self, s: int, e: int) -> None:
        """Points of tracks that are seen by at least two placed frames of s..e-1 and have none yet."""
        rows, pose, track = self._window_rows(s, e)
        new = ~np.isfinite(self.points[track, 0])
        rows, pose, track = rows[new], pose[new], track[new]
        if len(rows):
            ids, point = np.unique(track, return_inverse=True)
            self.points[ids] = triangulate(self.T[pose], self.rays.bearing[rows], point)
            self._judge(rows, pose, ids, point)

    def _judge(self, rows: Ints, pose: Ints, ids: Ints, point: Ints) -> None:
        """Mark the points that have enough parallax and lie in front of their cameras as known."""
        world = (self.T[pose, :3, :3] @ self.rays.bearing[rows][..., None])[..., 0]
        starts = np.append(True, point[1:] != point[:-1])
        first = world[np.flatnonzero(starts)][point]
        angle = np.maximum.reduceat(np.linalg.norm(np.cross(first, world), axis=1), np.flatnonzero(starts))
        offset = self.points[ids[point], :3] - self.points[ids[point], 3:] * self.T[pose, :3, 3]
        behind = np.maximum.reduceat((offset * world).sum(axis=1) <= 0, np.flatnonzero(starts))
        near = self.points[ids, 3] > 1e-6 * np.linalg.norm(self.points[ids, :3], axis=1)
        self.known[ids] = (angle > np.sin(np.radians(self.settings.point_parallax_deg))) & ~behind & near

    def _window_rows(self, s: int, e: int) -> tuple[Ints, Ints, Ints]:
        """Observations of placed frames s..e-1 of tracks seen there at least twice, by track and frame."""
        rows = np.arange(self.begin[s], self.begin[e])
        rows = rows[self.segment[self.frame[rows]] == self.segment.max()]
        rows = rows[np.lexsort((self.frame[rows], self.track[rows]))]
        _, inverse, count = np.unique(self.track[rows], return_inverse=True, return_counts=True)
        rows = rows[count[inverse] >= 2]
        return rows, self.frame[rows], self.track[rows]

    def adjust_window(self, s: int, e: int, held: int, iterations: int = 6) -> tuple[Ints, Adjustment]:
        """Bundle adjustment of the placed frames s..e-1, the first `held` of them fixed, and a new noise estimate.

        Returns:
            The frames in the window, and the adjustment, in axes of one of its cameras.
        """
        self.triangulate(s, e)
        rows, pose, track = self._window_rows(s, e)
        frames = s + np.flatnonzero(self.segment[s:e] == self.segment.max())
        fixed = np.arange(len(frames)) < held
        ids, point = np.unique(track, return_inverse=True)
        T_ref = self.T[frames[len(frames) // 2]]
        points = self.points[ids] @ se3.inverse(T_ref).T
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        window = Window(se3.inverse(T_ref) @ self.T[frames], points, np.searchsorted(frames, pose), point,
                        self.rays.select(rows), fixed)
        done = adjust(window, self.noise, iterations)
        self.noise = fit_noise(done.residual, window.starts, window.unknowns)
        self.T[frames[~fixed]] = T_ref @ done.window.T_world_camera[~fixed]
        self.points[ids] = done.window.points @ T_ref.T
        self.points[ids] /= np.linalg.norm(self.points[ids], axis=1, keepdims=True)
        self._judge(rows, pose, ids, point)
        return frames, done


def triangulate(T_world_camera: Array, bearing: Array, point: Ints) -> Array:
    """Homogeneous points (P, 4) of unit length nearest to rays, by a linear fit.

    Args:
        T_world_camera: (O, 4, 4) pose of the camera of every observation.
        bearing: (O, 3) unit rays in camera axes.
        point: (O,) which point, 0 to P - 1, never decreasing.
    """
    origin = T_world_camera[:1, :3, 3]
    R_t = np.swapaxes(T_world_camera[:, :3, :3], 1, 2)
    view = np.concatenate([R_t, -(R_t @ (T_world_camera[:, :3, 3] - origin)[..., None])], axis=2)
    cross = se3.skew(bearing) @ view
    first = np.flatnonzero(np.append(True, point[1:] != point[:-1]))
    points = np.linalg.eigh(np.add.reduceat(np.swapaxes(cross, 1, 2) @ cross, first))[1][:, :, 0]
    outward = np.add.reduceat(np.sign(((view @ points[point][..., None])[..., 0] * bearing).sum(axis=1)), first)
    points = points * np.where(outward < 0, -1.0, 1.0)[:, None]
    points[:, 3] = np.maximum(points[:, 3], 0)
    points[:, :3] += points[:, 3:] * origin
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))
