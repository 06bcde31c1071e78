"""RA-Depth's decoder (He et al., ECCV 2022): dense multi-scale fusion by sums.

In every round each resolution is convolved and receives all coarser ones, brought to its channels and size. A round has
one resolution less than the one before; the last two convolutions work at strides 2 and 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor, nn

from learned.networks.encoder import scaled

FINAL_CHANNELS = (32, 16)
COARSEST = 4
"""Number of the coarsest map."""


class FusionDecoder(nn.Module):
    """Maps at strides 2, 4, 8, 16, 32 → one raw map at full size.

    Args:
        encoder_channels: channels of the five maps, finest first; 64, 18, 36, 72, 144 give 416,589 parameters.
        width: factor on the channels of the last two convolutions; the others follow the encoder.
        outputs: channels of the raw map.
    """

    def __init__(self, encoder_channels: Sequence[int], width: float = 1.0, outputs: int = 1) -> None:
        super().__init__()
        channels = list(encoder_channels)
        self.same, self.join = nn.ModuleDict(), nn.ModuleDict()
        for turn, levels in enumerate(_rounds()):
            for level in levels:
                self.same[f"{turn}_{level}"] = _same_size(channels[level], channels[level])
            for source in levels:
                for target in (k for k in levels if k < source):
                    self.join[f"{turn}_{source}_{target}"] = nn.Conv2d(channels[source], channels[target], 1)
        middle, fine = (scaled(c, width) for c in FINAL_CHANNELS)
        self.at_half, self.at_full = _same_size(channels[0], middle), _same_size(middle, fine)
        self.head = _same_size(fine, outputs)

    def forward(self, maps: list[Tensor]) -> tuple[Tensor, ...]:
        """Five maps, finest first → (N, outputs, H, W), alone in a tuple."""
        held = dict(enumerate(maps))
        for turn, levels in enumerate(_rounds()):
            held |= {level: F.elu(self.same[f"{turn}_{level}"](held[level])) for level in levels}
            held |= {level: self._joined(turn, level, levels, held) for level in levels if level < levels[-1]}
        x = _twice(F.elu(self.at_half(held[0])))
        return (self.head(F.elu(self.at_full(x))),)

    def _joined(self, turn: int, target: int, levels: Sequence[int], held: dict[int, Tensor]) -> Tensor:
        """A 1x1 convolution commutes with enlarging by repetition, so it runs on the small map."""
        total = held[target]
        for source in (k for k in levels if k > target):
            step = F.elu(self.join[f"{turn}_{source}_{target}"](held[source]))
            total = total + F.interpolate(step, scale_factor=2.0 ** (source - target), mode="nearest")
        return total


def _rounds() -> list[range]:
    """Levels that take part in every round: 1..4, 1..3, 1..2, 0..1."""
    return [range(1, COARSEST + 1), range(1, COARSEST), range(1, COARSEST - 1), range(0, 2)]


def _same_size(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode="reflect")


def _twice(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="nearest")
