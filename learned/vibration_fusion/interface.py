"""What a fusion strategy is, and what the paper leaves open about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor, nn

from vio.errors import ConfigError

ACTIVATIONS = ("softplus", "exp", "relu")
SNR_PER = ("block", "channel")
KERNELS = ("channel", "shared", "identity")


class FusedMap(NamedTuple):
    """A block's map after fusion."""

    features: Tensor
    """(N, C, H, W), as it came."""
    snr: Tensor | None
    """(N,) signal-to-noise ratio that the vibration spoke for, mean over channels; None where a strategy has none."""


class VibrationFusion(nn.Module):
    """A strategy at one block: `forward(features (N, C, H, W), vibration (N, D)) -> FusedMap`.

    Every strategy keeps the shape, works at batch 1 in train mode, and treats every sample of a batch alone.
    """


@dataclass(frozen=True)
class FusionConfig:
    """A strategy and its open choices.

    Raises:
        ConfigError: a value outside its range.
    """

    strategy: str = "fourier"
    """fourier, concatenation, summation, gated, aff, iaff or butd."""
    snr_start: float = 10.0
    """SNR of an untrained block. The gain starts at r / (1 + r) = 0.91 and its slope 1 / (1 + r)² at 0.008; at 100 the
    network starts closer to vision alone, but the slope is 1e-4 and the branch was measured not to learn."""
    snr_activation: str = "softplus"
    """softplus never dies; "exp" learns in the log domain, steeper by r; "relu" is the paper's and can die at 0."""
    snr_per: str = "block"
    """One SNR per block and sample, the paper's minimal reading; "channel" gives every channel its own."""
    snr_floor: float = 1e-4
    """Added after softplus and the lower limit of exp: a block always lets something through."""
    snr_ceiling: float = 1e4
    """Upper limit: beyond, the filter is a plain inverse filter and noise explodes where the kernel has zeros."""
    kernel: str = "channel"
    """Information channel h: one kernel per feature channel, or "shared" by all; "identity" leaves a scalar gain, which
    a following batch norm largely cancels. Taking h from the SNR's weights, as the paper's algorithm writes, gives no
    spatial kernel: those weights have no spatial extent."""
    kernel_size: int = 3
    """Odd; kernels start as a delta, so the first step filters nothing."""
    edge_padding: int = 0
    """Cells that the map is continued beyond its border before filtering: 0 accepts that opposite borders touch."""
    attention_reduction: int = 4
    """Bottleneck of the attention in AFF and iAFF, as published."""

    def __post_init__(self) -> None:
        for name, known in (("snr_activation", ACTIVATIONS), ("snr_per", SNR_PER), ("kernel", KERNELS)):
            if getattr(self, name) not in known:
                raise ConfigError(f"fusion {name} {getattr(self, name)!r}: unknown, choose one of {', '.join(known)}")
        if not 0 < self.snr_floor < self.snr_start < self.snr_ceiling:
            raise ConfigError(f"fusion: need 0 < snr_floor < snr_start < snr_ceiling, have {self.snr_floor:g}, "
                              f"{self.snr_start:g}, {self.snr_ceiling:g}")
        if self.kernel_size < 1 or self.kernel_size % 2 == 0:
            raise ConfigError(f"fusion kernel_size {self.kernel_size}: must be odd, so that it has a centre")
        if self.edge_padding < 0 or self.attention_reduction < 1:
            raise ConfigError(f"fusion edge_padding {self.edge_padding}, attention_reduction "
                              f"{self.attention_reduction}: must be at least 0 and 1")
