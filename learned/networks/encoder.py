"""What every image encoder has in common: blocks whose maps can be fused, and the way it sees an image."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn

IMAGE_MEAN, IMAGE_SD = 0.45, 0.225
"""One mean and deviation for all three channels, as in all published code of the ResNet-based methods."""

FuseBlock = Callable[[int, Tensor], Tensor]
"""Called with a block's number and its (N, C, H, W) map; what it returns feeds the next block and the decoder."""


def keep_features(block: int, features: Tensor) -> Tensor:
    """No fusion: a vision-only network."""
    return features


class Encoder(nn.Module):
    """Images (N, C, H, W) in 0..1 → one map per block, finest first.

    `forward(images, fuse)` hands every block's map to `fuse` and goes on with what comes back, so the same
    encoder serves vision alone and every fusion strategy.
    """

    channels: tuple[int, ...]
    """Channels of the map of every block."""


def normalise_image(images: Tensor) -> Tensor:
    """0..1 → about zero mean and unit deviation."""
    return (images - IMAGE_MEAN) / IMAGE_SD


def scaled(channels: int, width: float) -> int:
    """Channels of a compact variant: at least one."""
    return max(1, round(channels * width))
