"""RA-Depth (He et al., ECCV 2022): HRNet depth with dense multi-scale fusion, the same at several resolutions."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from learned.methods.config import MethodConfig
from learned.methods.method import Networks
from learned.methods.parametrisation import DepthRange, PoseParametrisation
from learned.networks.depth_network import DepthNetwork
from learned.networks.fusion_decoder import FusionDecoder
from learned.networks.hrnet import HRNetEncoder
from learned.networks.pair_network import ResNetPoseNetwork
from learned.networks.pretrained import load_encoder


@dataclass(frozen=True, kw_only=True)
class RaDepthConfig(MethodConfig):
    """Its published values."""

    name: ClassVar[str] = "ra-depth"

    layers: int = 18
    """Of the pose ResNet."""
    image_size: tuple[int, int] = (192, 640)
    """Published, for a car's camera; the network takes any size."""
    depth_range: DepthRange = field(default_factory=lambda: DepthRange(0.1, 100.0))
    """Published."""
    pose: PoseParametrisation = field(
        default_factory=lambda: PoseParametrisation("vector", "rotation_first", 0.01, "temporal"))
    """Published: always in the order of time, inverted where the other direction is wanted."""
    depth_frames: tuple[int, ...] = (1,)
    """The target's, in three views that training makes."""
    pairs: tuple[tuple[int, int], ...] = ((0, 1), (2, 1))
    """Source and target."""


def networks(config: RaDepthConfig, weights: str | Path | None,
             pose_weights: str | Path | None = None) -> Networks:
    """The vision networks; `weights` fill the HRNet, `pose_weights` the pose ResNet."""
    encoder = HRNetEncoder(config.width)
    decoder = FusionDecoder(encoder.channels, config.width)
    pose = ResNetPoseNetwork(config.layers, 12, config.width)
    if weights is not None:
        load_encoder(encoder, weights)
    if pose_weights is not None:
        load_encoder(pose.encoder, pose_weights)
    return Networks(DepthNetwork(encoder, decoder), pose)
