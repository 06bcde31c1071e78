"""Relative motion from tracks and depth maps: 3D–3D between neighbouring frames, in the unit of the depth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
Ints = NDArray[np.int64]
Depth = Callable[[int], NDArray[np.float32] | None]

PAIRS_AT_ONCE = 256
"""Pairs of frames that are fitted together."""


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
    fits = fit_pairs(tracks, camera, depth_m, noise)
    if len(fits.frame) == 0:
        raise TrackingError(f"recording {recording.name}: no two of {len(recording)} frames share three points with "
                            "depth that determine a motion; is there depth, and texture?")
    k = fits.frame
    t = recording.frame_t_s
    return RelativeMotions(t[k], t[k + 1], fits.T_i_j, fits.cov, 0.0, noise.scale_log_sd,
                           meta={"method": "classical: tracks and depth, 3D-3D"})


@dataclass(frozen=True)
class PairFits:
    """Motions of N neighbouring pairs of frames whose points determine them."""

    frame: Ints
    """(N,) the earlier frame."""
    T_i_j: Array
    """(N, 4, 4) pose of the camera at the later frame in the camera at the earlier, in the depth's unit."""
    cov: Array
    """(N, 6, 6) right perturbation, rotation first."""
    points: Ints
    """(N,) that both frames see."""
    middle: Array
    """(N,) their median distance from the earlier camera."""


@dataclass(frozen=True)
class Sightings:
    """S sightings of a point with depth in a frame and the next, in order of the frames."""

    frame: Ints
    """(S,) the earlier frame."""
    row_i: Ints
    """(S,) row of the tracks in it."""
    row_j: Ints
    """(S,) row of the tracks in the next."""
    cloud: Array
    """(O, 3) points of all rows of the tracks, in the axes of their camera; 0 where depth is unknown."""


def fit_pairs(tracks: Tracks, camera: Camera, depth_m: Depth, noise: DepthNoise) -> PairFits:
    """Motions between neighbouring frames from tracks with depth; what `measure_motions_with_depth` is made of.

    Args:
        tracks: of frames 0 to M - 1.
        camera: that saw them.
        depth_m: z-depth (H, W) of frame k in the camera's size, 0 or not finite where unknown; None = no depth at all.
            Asked once for every frame, in order.
        noise: of tracks and depth.
    """
    seen = shared_sightings(tracks, camera, depth_m)
    fits = [_fitted(pairs, camera, noise) for pairs in _blocks(seen, tracks.n_frames - 1)]
    if not fits:
        nothing = np.zeros(0, np.int64)
        return PairFits(nothing, np.zeros((0, 4, 4)), np.zeros((0, 6, 6)), nothing, np.zeros(0))
    return PairFits(*(np.concatenate([getattr(fit, name) for fit in fits])
                      for name in ("frame", "T_i_j", "cov", "points", "middle")))


@dataclass(frozen=True)
class _Pairs:
    """Points of N neighbouring pairs of frames, padded to P."""

    index: Ints
    """(N,) the earlier frame of each."""
    first: Array
    second: Array
    valid: Bools


def _points(tracks: Tracks, camera: Camera, depth_m: Depth) -> tuple[Array, Bools]:
    """(O, 3) camera points of all observations, and which are known; one depth map is held at a time."""
    rays = camera.unproject(tracks.pixel)
    z = np.zeros(len(tracks))
    column, row = np.round(tracks.pixel).astype(int).T
    begin = np.searchsorted(tracks.frame, np.arange(tracks.n_frames + 1))
    for k in range(tracks.n_frames):
        depth = depth_m(k)
        if depth is None:
            continue
        rows = slice(begin[k], begin[k + 1])
        y, x = np.clip(row[rows], 0, depth.shape[0] - 1), np.clip(column[rows], 0, depth.shape[1] - 1)
        z[rows] = depth[y, x]
    known = np.isfinite(z) & (z > 0) & np.isfinite(rays).all(axis=1) & (rays[:, 2] > 1e-3)
    forward = np.where(known, rays[:, 2], 1.0)
    return np.nan_to_num(rays) * np.where(known, z / forward, 0.0)[:, None], known


def shared_sightings(tracks: Tracks, camera: Camera, depth_m: Depth) -> Sightings:
    """Points with depth that neighbouring frames share; arguments as of `fit_pairs`."""
    cloud, known = _points(tracks, camera, depth_m)
    first = int(tracks.track.min(initial=0))
    span = int(tracks.track.max(initial=0)) - first + 1
    key = tracks.frame * span + tracks.track - first  # rows are sorted by frame and track, so keys increase
    row_j = np.minimum(np.searchsorted(key, key + span), max(len(key) - 1, 0))
    row_i = np.flatnonzero((key[row_j] == key + span) & known & known[row_j])
    return Sightings(tracks.frame[row_i], row_i, row_j[row_i], cloud)


def _blocks(seen: Sightings, n_pairs: int) -> Iterator[_Pairs]:
    """Pairs with enough points, a bounded number at a time: a fit's memory does not grow with the recording."""
    count = np.bincount(seen.frame, minlength=n_pairs)
    begin = np.concatenate([[0], np.cumsum(count)])
    enough = np.flatnonzero(count >= LEAST_POINTS)
    for start in range(0, len(enough), PAIRS_AT_ONCE):
        index = enough[start : start + PAIRS_AT_ONCE]
        column = np.arange(count[index].max())
        valid = column < count[index, None]
        rows = np.where(valid, begin[index, None] + column, 0)
        first, second = (seen.cloud[side[rows]] for side in (seen.row_i, seen.row_j))
        yield _Pairs(index, first, second, valid)


def _fitted(pairs: _Pairs, camera: Camera, noise: DepthNoise) -> PairFits:
    """Those pairs of a block whose motion is determined."""
    fit = fit_rigid(pairs.first, pairs.second, valid=pairs.valid, information=_information(pairs, camera, noise))
    distance = np.where(pairs.valid, np.linalg.norm(pairs.first, axis=2), np.nan)
    good = fit.observable
    return PairFits(pairs.index[good], fit.T_i_j[good], fit.cov[good], pairs.valid[good].sum(axis=1),
                    np.nanmedian(distance[good], axis=1))


def _information(pairs: _Pairs, camera: Camera, noise: DepthNoise) -> Array:
    """(N, P, 3, 3) inverse covariance of the difference of two sightings: sharp across the ray, soft along it."""
    distance = np.maximum(np.linalg.norm(pairs.first, axis=2), 1e-9)
    ray = pairs.first / distance[:, :, None]
    across = 2 * (noise.pixel_px / camera.fx * distance) ** 2
    along = across + 2 * (noise.depth_relative * distance) ** 2
    outer = ray[..., :, None] * ray[..., None, :]
    return np.asarray((np.eye(3) - outer) / across[..., None, None] + outer / along[..., None, None])
