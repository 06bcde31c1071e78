"""Relative motion from tracks and depth maps: 3D–3D between neighbouring frames, in the unit of the depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vio.camera import Camera
from vio.errors import TrackingError
from vio.motions import RelativeMotions
from vio.recording import Recording
from vio.rigid_fit import LEAST_POINTS, fit_rigid
from vio.tracking import track_recording
from vio.tracks import Tracks

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Depth = Callable[[int], NDArray[np.float32] | None]


@dataclass(frozen=True)
class DepthNoise:
    """How well tracked points with depth are known."""

    pixel_px: float = 0.5
    """Sd of a tracked pixel, each axis."""
    depth_relative: float = 0.02
    """Sd of a depth over the depth."""
    scale_log_sd: float = 0.05
    """Sd of the log scale of all depths together: what no averaging takes away."""


def measure_motions_with_depth(recording: Recording, depth_m: Depth | None = None, noise: DepthNoise | None = None,
                               tracks: Tracks | None = None) -> RelativeMotions:
    """Motions of the camera between neighbouring frames by fitting the tracked points of both.

    Args:
        recording: with images (unless `tracks` are given) and a camera.
        depth_m: z-depth (H, W) of frame k, 0 or not finite where unknown; the recording's own when None.
        noise: of tracks and depth.
        tracks: of the recording's frames; tracked here when None.

    Returns:
        One motion per neighbouring pair that the points determine, in the depth's unit (metres when it is metric).

    Raises:
        TrackingError: no camera, no images, no depth, or no pair of frames that shares enough points.
    """
    camera = recording.calibration.camera
    if camera is None:
        raise TrackingError(f"recording {recording.name}: motion from depth needs the camera's intrinsics")
    noise, depth_m = noise or DepthNoise(), depth_m or recording.depth_m
    tracks = tracks or track_recording(recording)
    cloud, known = _points(tracks, camera, depth_m)
    pairs = _paired(tracks, cloud, known)
    too_few = TrackingError(f"recording {recording.name}: no two of {len(recording)} frames share three points with "
                            "depth that determine a motion; is there depth, and texture?")
    if pairs.valid.sum(axis=1).max(initial=0) < LEAST_POINTS:
        raise too_few
    fit = fit_rigid(pairs.first, pairs.second, valid=pairs.valid, information=_information(pairs, camera, noise))
    k = np.flatnonzero(fit.observable)
    if len(k) == 0:
        raise too_few
    t = recording.frame_t_s
    return RelativeMotions(t[k], t[k + 1], fit.T_i_j[k], fit.cov[k], 0.0, noise.scale_log_sd,
                           meta={"method": "classical: tracks and depth, 3D-3D"})


@dataclass(frozen=True)
class _Pairs:
    """Points of N neighbouring pairs of frames, padded to P."""

    first: Array
    second: Array
    valid: Bools


def _points(tracks: Tracks, camera: Camera, depth_m: Depth) -> tuple[Array, Bools]:
    """(O, 3) camera points of all observations, and which are known; one depth map is held at a time."""
    rays = camera.unproject(tracks.pixel)
    z = np.zeros(len(tracks))
    column, row = np.round(tracks.pixel).astype(int).T
    for k in range(tracks.n_frames):
        depth = depth_m(k)
        if depth is None:
            continue
        rows = np.flatnonzero(tracks.frame == k)
        y, x = np.clip(row[rows], 0, depth.shape[0] - 1), np.clip(column[rows], 0, depth.shape[1] - 1)
        z[rows] = depth[y, x]
    known = np.isfinite(z) & (z > 0) & np.isfinite(rays).all(axis=1) & (rays[:, 2] > 1e-3)
    forward = np.where(known, rays[:, 2], 1.0)
    return np.nan_to_num(rays) * np.where(known, z / forward, 0.0)[:, None], known


def _paired(tracks: Tracks, cloud: Array, known: Bools) -> _Pairs:
    """Points that neighbouring frames share, one row per pair of frames."""
    first_rows, second_rows = [], []
    begin = np.searchsorted(tracks.frame, np.arange(tracks.n_frames + 1))
    for k in range(tracks.n_frames - 1):
        a, b = np.arange(begin[k], begin[k + 1]), np.arange(begin[k + 1], begin[k + 2])
        a, b = a[known[a]], b[known[b]]
        _, i, j = np.intersect1d(tracks.track[a], tracks.track[b], assume_unique=True, return_indices=True)
        first_rows.append(a[i])
        second_rows.append(b[j])
    widest = max((len(rows) for rows in first_rows), default=0)
    shape = (len(first_rows), max(widest, 1))
    first, second, valid = np.zeros((*shape, 3)), np.zeros((*shape, 3)), np.zeros(shape, bool)
    for k, (i, j) in enumerate(zip(first_rows, second_rows, strict=True)):
        first[k, : len(i)], second[k, : len(j)], valid[k, : len(i)] = cloud[i], cloud[j], True
    return _Pairs(first, second, valid)


def _information(pairs: _Pairs, camera: Camera, noise: DepthNoise) -> Array:
    """(N, P, 3, 3) inverse covariance of the difference of two sightings: sharp across the ray, soft along it."""
    distance = np.maximum(np.linalg.norm(pairs.first, axis=2), 1e-9)
    ray = pairs.first / distance[:, :, None]
    across = 2 * (noise.pixel_px / camera.fx * distance) ** 2
    along = across + 2 * (noise.depth_relative * distance) ** 2
    outer = ray[..., :, None] * ray[..., None, :]
    return np.asarray((np.eye(3) - outer) / across[..., None, None] + outer / along[..., None, None])
