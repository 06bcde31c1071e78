"""Bottom-up top-down attention (Anderson et al., CVPR 2018): the map's cells are regions, the vibration asks.

    f(x) = tanh(W x + b) ⊙ σ(W' x + b')                    gated tanh
    α = softmax over cells of wᵀ f_a([x_i, g]),   v = Σ α_i x_i,   h = f_q(g) ⊙ f_v(v)

The article ends in the vector h; here it is added to every cell, so that the block keeps its map.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.vibration_fusion.interface import FusedMap, VibrationFusion
from learned.vibration_fusion.pointwise import mixed, spread


class BottomUpTopDown(VibrationFusion):
    """x + h, with h from where the vibration makes the network look."""

    def __init__(self, channels: int, vibration_features: int) -> None:
        super().__init__()
        self.attend = nn.Conv2d(channels + vibration_features, channels, 1)
        self.attend_gate = nn.Conv2d(channels + vibration_features, channels, 1)
        self.score = nn.Conv2d(channels, 1, 1, bias=False)
        self.question = GatedTanh(vibration_features, channels)
        self.answer = GatedTanh(channels, channels)

    def forward(self, features: Tensor, vibration: Tensor) -> FusedMap:
        """(N, C, H, W) and (N, D) → same shape."""
        joint = torch.tanh(mixed(self.attend, features, vibration)) * torch.sigmoid(
            mixed(self.attend_gate, features, vibration))
        weights = torch.softmax(self.score(joint).flatten(2), 2)
        seen = (features.flatten(2) * weights).sum(2)
        return FusedMap(features + spread(self.question(vibration) * self.answer(seen)).to(features.dtype), None)


class GatedTanh(nn.Module):
    """tanh(W x + b) ⊙ σ(W' x + b')."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.value, self.gate = nn.Linear(inputs, outputs), nn.Linear(inputs, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs) → (N, outputs)."""
        return torch.tanh(self.value(x)) * torch.sigmoid(self.gate(x))
