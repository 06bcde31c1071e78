"""What the pixels of a depth image mean, and how they become z-depth in metres.

z-depth is measured along the optical axis, not along the ray. 0 stands for unknown. Decoded images come from
`vio.image_files`, so colour channels are in B, G, R order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from vio.errors import RecordingError

Depth = NDArray[np.float32]
Counts = NDArray[np.uint16]
LARGEST_COUNT = 65535


class DepthEncoding(Protocol):
    """How the depth images of a recording are stored."""

    @property
    def metric(self) -> bool:
        """Whether metres can be had; if not, the images hold depth up to an unknown factor."""

    @property
    def unit_m(self) -> float:
        """Metres per count where this depth is written as 16-bit z-depth."""

    def depth_m(self, image: NDArray[Any], what: str) -> Depth:
        """z-depth (H, W) in metres of a decoded image; `what` opens every message.

        Raises:
            RecordingError: an image of another kind, or an encoding that knows no metres.
        """


@dataclass(frozen=True)
class LinearDepth:
    """16-bit images whose counts are z-depth in `unit_m`; counts above `largest` mean "beyond" or "invalid"."""

    unit_m: float
    largest: int = LARGEST_COUNT
    metric: ClassVar[bool] = True

    def counts(self, image: NDArray[Any], what: str) -> Counts:
        """The counts (H, W), 0 where unknown.

        Raises:
            RecordingError: not 16 bit, or more than one channel.
        """
        if image.dtype != np.uint16 or image.ndim != 2:
            raise RecordingError(f"{what} is {image.dtype} with shape {image.shape}; "
                                 "give a 16-bit image with one channel")
        return np.where(image > self.largest, 0, image).astype(np.uint16) if self.largest < LARGEST_COUNT else image

    def depth_m(self, image: NDArray[Any], what: str) -> Depth:
        """z-depth (H, W) in metres; raises as `counts`."""
        return (self.counts(image, what) * np.float32(self.unit_m)).astype(np.float32)


@dataclass(frozen=True)
class ReversedZDepth:
    """8-bit device depth v of a renderer with reversed z: z = n f / (v (f - n) + n), near is bright.

    One count more or less moves z by about z² / (255 n): useless beyond some 50 near planes.
    """

    near_m: float
    far_m: float
    metric: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not 0 < self.near_m < self.far_m < np.inf:
            raise RecordingError(f"depth range: near {self.near_m:g} m, far {self.far_m:g} m; give 0 < near < far")

    @property
    def unit_m(self) -> float:
        """The far plane is the largest count."""
        return self.far_m / LARGEST_COUNT

    def depth_m(self, image: NDArray[Any], what: str) -> Depth:
        """z-depth (H, W) in metres, 0 where nothing nearer than the far plane was drawn.

        Raises:
            RecordingError: not 8 bit, or colours that are not grey.
        """
        v = grey_8bit(image, what) / 255
        z = self.near_m * self.far_m / (v * (self.far_m - self.near_m) + self.near_m)
        return np.where(v > 0, z, 0).astype(np.float32)


@dataclass(frozen=True)
class PointMapDepth:
    """Float images (H, W, 3) of points in camera axes; z is the last coordinate, in `stored_unit_m`.

    `stacked`: the upper half belongs to the left camera, the lower half to the right one, and the left is meant.
    """

    stored_unit_m: float
    stacked: bool = False
    unit_m: float = 1e-5
    metric: ClassVar[bool] = True

    def depth_m(self, image: NDArray[Any], what: str) -> Depth:
        """z-depth (H, W) in metres, 0 where the point is not finite or not in front.

        Raises:
            RecordingError: not float with three channels.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype not in (np.float32, np.float64):
            raise RecordingError(f"{what} is {image.dtype} with shape {image.shape}; give points as 3 float channels")
        z = image[: image.shape[0] // 2 if self.stacked else None, :, 0]  # decoded as B, G, R: z comes first
        return np.where(np.isfinite(z) & (z > 0), z * self.stored_unit_m, 0).astype(np.float32)


@dataclass(frozen=True)
class RelativeInverseDepth:
    """8-bit images proportional to INVERSE depth by an unknown factor, near is bright, 0 = nothing drawn.

    The device depth of a renderer whose near and far planes nobody recorded.
    """

    unit_m: float = 1.0
    metric: ClassVar[bool] = False

    def depth_m(self, image: NDArray[Any], what: str) -> Depth:
        """Refused: the factor is unknown.

        Raises:
            RecordingError: always.
        """
        raise RecordingError(f"{what} holds inverse depth up to an unknown factor, so it has no metres; use "
                             "`relative_inverse_depth`, or declare the near and far planes and the unit")

    def inverse(self, image: NDArray[Any], what: str) -> Depth:
        """Inverse depth (H, W) in 0..1, up to a factor; 0 where nothing was drawn.

        Raises:
            RecordingError: not 8 bit, or colours that are not grey.
        """
        return (grey_8bit(image, what) / np.float32(255)).astype(np.float32)


def grey_8bit(image: NDArray[Any], what: str) -> NDArray[np.uint8]:
    """The one channel (H, W) of an 8-bit grey image, whatever its alpha.

    Raises:
        RecordingError: not 8 bit, or channels that differ.
    """
    colours = image[..., None] if image.ndim == 2 else image[..., :3]
    if image.dtype != np.uint8 or (colours != colours[..., :1]).any():
        raise RecordingError(f"{what} is {image.dtype} with shape {image.shape}; give an 8-bit grey image, channels "
                             "equal")
    grey: NDArray[np.uint8] = colours[..., 0]
    return grey


def to_counts(depth_m: Depth, unit_m: float) -> Counts:
    """Metres (H, W) as 16-bit counts; 0 (unknown) beyond the largest count."""
    counts = np.round(np.asarray(depth_m, float) / unit_m)
    return np.where((counts >= 0) & (counts <= LARGEST_COUNT), counts, 0).astype(np.uint16)
