"""Attentional feature fusion and its iterative form (Dai et al., WACV 2021).

    AFF(x, y)  = M(x + y) ⊙ x + (1 - M(x + y)) ⊙ y
    iAFF(x, y) = M2(U) ⊙ x + (1 - M2(U)) ⊙ y,   U = AFF(x, y)

Without the factor 2 of the published code, and with a global branch of its own in each attention, as in the article.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.vibration_fusion.interface import FusedMap, FusionConfig, VibrationFusion
from learned.vibration_fusion.pointwise import spread


class MultiScaleAttention(nn.Module):
    """M(X) = σ(L(X) + G(mean of X)): two bottlenecks of 1x1 convolutions, one per cell, one for the whole map.

    The article normalises over the batch, which fails at batch 1 on the single cell of the global branch: here the
    local branch is normalised over each sample's map, the global one not at all.
    """

    def __init__(self, channels: int, reduction: int) -> None:
        super().__init__()
        self.local_branch = _bottleneck(channels, reduction)
        self.global_branch = _bottleneck(channels, reduction, normalised=False)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) → weights in 0..1, same shape."""
        return torch.sigmoid(self.local_branch(x) + self.global_branch(x.mean((2, 3), keepdim=True)))


class AttentionalFusion(VibrationFusion):
    """AFF."""

    def __init__(self, channels: int, vibration_features: int, config: FusionConfig) -> None:
        super().__init__()
        self.project = nn.Linear(vibration_features, channels)
        self.attention = MultiScaleAttention(channels, config.attention_reduction)

    def forward(self, features: Tensor, vibration: Tensor) -> FusedMap:
        """(N, C, H, W) and (N, D) → same shape."""
        y = spread(self.project(vibration))
        return FusedMap(_selected(self.attention(features + y), features, y), None)


class IterativeAttentionalFusion(VibrationFusion):
    """iAFF."""

    def __init__(self, channels: int, vibration_features: int, config: FusionConfig) -> None:
        super().__init__()
        self.project = nn.Linear(vibration_features, channels)
        self.first = MultiScaleAttention(channels, config.attention_reduction)
        self.second = MultiScaleAttention(channels, config.attention_reduction)

    def forward(self, features: Tensor, vibration: Tensor) -> FusedMap:
        """(N, C, H, W) and (N, D) → same shape."""
        y = spread(self.project(vibration))
        start = _selected(self.first(features + y), features, y)
        return FusedMap(_selected(self.second(start), features, y), None)


def _selected(weights: Tensor, x: Tensor, y: Tensor) -> Tensor:
    return weights * x + (1 - weights) * y


def _bottleneck(channels: int, reduction: int, normalised: bool = True) -> nn.Sequential:
    inner = max(2, channels // reduction)
    norms = [nn.GroupNorm(1, c) if normalised and c > 1 else nn.Identity() for c in (inner, channels)]
    return nn.Sequential(nn.Conv2d(channels, inner, 1), norms[0], nn.ReLU(), nn.Conv2d(inner, channels, 1), norms[1])
