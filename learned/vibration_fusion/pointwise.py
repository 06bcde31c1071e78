"""Concatenation, summation and gated fusion: every cell is changed by the vibration alone, the same everywhere.

The map is x; the vibration's features g, brought to its channels by a linear layer and repeated over it, are y.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.vibration_fusion.interface import FusedMap, VibrationFusion


def spread(vector: Tensor) -> Tensor:
    """(N, C) → (N, C, 1, 1), to be broadcast over a map."""
    return vector[..., None, None]


class Summation(VibrationFusion):
    """x + y."""

    def __init__(self, channels: int, vibration_features: int) -> None:
        super().__init__()
        self.project = nn.Linear(vibration_features, channels)

    def forward(self, features: Tensor, vibration: Tensor) -> FusedMap:
        """(N, C, H, W) and (N, D) → same shape."""
        return FusedMap(features + spread(self.project(vibration)).to(features.dtype), None)


class Concatenation(VibrationFusion):
    """A 1x1 convolution of [x, y], 2C → C.

    Computed as the sum of a convolution of x and a linear map of y, which is the same and saves the repeated half.
    """

    def __init__(self, channels: int, vibration_features: int) -> None:
        super().__init__()
        self.project = nn.Linear(vibration_features, channels)
        self.mix = nn.Conv2d(2 * channels, channels, 1)

    def forward(self, features: Tensor, vibration: Tensor) -> FusedMap:
        """(N, C, H, W) and (N, D) → same shape."""
        return FusedMap(mixed(self.mix, features, self.project(vibration)), None)


class Gated(VibrationFusion):
    """Gated multimodal unit (Arevalo et al., 2017): z ⊙ tanh(W x) + (1 - z) ⊙ tanh(y), z = σ(W_z [W x, y]).

    The gate sees the projected features before tanh, as in the author's code; its batch norms are left out, because
    they have nothing to average over at batch 1.
    """

    def __init__(self, channels: int, vibration_features: int) -> None:
        super().__init__()
        self.project_vision = nn.Conv2d(channels, channels, 1)
        self.project = nn.Linear(vibration_features, channels)
        self.gate = nn.Conv2d(2 * channels, channels, 1, bias=False)

    def forward(self, features: Tensor, vibration: Tensor) -> FusedMap:
        """(N, C, H, W) and (N, D) → same shape, within -1..1."""
        vision, other = self.project_vision(features), self.project(vibration)
        z = torch.sigmoid(mixed(self.gate, vision, other))
        return FusedMap(z * torch.tanh(vision) + (1 - z) * torch.tanh(spread(other)), None)


def mixed(layer: nn.Conv2d, features: Tensor, vector: Tensor) -> Tensor:
    """A 1x1 convolution of [features, vector repeated over the map], without repeating it."""
    channels = features.shape[1]
    of_map = nn.functional.conv2d(features, layer.weight[:, :channels])
    of_vector = nn.functional.linear(vector, layer.weight[:, channels:, 0, 0], layer.bias)
    return of_map + spread(of_vector)
