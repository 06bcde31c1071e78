"""AF-SfMLearner (Shao et al., Medical Image Analysis 2022): depth and pose; training adds optical and appearance flow.

Appearance flow is what lighting adds to one image to look like the other; the photometric loss compares with the target
so corrected.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from learned.methods.config import MethodConfig
from learned.methods.method import Networks
from learned.methods.parametrisation import DepthRange, PoseParametrisation
from learned.networks.depth_network import DepthNetwork
from learned.networks.pair_network import FlowNetwork, ResNetPoseNetwork
from learned.networks.pretrained import load_encoder
from learned.networks.resnet import ResNetEncoder
from learned.networks.unet_decoder import UNetDecoder


@dataclass(frozen=True, kw_only=True)
class AfSfMLearnerConfig(MethodConfig):
    """Its published values."""

    name: ClassVar[str] = "af-sfmlearner"

    layers: int = 18
    """Of the depth and pose ResNets."""
    flows: bool = True
    """Build the two flow networks. Only training needs them."""
    scales: tuple[int, ...] = (0, 1, 2, 3)
    """Depth heads, all used in training."""
    image_size: tuple[int, int] = (256, 320)
    """Published."""
    depth_range: DepthRange = field(default_factory=lambda: DepthRange(0.1, 150.0))
    """Published."""
    pose: PoseParametrisation = field(
        default_factory=lambda: PoseParametrisation("vector", "rotation_first", 0.001, "i_then_j"))
    """Published: the network sees source, then target, and maps points of the target to the source."""
    depth_frames: tuple[int, ...] = (1,)
    """The target's: there is no geometry loss."""
    pairs: tuple[tuple[int, int], ...] = ((0, 1), (2, 1))
    """Source and target."""


def networks(config: AfSfMLearnerConfig, weights: str | Path | None) -> Networks:
    """The vision networks; `weights` fill all ResNets."""
    encoder = ResNetEncoder(config.layers, width=config.width)
    decoder = UNetDecoder(encoder.channels, 1, config.scales, config.width)
    pose = ResNetPoseNetwork(config.layers, 12, config.width)
    if weights is not None:
        load_encoder(encoder, weights)
        load_encoder(pose.encoder, weights)
    optical, appearance = flow_networks(config.width, weights) if config.flows else (None, None)
    return Networks(DepthNetwork(encoder, decoder), pose, optical, appearance)


def flow_networks(width: float, weights: str | Path | None) -> tuple[FlowNetwork, FlowNetwork]:
    """Optical flow and appearance flow, both with 18 layers."""
    optical, appearance = FlowNetwork(2, width), FlowNetwork(3, width)
    if weights is not None:
        load_encoder(optical.encoder, weights)
        load_encoder(appearance.encoder, weights)
    return optical, appearance
