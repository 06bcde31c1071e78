"""The pose decoder that all four published methods share: 1x1, 3x3, 3x3, 1x1 convolutions and a spatial mean."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.networks.encoder import scaled

HIDDEN = 256


class PoseDecoder(nn.Module):
    """Encoder's coarsest map (N, C, h, w) → raw pose numbers (N, outputs) and the map they come from.

    Args:
        inputs: channels C.
        outputs: 6, or 12 where a published network predicts two motions and uses the first.
        width: factor on the 256 hidden channels.
    """

    def __init__(self, inputs: int, outputs: int = 6, width: float = 1.0) -> None:
        super().__init__()
        hidden = scaled(HIDDEN, width)
        self.hidden_channels = hidden
        self.squeeze = nn.Conv2d(inputs, hidden, 1)
        self.conv1 = nn.Conv2d(hidden, hidden, 3, 1, 1)
        self.conv2 = nn.Conv2d(hidden, hidden, 3, 1, 1)
        self.out = nn.Conv2d(hidden, outputs, 1)

    def forward(self, coarsest: Tensor) -> tuple[Tensor, Tensor]:
        """Raw numbers (N, outputs) in float32 under autocast, and the hidden map before its last ReLU."""
        x = F.relu(self.squeeze(coarsest))
        feature: Tensor = self.conv2(F.relu(self.conv1(x)))
        with torch.autocast(feature.device.type, enabled=False):
            raw: Tensor = self.out(F.relu(feature).to(self.out.weight.dtype)).mean((2, 3))
        return raw, feature
