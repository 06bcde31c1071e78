"""Encoder, decoder and, where there is vibration, a fusion after every block: images → disparity."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.networks.encoder import Encoder
from learned.vibration_fusion import EncoderFusion, FusionConfig


class DepthNetwork(nn.Module):
    """Images (N, 3, H, W) → disparity pyramid in 0..1.

    Args:
        encoder: with blocks that can be fused.
        decoder: the encoder's maps → raw maps, finest first.
        full_size: enlarge a finest map that is smaller than the image, bilinearly.
    """

    def __init__(self, encoder: Encoder, decoder: nn.Module, full_size: bool = False) -> None:
        super().__init__()
        self.encoder, self.decoder, self.full_size = encoder, decoder, full_size
        self.fusion: EncoderFusion | None = None

    def add_fusion(self, config: FusionConfig, vibration_features: int) -> None:
        """Fuse vibration of `vibration_features` numbers after every block of the encoder."""
        self.fusion = EncoderFusion(config, self.encoder.channels, vibration_features)

    def forward(self, images: Tensor, vibration: Tensor | None) -> tuple[tuple[Tensor, ...], Tensor | None]:
        """Disparity of every scale, finest first, (N, 1, h, w) in 0..1, and SNR (N, blocks).

        Args:
            images: (N, 3, H, W) in 0..1.
            vibration: (N, D) features; needed with fusion, None without.
        """
        if self.fusion is None or vibration is None:
            raw, snr = self.decoder(self.encoder(images)), None
        else:
            bound = self.fusion.bind(vibration)
            raw = self.decoder(self.encoder(images, bound))
            snr = bound.snr
        raw = tuple(x.float() if x.dtype in (torch.float16, torch.bfloat16) else x for x in raw)
        if self.full_size and raw[0].shape[-2:] != images.shape[-2:]:
            finest = F.interpolate(raw[0], size=images.shape[-2:], mode="bilinear", align_corners=False)
            raw = (finest, *raw[1:])
        return tuple(torch.sigmoid(x) for x in raw), snr
