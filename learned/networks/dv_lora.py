"""DV-LoRA (EndoDAC, Cui et al., 2024): a frozen linear layer and a low-rank update whose factors are scaled by vectors.

    y = W x + b + (B ⊙ V) (A ⊙ U) x

A and B hold the directions, U (one number per rank) and V (one per output) the magnitudes. B starts at zero, so the
layer starts as the frozen one.
"""

from __future__ import annotations

import math

import torch.nn.functional as F
from torch import Tensor, nn

RANK = 4


class DvLoraLinear(nn.Module):
    """A linear layer with its update; `weight` and `bias` keep the names of the layer it replaces.

    Args:
        frozen: the layer to start from; its tensors are shared, not copied.
        rank: of the update.
    """

    def __init__(self, frozen: nn.Linear, rank: int = RANK) -> None:
        super().__init__()
        self.weight, self.bias = frozen.weight, frozen.bias
        outputs, inputs = frozen.weight.shape
        self.lora_A = nn.Parameter(frozen.weight.new_empty(rank, inputs))
        self.lora_B = nn.Parameter(frozen.weight.new_zeros(outputs, rank))
        self.lora_U = nn.Parameter(frozen.weight.new_empty(rank, 1))
        self.lora_V = nn.Parameter(frozen.weight.new_empty(outputs, 1))
        for factor in (self.lora_A, self.lora_U, self.lora_V):
            nn.init.kaiming_uniform_(factor, a=math.sqrt(5))

    def forward(self, x: Tensor) -> Tensor:
        """(…, inputs) → (…, outputs)."""
        update = F.linear(F.linear(x, self.lora_A * self.lora_U), self.lora_B * self.lora_V)
        return F.linear(x, self.weight, self.bias) + update
