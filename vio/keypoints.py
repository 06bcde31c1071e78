"""Keypoints of single images and matches between two, however far apart in time.

SIFT (Lowe, IJCV 60, 2004) with the descriptor's square root taken ("RootSIFT", Arandjelović and Zisserman, CVPR 2012)
after local histogram equalisation: the light of a capsule moves with the camera. A match is mutual and clearly better
than the second best.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vio.tracking import usable_mask

Array = NDArray[np.float64]

MOST = 800
"""Keypoints of an image."""
LEAST_CONTRAST = 0.003
"""Mucosa is smooth: SIFT's usual 0.04 leaves a tenth of the keypoints."""
CLIP_LIMIT, TILES = 3.0, (4, 4)
"""Of the histogram equalisation."""
RATIO = 0.85
"""Largest distance of a match over that of the second best."""
SAME_TURN_RAD = float(np.deg2rad(40.0))
"""How far the turn of one match may be off that of the image between two views of one place."""
SAME_PX = 1.0
"""Keypoints of one place with several orientations lie closer than this and count once."""


@dataclass(frozen=True)
class Keypoints:
    """K keypoints of an image."""

    pixel: Array
    """(K, 2)"""
    descriptor: NDArray[np.float32]
    """(K, 128) unit vectors."""
    turn_rad: Array
    """(K,) direction of the strongest gradient around each."""

    def __len__(self) -> int:
        return len(self.pixel)

    def select(self, index: NDArray[Any]) -> Keypoints:
        """The keypoints at the given indices or mask."""
        return Keypoints(self.pixel[index], self.descriptor[index], self.turn_rad[index])


def find_keypoints(image: NDArray[np.uint8]) -> Keypoints:
    """Keypoints of an image (H, W) or (H, W, 3) in R, G, B, away from highlights and the dark vignette."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else np.ascontiguousarray(image)
    equalised = cv2.createCLAHE(CLIP_LIMIT, TILES).apply(grey)
    opencv: Any = cv2
    sift = opencv.SIFT_create(MOST, contrastThreshold=LEAST_CONTRAST)
    found, raw = sift.detectAndCompute(equalised, usable_mask(grey))
    if raw is None or len(raw) == 0:
        return Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros(0))
    rooted = np.sqrt(raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-12)).astype(np.float32)
    turn = np.deg2rad([point.angle for point in found])
    return Keypoints(np.array([point.pt for point in found], float), rooted, turn)


def match_keypoints(first: Keypoints, second: Keypoints) -> NDArray[np.int64]:
    """(N, 2) numbers of matching keypoints of two images, best first, each place of either image at most once.

    Between two views of one place the image is turned as a whole: matches that tell of another turn than most are left
    out, which is nearly all of them where the places differ.
    """
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    likeness = first.descriptor @ second.descriptor.T  # of unit vectors: distance² = 2 - 2 likeness
    nearest, rows = likeness.argmax(axis=1), np.arange(len(first))
    mutual = likeness.argmax(axis=0)[nearest] == rows
    best = likeness[rows, nearest].copy()
    likeness[rows, nearest] = -np.inf
    clear = 1 - best < RATIO**2 * (1 - likeness.max(axis=1))
    kept = np.flatnonzero(mutual & clear)
    kept = kept[np.argsort(-best[kept], kind="stable")]
    pairs = np.column_stack([kept, nearest[kept]]).astype(np.int64)
    pairs = pairs[_turned_alike(second.turn_rad[pairs[:, 1]] - first.turn_rad[pairs[:, 0]])]
    return pairs[_single(first.pixel[pairs[:, 0]]) & _single(second.pixel[pairs[:, 1]])]


def _single(pixel: Array) -> NDArray[np.bool_]:
    """(N,) whether no earlier point lies within `SAME_PX`."""
    near = np.linalg.norm(pixel[:, None] - pixel[None], axis=2) < SAME_PX
    return np.asarray(~np.tril(near, -1).any(axis=1))


def _turned_alike(turn_rad: Array) -> NDArray[np.bool_]:
    """(N,) which turns lie around the one that most lie around."""
    if len(turn_rad) == 0:
        return np.zeros(0, bool)
    off = turn_rad[:, None] - turn_rad
    near = np.cos(off) > np.cos(SAME_TURN_RAD)
    return np.asarray(near[near.sum(axis=1).argmax()])
