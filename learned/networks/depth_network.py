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
        whole_image: one number per image, read off the means of the encoder's maps, is added to every raw map: how near
            everything is. A decoder has to agree on that pixel by pixel, and was measured not to learn it.
    """

    def __init__(self, encoder: Encoder, decoder: nn.Module, full_size: bool = False,
                 whole_image: bool = False) -> None:
        super().__init__()
        self.encoder, self.decoder, self.full_size = encoder, decoder, full_size
        self.nearness = nn.Linear(sum(encoder.channels), 1) if whole_image else None
        if self.nearness is not None:
            nn.init.zeros_(self.nearness.weight)
            nn.init.zeros_(self.nearness.bias)
        self.fusion: EncoderFusion | None = None

    def add_fusion(self, config: FusionConfig, vibration_features: int) -> None:
        """Fuse vibration of `vibration_features` numbers after every block of the encoder."""
        self.fusion = EncoderFusion(config, self.encoder.channels, vibration_features)

    def forward(self, images: Tensor, vibration: Tensor | None
                ) -> tuple[tuple[Tensor, ...], Tensor | None, Tensor | None]:
        """Disparity of every scale, finest first, (N, 1, h, w) in 0..1; SNR (N, blocks); the whole image's number (N,).

        Args:
            images: (N, 3, H, W) in 0..1.
            vibration: (N, D) features; needed with fusion, None without.
        """
        bound = None if self.fusion is None or vibration is None else self.fusion.bind(vibration)
        maps = self.encoder(images) if bound is None else self.encoder(images, bound)
        raw = tuple(x.float() if x.dtype in (torch.float16, torch.bfloat16) else x for x in self.decoder(maps))
        snr = None if bound is None else bound.snr
        nearer = None if self.nearness is None else self._nearness(maps)
        if nearer is not None:
            raw = tuple(x + nearer[:, None, None, None] for x in raw)
        if self.full_size and raw[0].shape[-2:] != images.shape[-2:]:
            finest = F.interpolate(raw[0], size=images.shape[-2:], mode="bilinear", align_corners=False)
            raw = (finest, *raw[1:])
        return tuple(torch.sigmoid(x) for x in raw), snr, nearer

    def _nearness(self, maps: list[Tensor]) -> Tensor:
        """(N,)."""
        assert self.nearness is not None
        with torch.autocast(maps[0].device.type, enabled=False):
            means = torch.cat([x.to(self.nearness.weight.dtype).mean((2, 3)) for x in maps], 1)
            number: Tensor = self.nearness(means)[:, 0]
        return number
