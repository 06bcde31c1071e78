"""A strategy after every block of an encoder."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from learned.vibration_fusion.attentional import AttentionalFusion, IterativeAttentionalFusion
from learned.vibration_fusion.bottom_up import BottomUpTopDown
from learned.vibration_fusion.fourier import FourierFusion
from learned.vibration_fusion.interface import FusedMap, FusionConfig, VibrationFusion
from learned.vibration_fusion.pointwise import Concatenation, Gated, Summation
from vio.errors import ConfigError

STRATEGIES: dict[str, Callable[[int, int, FusionConfig], VibrationFusion]] = {
    "fourier": FourierFusion,
    "concatenation": lambda channels, features, config: Concatenation(channels, features),
    "summation": lambda channels, features, config: Summation(channels, features),
    "gated": lambda channels, features, config: Gated(channels, features),
    "aff": AttentionalFusion,
    "iaff": IterativeAttentionalFusion,
    "butd": lambda channels, features, config: BottomUpTopDown(channels, features),
}
"""Name → how to build it for a block from (channels, vibration features, config)."""


class EncoderFusion(nn.Module):
    """One strategy at every block of one encoder.

    Args:
        config: which strategy, and its open choices.
        channels: of the encoder's blocks.
        vibration_features: D of the vibration branch.

    Raises:
        ConfigError: an unknown strategy.
    """

    def __init__(self, config: FusionConfig, channels: Sequence[int], vibration_features: int) -> None:
        super().__init__()
        if config.strategy not in STRATEGIES:
            raise ConfigError(f"fusion strategy {config.strategy!r}: unknown, choose one of {', '.join(STRATEGIES)}")
        build = STRATEGIES[config.strategy]
        self.blocks = nn.ModuleList(build(c, vibration_features, config) for c in channels)

    def bind(self, vibration: Tensor) -> BoundFusion:
        """The fusion of one pass of the encoder, with the features (N, D) of its N images."""
        return BoundFusion(self.blocks, vibration)


class BoundFusion:
    """Called by the encoder after every block; collects the SNRs on the way."""

    def __init__(self, blocks: nn.ModuleList, vibration: Tensor) -> None:
        self._blocks, self._vibration = blocks, vibration
        self._snr: list[Tensor] = []

    def __call__(self, block: int, features: Tensor) -> Tensor:
        """(N, C, H, W) of block number `block` → same shape."""
        fused: FusedMap = self._blocks[block](features, self._vibration)
        if fused.snr is not None:
            self._snr.append(fused.snr)
        return fused.features

    @property
    def snr(self) -> Tensor | None:
        """(N, blocks) SNR per block of the pass, in the order of the blocks; None where the strategy has none."""
        return torch.stack(self._snr, 1) if self._snr else None
