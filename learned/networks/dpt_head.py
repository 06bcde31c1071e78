"""Dense-prediction head of EndoDAC (Cui et al., 2024), a DPT decoder (Ranftl et al., ICCV 2021) with four heads.

Four maps of a vision transformer, all at one resolution, become a pyramid at 4, 2, 1 and 1/2 of it; it is fused from
coarse to fine, and every level has a head that doubles the resolution once more.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor, nn

from learned.networks.encoder import scaled

HEAD_CHANNELS = 32


class DptHead(nn.Module):
    """Four maps (N, C, h, w) → raw maps at 16, 8, 4, 2 times their size, finest first.

    Args:
        inputs: channels C of the transformer.
        features: channels of the fused pyramid (128 for the base, 64 for the small transformer).
        level_channels: channels that the four maps are projected to.
    """

    def __init__(self, inputs: int, features: int, level_channels: Sequence[int]) -> None:
        super().__init__()
        one, two, _, four = level_channels
        self.project = nn.ModuleList(nn.Conv2d(inputs, c, 1) for c in level_channels)
        self.resize = nn.ModuleList([
            nn.ConvTranspose2d(one, one, 4, 4), nn.ConvTranspose2d(two, two, 2, 2), nn.Identity(),
            nn.Conv2d(four, four, 3, 2, 1),
        ])
        self.to_features = nn.ModuleList(nn.Conv2d(c, features, 3, 1, 1, bias=False) for c in level_channels)
        blocks = [RefineBlock(features) for _ in level_channels]
        blocks[-1].level.requires_grad_(False)  # the coarsest level skips it; it is there for the published size
        self.refine = nn.ModuleList(blocks)
        self.heads = nn.ModuleList(HeadDepth(features) for _ in level_channels)

    def forward(self, maps: list[Tensor]) -> tuple[Tensor, ...]:
        """Four maps, shallow first → raw maps (N, 1, 16 h, 16 w), …, (N, 1, 2 h, 2 w)."""
        levels = [to(resize(project(x))) for x, project, resize, to
                  in zip(maps, self.project, self.resize, self.to_features, strict=True)]
        raw: list[Tensor] = []
        path: Tensor | None = None
        for k in (3, 2, 1, 0):
            size = levels[k - 1].shape[-2:] if k else tuple(2 * n for n in levels[0].shape[-2:])
            path = self.refine[k](levels[k], path, size)
            raw.append(self.heads[k](path))
        return tuple(reversed(raw))


class RefineBlock(nn.Module):
    """Adds a level to what came from the coarser ones, refines the sum and enlarges it."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.level, self.sum = ResidualUnit(features), ResidualUnit(features)
        self.out = nn.Conv2d(features, features, 1)

    def forward(self, level: Tensor, coarser: Tensor | None, size: Sequence[int]) -> Tensor:
        """Both (N, features, h, w); the result has `size`. The coarsest level comes alone and skips its own unit."""
        x = self.sum(level if coarser is None else coarser + self.level(level))
        out: Tensor = self.out(F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=True))
        return out


class ResidualUnit(nn.Module):
    """ReLU before each of two 3x3 convolutions, and a shortcut."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, 1, 1)
        self.conv2 = nn.Conv2d(features, features, 3, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Shape unchanged."""
        out: Tensor = x + self.conv2(F.relu(self.conv1(F.relu(x))))
        return out


class HeadDepth(nn.Module):
    """Half the channels, twice the size, 32 channels, one raw value."""

    def __init__(self, features: int) -> None:
        super().__init__()
        half = scaled(features, 0.5)
        self.reduce = nn.Conv2d(features, half, 3, 1, 1)
        self.hidden = nn.Conv2d(half, HEAD_CHANNELS, 3, 1, 1)
        self.value = nn.Conv2d(HEAD_CHANNELS, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(N, features, h, w) → (N, 1, 2 h, 2 w)."""
        x = F.interpolate(self.reduce(x), scale_factor=2.0, mode="bilinear", align_corners=True)
        out: Tensor = self.value(F.relu(self.hidden(x)))
        return out
