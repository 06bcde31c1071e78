"""Classical relative motion from tracks: essential matrix to start, then PnP on triangulated tracks, no network.

Every new frame is placed by points that are already in the map, so that one scale runs through it. Where a frame
cannot be placed the map is closed and a new one begins. The longest map sets the unit; the others bring directions and
rotations, with a translation whose length is next to unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio.camera import Camera
from vio.errors import TrackingError
from vio.mapping import Map, MapMotions, MapSettings
from vio.motions import RelativeMotions
from vio.recording import Recording
from vio.tracking import track_recording
from vio.tracks import Tracks, check_frame_indices

Array = NDArray[np.float64]

OTHER_MAP_SCALE_SD = 1.0
"""Relative sd of the length of a step in a map whose scale is not the longest map's."""
LEAST_SD = np.array([1e-5] * 3 + [1e-5] * 3)
"""Floor of the claimed sds [rad, units]: no image is better than this."""


@dataclass(frozen=True)
class ScalePrior:
    """What is known of the length of a motion unit before any inertial data: s = ln(metres per unit)."""

    log_mean: float = 0.0
    log_sd: float = 1.5
    """The default knows nothing but the order of magnitude."""


def measure_motions(tracks: Tracks, camera: Camera, frame_t_s: ArrayLike, frame_indices: ArrayLike | None = None,
                    prior: ScalePrior | None = None, settings: MapSettings | None = None) -> RelativeMotions:
    """Motions of the camera between neighbouring frames, from tracks alone.

    The motion unit is the median distance of the longest map's first points. Covariances are those of the windows'
    adjustments, scaled to their residuals. Pairs that cannot be measured are left out.

    Args:
        tracks: observations in pixels, of frames 0 to M - 1.
        camera: the camera that saw them.
        frame_t_s: (M,) times of the frames [s].
        frame_indices: frames to use (increasing), all when None; motions join neighbours among them.
        prior: of the scale; by default nothing is known.
        settings: of the maps.

    Raises:
        TrackingError: too few tracks, or no parallax anywhere.
    """
    t_s = np.asarray(frame_t_s, float)
    if len(t_s) < tracks.n_frames:
        raise TrackingError(f"{len(t_s)} frame times for tracks of {tracks.n_frames} frames; give one time per frame")
    index = check_frame_indices(np.arange(tracks.n_frames) if frame_indices is None else frame_indices, tracks.n_frames)
    maps = _grow_maps(Map(tracks.select_frames(index), camera, settings or MapSettings()))
    longest = max(range(len(maps)), key=lambda n: len(maps[n].first))
    maps = [part if n == longest else _loosened(part) for n, part in enumerate(maps)]
    first, T, cov = (np.concatenate([getattr(part, name) for part in maps]) for name in ("first", "T", "cov"))
    prior = prior or ScalePrior()
    meta = {"method": "classical: essential matrix, PnP, sliding-window adjustment", "maps": len(maps)}
    return RelativeMotions(t_s[index[first]], t_s[index[first + 1]], T, cov + np.diag(LEAST_SD**2), prior.log_mean,
                           prior.log_sd, meta=meta)


def measure_recording(recording: Recording, prior: ScalePrior | None = None) -> RelativeMotions:
    """Track a recording's images and measure the motions between its frames.

    Raises:
        TrackingError: there are no images or no camera intrinsics, or as `measure_motions`.
        RecordingError: an image cannot be read.
    """
    camera = recording.calibration.camera
    if camera is None or not recording.has_any_image:
        raise TrackingError(f"recording {recording.name}: classical motions need camera intrinsics and all image files")
    return measure_motions(track_recording(recording), camera, recording.frame_t_s, prior=prior)


def _grow_maps(world: Map) -> list[MapMotions]:
    first, maps = 0, []
    while first < world.n_frames - 1 and world.begin(first):
        first = world.grow()
        maps.append(world.motions())
    maps = [part for part in maps if len(part.first)]
    if not maps:
        limits = f"{world.settings.min_tracks} tracks, {world.settings.start_parallax_deg:g} deg of parallax"
        raise TrackingError(f"no two of {world.n_frames} frames share enough tracks with parallax (limits: {limits}); "
                            "the view is still, blind or without texture")
    return maps


def _loosened(part: MapMotions) -> MapMotions:
    """The same motions with the length of every step next to unknown: the map's own unit is arbitrary."""
    step = np.zeros((len(part.first), 6))
    R_t = np.swapaxes(part.T[:, :3, :3], 1, 2)
    step[:, 3:] = (R_t @ part.T[:, :3, 3:])[:, :, 0]  # right perturbation: axes of the second camera
    return replace(part, cov=part.cov + OTHER_MAP_SCALE_SD**2 * step[:, :, None] * step[:, None, :])
