"""Frames as networks take them: R, G, B at one size."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def resized_rgb(image: Image, size: tuple[int, int] | None) -> Image:
    """(h, w, 3) of an image (H, W) or (H, W, 3), uint8: areas averaged when it shrinks, interpolated when it grows.

    Args:
        image: grey or R, G, B.
        size: (height, width); None keeps the image's.
    """
    if size is not None and image.shape[:2] != size:
        shrinks = size[0] < image.shape[0]
        image = np.asarray(cv2.resize(image, (size[1], size[0]),
                                      interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), np.uint8)
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
