"""Pinhole intrinsics from a pair's features (EndoDAC; after Gordon et al., ICCV 2019)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.networks.encoder import scaled
from learned.networks.pose_decoder import HIDDEN

SMALLEST = 0.5
"""Smallest focal length, and the principal point of an untrained head, in units of the image size."""


class IntrinsicsHead(nn.Module):
    """(fx, fy) = (softplus(a) + 0.5) · (W, H) and (cx, cy) = (b + 0.5) · (W, H), with a, b linear in pooled features.

    Args:
        inputs: channels of the features.
        squeeze: reduce the features to 256 channels first (512 inputs: 132,352 parameters).
        width: factor on the 256.
    """

    def __init__(self, inputs: int, squeeze: bool = True, width: float = 1.0) -> None:
        super().__init__()
        hidden = scaled(HIDDEN, width) if squeeze else inputs
        self.squeeze = nn.Conv2d(inputs, hidden, 1) if squeeze else None
        self.focal = nn.Conv2d(hidden, 2, 1, bias=False)
        self.offset = nn.Conv2d(hidden, 2, 1, bias=False)

    def forward(self, features: Tensor, image_size: tuple[int, int]) -> Tensor:
        """(N, C, h, w) and the image's (height, width) → K (N, 3, 3) in pixels of that image."""
        pooled = features.mean((2, 3), keepdim=True)
        if self.squeeze is not None:
            pooled = self.squeeze(pooled)
        height, width = image_size
        size = torch.tensor([width, height], dtype=torch.float32, device=features.device)
        focal = (F.softplus(self.focal(pooled).float().flatten(1)) + SMALLEST) * size
        offset = (self.offset(pooled).float().flatten(1) + SMALLEST) * size
        zero, one = torch.zeros_like(focal[:, 0]), torch.ones_like(focal[:, 0])
        rows = [focal[:, 0], zero, offset[:, 0], zero, focal[:, 1], offset[:, 1], zero, zero, one]
        return torch.stack(rows, 1).reshape(-1, 3, 3)
