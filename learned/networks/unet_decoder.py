"""U-Net decoder over a five-scale encoder, as in Monodepth2 (Godard et al., ICCV 2019) and the methods built on it.

One network serves as depth decoder (1 output), flow decoder (2) and appearance-flow decoder (3): it returns raw maps,
and whoever uses it knows what they mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.networks.encoder import scaled
from vio.errors import ConfigError

Padding = Literal["reflect", "zeros"]

STAGE_CHANNELS = (16, 32, 64, 128, 256)
"""Decoder channels at strides 1, 2, 4, 8, 16."""


class UNetDecoder(nn.Module):
    """Coarse to fine: convolve, enlarge twofold, join the encoder's map, convolve; a head at every wanted scale.

    Args:
        encoder_channels: channels of the encoder's five maps, finest first.
        outputs: channels of every raw map.
        scales: wanted scales; scale s has stride 2**s. Stages finer than the finest scale are not built.
        width: factor on the decoder's channels.
        padding_mode: "reflect" as published (needs maps of at least 2 px), "zeros" is faster.
    """

    def __init__(self, encoder_channels: Sequence[int], outputs: int = 1, scales: Sequence[int] = (0, 1, 2, 3),
                 width: float = 1.0, padding_mode: Padding = "reflect") -> None:
        super().__init__()
        if not scales or not set(scales) <= set(range(len(STAGE_CHANNELS))):
            raise ConfigError(f"decoder scales {tuple(scales)}: must be one or more of 0, 1, 2, 3, 4")
        self.scales = tuple(sorted(scales))
        channels = [scaled(c, width) for c in STAGE_CHANNELS]
        self.reduce, self.merge, self.heads = nn.ModuleDict(), nn.ModuleDict(), nn.ModuleDict()
        inputs = encoder_channels[-1]
        for stage in range(4, self.scales[0] - 1, -1):
            skip = encoder_channels[stage - 1] if stage > 0 else 0
            self.reduce[str(stage)] = _conv(inputs, channels[stage], padding_mode)
            self.merge[str(stage)] = _conv(channels[stage] + skip, channels[stage], padding_mode)
            inputs = channels[stage]
        for scale in self.scales:
            self.heads[str(scale)] = _conv(channels[scale], outputs, padding_mode)

    def forward(self, maps: list[Tensor]) -> tuple[Tensor, ...]:
        """Five maps, finest first → raw maps (N, outputs, H / 2**s, W / 2**s), finest first."""
        x, raw = maps[-1], []
        for stage in range(4, self.scales[0] - 1, -1):
            x = F.interpolate(_elu(self.reduce[str(stage)](x)), scale_factor=2.0, mode="nearest")
            if stage > 0:
                x = torch.cat([x, maps[stage - 1]], 1)
            x = _elu(self.merge[str(stage)](x))
            if stage in self.scales:
                raw.append(self.heads[str(stage)](x))
        return tuple(reversed(raw))

    def start_heads(self, weight_sd: float, bias: float) -> None:
        """Draw the heads' weights from N(0, weight_sd²) and set their bias: where the output starts."""
        for head in self.heads.values():
            if isinstance(head, nn.Conv2d) and head.bias is not None:
                nn.init.normal_(head.weight, 0.0, weight_sd)
                nn.init.constant_(head.bias, bias)


def _elu(x: Tensor) -> Tensor:
    """In place where nothing has to be kept for a gradient."""
    return F.elu(x, inplace=not torch.is_grad_enabled())


def _conv(inputs: int, outputs: int, padding_mode: Padding) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode=padding_mode)
