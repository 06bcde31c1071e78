"""Networks that look at pairs of images: what a pose network returns, the ResNet that the four methods use, flow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from learned.networks.encoder import scaled
from learned.networks.pose_decoder import PoseDecoder
from learned.networks.resnet import ResNetEncoder, pair_of
from learned.networks.spatial_attention import SpatialAttention
from learned.networks.unet_decoder import UNetDecoder
from learned.vibration_fusion import EncoderFusion, FusionConfig

Pairs = Sequence[tuple[int, int]]
"""Numbers of the frames that a network sees first and second."""

MAPS_PER_SCALE = (0, 1, 2, 3)
FLOW_START_SD = 1e-5


class PairMotion(NamedTuple):
    """What a pose network says about P pairs of each of B snippets."""

    raw: Tensor
    """(B, P, 6) numbers before they are scaled and read as a motion."""
    coarsest: Tensor | None
    """(B, P, C, h, w) the encoder's last map, for a head on top of it."""
    hidden: Tensor | None
    """(B, P, C', h, w) the decoder's last hidden map."""
    snr: Tensor | None
    """(B, P, blocks) signal-to-noise ratio; None without one."""


class PairNetwork(nn.Module):
    """`forward(frames (B, F, 3, H, W), pairs, vibration (B, P, D) or None) -> PairMotion`."""

    fusion: EncoderFusion | None
    fused_channels: tuple[int, ...]
    """Channels of every block that is fused."""

    def __init__(self) -> None:
        super().__init__()
        self.fusion = None

    def add_fusion(self, config: FusionConfig, vibration_features: int) -> None:
        """Fuse vibration of `vibration_features` numbers after every block of the encoder."""
        self.fusion = EncoderFusion(config, self.fused_channels, vibration_features)


class ResNetPoseNetwork(PairNetwork):
    """Both images stacked as six channels, a ResNet, and the common pose decoder.

    Args:
        layers: of the ResNet.
        outputs: 6, or 12 of which the first 6 are used, as in Monodepth2 and its descendants.
        width: factor on all channels.
        attention: "transpose" or "reshape" spatial attention after the stem; None without.
    """

    def __init__(self, layers: int = 18, outputs: int = 6, width: float = 1.0, attention: str | None = None) -> None:
        super().__init__()
        block = None if attention is None else SpatialAttention(scaled(64, width), attention)
        self.encoder = ResNetEncoder(layers, images=2, width=width, after_stem=block)
        self.decoder = PoseDecoder(self.encoder.channels[-1], outputs, width)
        self.fused_channels = self.encoder.channels

    def forward(self, frames: Tensor, pairs: Pairs, vibration: Tensor | None) -> PairMotion:
        """Motions of pairs of frames (B, F, 3, H, W) in 0..1, each pair in the order given."""
        count = (len(frames), len(pairs))
        first, second = [a for a, _ in pairs], [b for _, b in pairs]
        images = pair_of(frames[:, first].flatten(0, 1), frames[:, second].flatten(0, 1))
        if self.fusion is None or vibration is None:
            maps, snr = self.encoder(images), None
        else:
            bound = self.fusion.bind(vibration.flatten(0, 1))
            maps = self.encoder(images, bound)
            snr = None if bound.snr is None else torch.unflatten(bound.snr, 0, count)
        raw, hidden = self.decoder(maps[-1])
        return PairMotion(torch.unflatten(raw[:, :6], 0, count), torch.unflatten(maps[-1], 0, count),
                          torch.unflatten(hidden, 0, count), snr)


class FlowNetwork(nn.Module):
    """Two images → a raw map of `outputs` channels at four scales: AF-SfMLearner's optical and appearance flow.

    Optical flow (2 outputs) starts at zero and is unbounded, in pixels; appearance flow (3) is bounded by tanh.

    Args:
        outputs: 2 or 3.
        width: factor on all channels.
    """

    def __init__(self, outputs: int, width: float = 1.0) -> None:
        super().__init__()
        self.bounded = outputs == 3
        self.encoder = ResNetEncoder(18, images=2, width=width)
        self.decoder = UNetDecoder(self.encoder.channels, outputs, MAPS_PER_SCALE, width)
        if not self.bounded:
            self.decoder.start_heads(FLOW_START_SD, 0.0)

    def forward(self, first: Tensor, second: Tensor) -> tuple[Tensor, ...]:
        """(N, 3, H, W) twice → (N, outputs, H / 2**s, W / 2**s) for s = 0..3."""
        raw: tuple[Tensor, ...] = self.decoder(self.encoder(pair_of(first, second)))
        return tuple(torch.tanh(x) for x in raw) if self.bounded else raw
