"""Tracks from images: corners followed by KLT, each step checked backward, lost ones replaced.

Kanade-Lucas-Tomasi (Tomasi and Kanade, 1991; pyramids: Bouguet, 2000) as OpenCV has it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vio.errors import TrackingError
from vio.recording import Recording
from vio.tracks import Tracks, tracks_from_table

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

CLIP_LEVEL = 250
"""Grey level from which a pixel counts as a specular highlight."""
DARK_LEVEL = 12
"""Grey level up to which a pixel that stays dark at the border counts as vignette."""
MASK_MARGIN_PX = 7


@dataclass(frozen=True)
class TrackerSettings:
    """How images are tracked."""

    corners: int = 300
    """Tracks kept alive per frame."""
    spacing_px: float = 8.0
    """Smallest distance between corners."""
    quality: float = 0.005
    """Strength of the weakest corner over the strongest's."""
    window_px: int = 21
    pyramid_levels: int = 4
    forward_backward_px: float = 0.7
    """How far a corner may miss its origin when it is followed back."""


def track_recording(recording: Recording, settings: TrackerSettings | None = None) -> Tracks:
    """Track a whole recording, reading one frame at a time.

    Raises:
        TrackingError: fewer than two frames, frames of different sizes, or no texture in any of them.
        RecordingError: an image cannot be read.
    """
    return track_images((recording.frame(k) for k in range(len(recording))), settings)


def track_images(images: Iterable[Image], settings: TrackerSettings | None = None) -> Tracks:
    """Track images (H, W) or (H, W, 3), RGB, in the order they come; only two are held at a time.

    Raises:
        TrackingError: as `track_recording`.
    """
    tracker = _Tracker(settings or TrackerSettings())
    frame, track, pixel, count = [], [], [], 0
    for count, image in enumerate(images, 1):
        ids, points = tracker.step(_grey(image))
        frame.append(np.full(len(ids), count - 1))
        track.append(ids)
        pixel.append(points)
    if count < 2:
        raise TrackingError(f"tracking: {count} images; motion needs at least 2")
    tracks = tracks_from_table(np.concatenate(frame), np.concatenate(track), np.concatenate(pixel), count)
    if len(tracks) == 0:
        raise TrackingError(f"tracking: no texture in any of {count} images; are they dark, blurred or masked?")
    return tracks


def usable_mask(grey: Image) -> Image:
    """Where corners may lie (255): away from specular highlights and from the dark vignette."""
    highlights = grey >= CLIP_LEVEL
    vignette = connected_to_border(grey <= DARK_LEVEL)
    bad = (highlights | vignette).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * MASK_MARGIN_PX + 1, 2 * MASK_MARGIN_PX + 1))
    return np.where(cv2.dilate(bad, kernel) > 0, 0, 255).astype(np.uint8)


def connected_to_border(dark: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Those pixels of a mask (H, W) that hang together with the image's border."""
    _, labels = cv2.connectedComponents(dark.astype(np.uint8))
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    return np.isin(labels, border[border > 0])


def _grey(image: Image) -> Image:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    return np.ascontiguousarray(grey, np.uint8)


class _Tracker:
    """The corners alive in the last frame."""

    def __init__(self, settings: TrackerSettings) -> None:
        self.settings = settings
        self.before: Image | None = None
        self.ids = np.zeros(0, np.int64)
        self.points = np.zeros((0, 1, 2), np.float32)
        self.next_id = 0

    def step(self, grey: Image) -> tuple[NDArray[np.int64], Array]:
        """Follow all corners into the next image and add new ones; returns identities (n,) and pixels (n, 2)."""
        if self.before is not None and self.before.shape != grey.shape:
            raise TrackingError(f"tracking: an image of {grey.shape} follows one of {self.before.shape}; give one size")
        mask = usable_mask(grey)
        if self.before is not None and len(self.ids):
            self._follow(self.before, grey, mask)
        self._replenish(grey, mask)
        self.before = grey
        return self.ids, self.points[:, 0].astype(float)

    def _follow(self, before: Image, now: Image, mask: Image) -> None:
        s = self.settings
        window, levels = (s.window_px, s.window_px), s.pyramid_levels
        ahead, found, _ = cv2.calcOpticalFlowPyrLK(before, now, self.points, None, winSize=window, maxLevel=levels)
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(now, before, ahead, None, winSize=window, maxLevel=levels)
        miss = np.linalg.norm((back - self.points)[:, 0], axis=1)
        column, row = np.round(ahead[:, 0]).T
        inside = (column >= 0) & (row >= 0) & (column < now.shape[1]) & (row < now.shape[0])
        keep = inside & (found[:, 0] == 1) & (found_back[:, 0] == 1) & (miss < s.forward_backward_px)
        keep[keep] = mask[row[keep].astype(int), column[keep].astype(int)] > 0
        self.ids, self.points = self.ids[keep], ahead[keep]

    def _replenish(self, grey: Image, mask: Image) -> None:
        s = self.settings
        wanted = s.corners - len(self.ids)
        if wanted <= 0:
            return
        free = mask.copy()
        for x, y in self.points[:, 0]:
            cv2.circle(free, (round(float(x)), round(float(y))), round(s.spacing_px), 0, -1)
        corners = cv2.goodFeaturesToTrack(grey, wanted, s.quality, s.spacing_px, mask=free)
        if corners is None or len(corners) == 0:
            return
        self.ids = np.append(self.ids, self.next_id + np.arange(len(corners)))
        self.points = np.concatenate([self.points, corners.reshape(-1, 1, 2).astype(np.float32)])
        self.next_id += len(corners)
