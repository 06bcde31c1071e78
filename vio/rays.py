"""Pixels as unit rays, with the matrix that turns a difference of rays back into pixels.

Working on rays keeps one code for pinhole and fisheye, also beyond 90 degrees; keeping the pixel scale
keeps the noise where it arises, in the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio.camera import Camera

Array = NDArray[np.float64]

STEP_PX = 0.05  # of the central difference of `unproject`


@dataclass(frozen=True)
class Rays:
    """O viewing directions in camera axes."""

    bearing: Array
    """(O, 3) unit vectors."""
    to_pixels: Array
    """(O, 2, 3): `to_pixels @ (direction - bearing)` is the distance in pixels, to first order."""

    def __len__(self) -> int:
        return len(self.bearing)

    def select(self, index: ArrayLike) -> Rays:
        """The rays at the given indices (or boolean mask)."""
        index = np.asarray(index)
        return Rays(self.bearing[index], self.to_pixels[index])

    @property
    def pixels_per_radian(self) -> Array:
        """(O,) mean magnification at every ray."""
        area = np.linalg.norm(np.cross(self.to_pixels[:, 0], self.to_pixels[:, 1]), axis=-1)
        return np.asarray(np.sqrt(area))


def rays_from_pixels(camera: Camera, pixels: ArrayLike) -> tuple[Rays, NDArray[np.bool_]]:
    """Rays (O of them) of pixels (O, 2), and which of them (O,) the camera model reaches; the others are NaN."""
    pixels = np.asarray(pixels, float).reshape(-1, 2)
    shifts = STEP_PX * np.array([[0.0, 0.0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    bearing, right, left, down, up = camera.unproject(pixels + shifts[:, None])
    slope = np.stack([right - left, down - up], axis=-1) / (2 * STEP_PX)  # (O, 3, 2) rays per pixel
    gram = np.swapaxes(slope, 1, 2) @ slope
    valid = np.isfinite(bearing).all(axis=1) & np.isfinite(gram).all(axis=(1, 2))
    gram[~valid] = np.eye(2)
    to_pixels = np.asarray(np.linalg.solve(gram, np.swapaxes(slope, 1, 2)), float)
    return Rays(bearing, to_pixels), valid
