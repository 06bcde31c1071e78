"""Gyro-correlation, our own method: a compact U-Net for depth, local correlation for motion.

In training the rotation of the warp comes from the integrated gyro, the rotation head learns from the gyro, and the
translation from the images alone; the network then gives both without an IMU too. One motion unit is meant to be 20 mm,
so that the range of depth is 2 to 80 mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from learned.methods.config import MethodConfig
from learned.methods.method import Networks
from learned.methods.parametrisation import DepthRange, PoseParametrisation
from learned.networks.correlation_pose import CorrelationPoseNetwork
from learned.networks.depth_network import DepthNetwork
from learned.networks.encoder import scaled
from learned.networks.pretrained import load_encoder
from learned.networks.resnet import ResNetEncoder
from learned.networks.unet_decoder import UNetDecoder

BASE, PUBLISHED_BASE = 32, 64
"""Channels of the first layer at width 1, and of the published ResNet."""
START_DEPTH, HEAD_START_SD = 1.0, 0.01
"""An untrained network predicts one unit everywhere, in the middle of the sigmoid's slope."""


@dataclass(frozen=True, kw_only=True)
class GyroCorrelationConfig(MethodConfig):
    """The measured recipe."""

    name: ClassVar[str] = "gyro-correlation"

    layers: int = 18
    """Of the depth ResNet, at half the published width (`width` 2 is the published one)."""
    radius: int = 4
    """Cells that a match may lie away."""
    correlation_maps: int = 3
    """Of a quarter, an eighth and a sixteenth of the image's resolution: reach 16, 32 and 64 px at radius 4."""
    image_size: tuple[int, int] = (128, 128)
    """Measured to train well; larger for finer detail."""
    whole_image: bool = True
    """One number per image, of the encoder's mean features, says how near everything is."""
    depth_range: DepthRange = field(default_factory=lambda: DepthRange(0.1, 4.0))
    """Units of 20 mm."""
    pose: PoseParametrisation = field(
        default_factory=lambda: PoseParametrisation("vector", "rotation_first", 0.01, "i_then_j", in_depths=True))
    """Features of camera i are correlated with those of j, so the motion is told in camera i's axes. At a scale of 0.1
    one step of Adam at 1e-3 may move the sum over 4096 weights of the head by more than a motion."""
    depth_frames: tuple[int, ...] = (0, 1, 2)
    """All: the geometry loss compares depths, and its weight was measured to matter most."""
    pairs: tuple[tuple[int, int], ...] = ((0, 1), (1, 0), (1, 2), (2, 1))
    """All four directed neighbours."""


def networks(config: GyroCorrelationConfig, weights: str | Path | None) -> Networks:
    """The vision networks; `weights` fill the depth ResNet, which they fit at width 2."""
    base = scaled(BASE, config.width)
    relative = base / PUBLISHED_BASE
    encoder = ResNetEncoder(config.layers, width=relative)
    decoder = UNetDecoder(encoder.channels, 1, (1,), relative, padding_mode="zeros")
    start = config.depth_range.disparity(START_DEPTH)
    decoder.start_heads(HEAD_START_SD, _logit(start))
    if weights is not None:
        load_encoder(encoder, weights)
    pose = CorrelationPoseNetwork(base, config.radius, config.correlation_maps)
    return Networks(DepthNetwork(encoder, decoder, full_size=True, whole_image=config.whole_image), pose)


def _logit(value: float) -> float:
    return math.log(value / (1 - value))
