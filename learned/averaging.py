"""A running mean of a network's weights: what high learning rates shake, the mean holds still."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class WeightAverage:
    """Exponential moving average of all floating weights and buffers of a module; counters are copied.

    The decay grows as (1 + n) / (10 + n) until it reaches its value, so that the first weights are soon forgotten.

    Args:
        module: whose weights are averaged; its present weights start the mean.
        decay: share of the mean that stays at every update; 0 = the mean is the weights.
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        self.decay, self.updates = decay, 0
        self.values: dict[str, Tensor] = {name: value.detach().clone() for name, value in module.state_dict().items()}

    @torch.no_grad()
    def update(self, module: nn.Module) -> None:
        """Take in the module's present weights."""
        self.updates += 1
        stay = min(self.decay, (1 + self.updates) / (10 + self.updates)) if self.decay else 0.0
        for name, value in module.state_dict().items():
            mean = self.values[name]
            if mean.is_floating_point():
                mean.lerp_(value, 1 - stay)
            else:
                mean.copy_(value)
