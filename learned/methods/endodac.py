"""EndoDAC (Cui et al., MICCAI 2024): an adapted vision transformer for depth, and AF-SfMLearner's rest."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from learned.methods.af_sfmlearner import flow_networks
from learned.methods.config import MethodConfig
from learned.methods.method import Networks
from learned.methods.parametrisation import DepthRange, PoseParametrisation
from learned.networks.depth_network import DepthNetwork
from learned.networks.dinov2 import HEADS, DinoEncoder, DinoShape
from learned.networks.dpt_head import DptHead
from learned.networks.encoder import scaled
from learned.networks.intrinsics_head import IntrinsicsHead
from learned.networks.pair_network import ResNetPoseNetwork
from learned.networks.pretrained import load_encoder
from vio.errors import ConfigError

FEATURES_PER_CHANNEL, LEVELS_PER_CHANNEL = 1 / 6, (1 / 8, 1 / 4, 1 / 2, 1)
"""Of the head, by the transformer's channels: 128 and 96, 192, 384, 768 for the base transformer."""


@dataclass(frozen=True, kw_only=True)
class EndoDacConfig(MethodConfig):
    """Its published values."""

    name: ClassVar[str] = "endodac"

    transformer: str = "base"
    """"base" or "small" DINOv2; `width` scales its number of heads."""
    taps: tuple[int, ...] = (2, 5, 8, 11)
    """Four blocks that the head reads and that are fused. (8, 9, 10, 11) is what the published code asks for."""
    necks: tuple[int, ...] = (2, 5, 8, 11)
    """Blocks that a convolutional bottleneck follows."""
    train_transformer: bool = False
    """Published: the transformer and the head's pyramid stay frozen, which needs pretrained weights. True trains all
    and is for a start at random."""
    flows: bool = True
    """Build AF-SfMLearner's flow networks. Only training needs them."""
    intrinsics: bool = True
    """Estimate K from the pose network."""
    intrinsics_from: str = "encoder"
    """Which features K is read from. The published code builds a layer for the pose encoder's, then reads the decoder's
    and leaves the layer idle: "decoder" does so without the layer."""
    layers: int = 18
    """Of the pose ResNet."""
    image_size: tuple[int, int] = (256, 320)
    """Published; the transformer sees 14/16 of it, 224 x 280."""
    depth_range: DepthRange = field(default_factory=lambda: DepthRange(0.1, 150.0))
    """Published."""
    pose: PoseParametrisation = field(
        default_factory=lambda: PoseParametrisation("vector", "rotation_first", 0.001, "i_then_j"))
    """As AF-SfMLearner."""
    depth_frames: tuple[int, ...] = (1,)
    """The target's."""
    pairs: tuple[tuple[int, int], ...] = ((0, 1), (2, 1))
    """Source and target."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.transformer not in HEADS:
            raise ConfigError(f"transformer {self.transformer!r}: unknown, choose one of {', '.join(HEADS)}")
        if self.intrinsics_from not in ("encoder", "decoder"):
            raise ConfigError(f"intrinsics_from {self.intrinsics_from!r}: unknown, choose 'encoder' or 'decoder'")
        if len(self.taps) != len(LEVELS_PER_CHANNEL) or list(self.taps) != sorted(set(self.taps)):
            raise ConfigError(f"taps {self.taps}: the head reads four different blocks, in order")


def networks(config: EndoDacConfig, weights: str | Path | None,
             pose_weights: str | Path | None = None) -> Networks:
    """The vision networks; `weights` is a local folder of the transformer, `pose_weights` fill all ResNets."""
    shape = DinoShape(scaled(HEADS[config.transformer], config.width), config.taps, config.necks)
    encoder = DinoEncoder(shape, weights, frozen=not config.train_transformer)
    levels = [scaled(shape.channels, part) for part in LEVELS_PER_CHANNEL]
    head = DptHead(shape.channels, scaled(shape.channels, FEATURES_PER_CHANNEL), levels)
    if not config.train_transformer:
        head.requires_grad_(False)
        head.heads.requires_grad_(True)
    pose = ResNetPoseNetwork(config.layers, 12, config.width)
    if pose_weights is not None:
        load_encoder(pose.encoder, pose_weights)
    optical, appearance = flow_networks(config.width, pose_weights) if config.flows else (None, None)
    return Networks(DepthNetwork(encoder, head), pose, optical, appearance, _intrinsics(config, pose),
                    config.intrinsics_from)


def _intrinsics(config: EndoDacConfig, pose: ResNetPoseNetwork) -> IntrinsicsHead | None:
    if not config.intrinsics:
        return None
    if config.intrinsics_from == "encoder":
        return IntrinsicsHead(pose.fused_channels[-1], squeeze=True, width=config.width)
    return IntrinsicsHead(pose.decoder.hidden_channels, squeeze=False)
