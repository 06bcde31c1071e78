"""Relative motion of a camera from tracks, without any network."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.bundle import Adjustment
from vio.camera import Camera
from vio.errors import TrackingError
from vio.mapper import Map, MapSettings
from vio.motions import RelativeMotions
from vio.rays import rays_from_pixels
from vio.tracks import Tracks, check_frame_indices

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class _Collector:
    def __init__(self, pairs: Ints) -> None:
        self.pairs, self.cov = pairs, np.full((len(pairs), 6, 6), np.nan)

    def take(self, frames: Ints, done: Adjustment, gauge_free: bool) -> None:
        fixed, T = done.window.fixed, done.window.T_world_camera
        F = int((~fixed).sum())
        cov = done.covariance
        if gauge_free:
            grow = np.zeros((F, 6))
            grow[:, 3:] = (np.swapaxes(T[~fixed, :3, :3], 1, 2) @ (T[~fixed, :3, 3] - T[0, :3, 3])[..., None])[..., 0]
            g = grow.ravel() / max(np.linalg.norm(grow), 1e-12)
            P = np.eye(len(g)) - np.outer(g, g)
            cov = P @ cov @ P
        C = cov.reshape(F, 6, F, 6)
        row = np.full(frames.max() + 2, -1)
        row[frames[~fixed]] = np.arange(F)
        index = np.full(frames.max() + 2, -1); index[frames] = np.arange(len(frames))
        for n, (i, j) in enumerate(self.pairs):
            if j > frames[-1] or i < frames[0] or row[j] < 0 or index[i] < 0:
                continue
            if row[i] < 0 and not (gauge_free or np.isnan(self.cov[n, 0, 0])):
                continue
            A = -se3.adjoint(se3.inverse(T[index[j]]) @ T[index[i]])
            S = C[row[j], :, row[j]].copy()
            if row[i] >= 0:
                S += A @ C[row[i], :, row[i]] @ A.T + A @ C[row[i], :, row[j]] + C[row[j], :, row[i]] @ A.T
            self.cov[n] = S


def run_map(tracks, camera, pairs, settings):
    rays, valid = rays_from_pixels(camera, tracks.pixel)
    frame, track = tracks.frame[valid], tracks.track[valid]
    _, track = np.unique(track, return_inverse=True)
    m = Map(frame, track, rays.select(valid), tracks.n_frames, settings)
    col = _Collector(pairs)
    first = 0
    while True:
        s = m.find_start(first)
        if s is None:
            break
        a, b, T = s
        frames, done = m.start(a, b, T, first)
        # unit: median distance
        col.take(frames, done, True)
        seg0 = frames[0]
        k = b + 1
        new = 0
        while k < tracks.n_frames:
            if not m.place(k, k - 1):
                print('lost at', k)
                break
            m.triangulate(max(seg0, k - settings.window), k + 1)
            new += 1
            k += 1
            few = m.known[m.track[m.seen(k-1)]].sum() < 3 * settings.min_points
            if new >= settings.hop or few or k == tracks.n_frames:
                w0 = max(seg0, k - settings.window)
                frames, done = m.adjust_window(w0, k, min(settings.held, k - w0 - new))
                col.take(frames, done, False)
                new = 0
        first = k
        if k >= tracks.n_frames - 1:
            break
    return m, col
