"""Spatial attention block of EndoSfMLearner's pose encoder (Ozyoruk et al., Medical Image Analysis 2021)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vio.errors import ConfigError

REDUCTION = 16
POOL = 4


class SpatialAttention(nn.Module):
    """Relates the rows of a pooled map to each other and adds the result to the map.

    Reduce to 1/16 of the channels, pool 4x4, affinity of every row with every row (H' x H'), ReLU, 1x1 convolution,
    softmax over the channels, apply to the pooled map, restore channels and size, add.

    Args:
        channels: channels of the map; 64 give 528 parameters, none of them a bias.
        layout: "transpose" multiplies the pooled map (H' x W') with its transpose; "reshape" reads the same memory as
            W' x H' without transposing, as the published code does, which relates pixels to unrelated ones.

    Raises:
        ConfigError: another layout.
    """

    def __init__(self, channels: int, layout: str = "transpose") -> None:
        super().__init__()
        if layout not in ("transpose", "reshape"):
            raise ConfigError(f"attention layout {layout!r}: unknown, choose 'transpose' or 'reshape'")
        reduced = max(1, channels // REDUCTION)
        self.layout = layout
        self.reduce = nn.Conv2d(channels, reduced, 1, bias=False)
        self.mix = nn.Conv2d(reduced, reduced, 1, bias=False)
        self.restore = nn.Conv2d(reduced, channels, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) → same shape; H and W divisible by 4."""
        pooled = F.max_pool2d(self.reduce(x), POOL)
        height, width = pooled.shape[-2:]
        if self.layout == "transpose":
            other = pooled.transpose(2, 3)
        else:
            other = pooled.contiguous().reshape(*pooled.shape[:2], width, height)
        weights = torch.softmax(self.mix(F.relu(pooled @ other)), 1)
        return x + F.interpolate(self.restore(weights.to(pooled.dtype) @ pooled), scale_factor=float(POOL),
                                 mode="nearest")
