"""EndoSfMLearner (Ozyoruk et al., Medical Image Analysis 2021): ResNet U-Net depth, attentive ResNet pose."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from learned.methods.config import MethodConfig
from learned.methods.method import Networks
from learned.methods.parametrisation import DepthRange, PoseParametrisation
from learned.networks.depth_network import DepthNetwork
from learned.networks.pair_network import ResNetPoseNetwork
from learned.networks.pretrained import load_encoder
from learned.networks.resnet import ResNetEncoder
from learned.networks.unet_decoder import UNetDecoder


@dataclass(frozen=True, kw_only=True)
class EndoSfMLearnerConfig(MethodConfig):
    """Its published values."""

    name: ClassVar[str] = "endosfmlearner"

    layers: int = 18
    """Of both ResNets."""
    attention: str = "transpose"
    """Spatial attention in the pose encoder. "reshape" is the published layout, which mixes unrelated pixels."""
    scales: tuple[int, ...] = (0, 1, 2, 3)
    """Depth heads. Published: four, of which training uses the finest."""
    image_size: tuple[int, int] = (320, 320)
    """The published training does not resize; 320 x 320 are the frames of its capsule simulator."""
    depth_range: DepthRange = field(default_factory=lambda: DepthRange(1 / 10.01, 100.0))
    """depth = 1 / (10 s + 0.01)."""
    pose: PoseParametrisation = field(
        default_factory=lambda: PoseParametrisation("euler_xyz", "translation_first", 0.01, "j_then_i"))
    """Published: the network sees target, then reference, and maps points of the target to the reference."""
    depth_frames: tuple[int, ...] = (0, 1, 2)
    """All: the geometry loss compares depths."""
    pairs: tuple[tuple[int, int], ...] = ((0, 1), (1, 0), (1, 2), (2, 1))
    """Target and both references, in both directions."""


def networks(config: EndoSfMLearnerConfig, weights: str | Path | None) -> Networks:
    """The vision networks; `weights` fill both ResNets."""
    encoder = ResNetEncoder(config.layers, width=config.width)
    decoder = UNetDecoder(encoder.channels, 1, config.scales, config.width)
    pose = ResNetPoseNetwork(config.layers, 6, config.width, config.attention)
    if weights is not None:
        load_encoder(encoder, weights)
        load_encoder(pose.encoder, weights)
    return Networks(DepthNetwork(encoder, decoder), pose)
