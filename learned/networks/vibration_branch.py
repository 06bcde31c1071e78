"""The vibration branch: a multivariate LSTM-FCN (Karim et al., Neural Networks 2019, arXiv 1801.04503).

The paper calls it "MLSTM" and describes an LSTM sub-branch, a squeeze-and-excite sub-branch and their concatenation:
that is this network, not Krause's multiplicative LSTM cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.errors import NetworkInputError
from vio.errors import ConfigError

FILTERS, KERNELS = (128, 256, 128), (8, 5, 3)
SQUEEZE = 16


@dataclass(frozen=True)
class BranchConfig:
    """What the article or the paper leaves open about the branch."""

    hidden: int = 8
    """Width of the LSTM. 8 in nearly all published models of the article; 64 and 128 occur."""
    dropout: float = 0.8
    """Of the LSTM's output, as published: the FCN half carries the features, the LSTM half regularises."""
    shuffle: bool = True
    """Variables are the LSTM's steps and samples its features, as the article does when there are more samples than
    variables (40 > 6 here)."""
    variables: int = 6
    """Gyro xyz [rad/s] and specific force xyz [m/s²]."""
    samples: int = 40
    """One second at 40 Hz."""

    def __post_init__(self) -> None:
        if min(self.hidden, self.variables, self.samples) < 1 or not 0 <= self.dropout < 1:
            raise ConfigError(f"vibration branch: {self}; sizes must be at least 1 and dropout in [0, 1)")


class VibrationBranch(nn.Module):
    """IMU windows (N, 6, 40) in SI units → features (N, 128 + hidden).

    The windows are normalised per channel by a mean and a deviation that lie in the weights.
    """

    mean: Tensor
    sd: Tensor

    def __init__(self, config: BranchConfig | None = None) -> None:
        super().__init__()
        config = BranchConfig() if config is None else config
        self.config = config
        self.features = FILTERS[-1] + config.hidden
        self.register_buffer("mean", torch.zeros(config.variables))
        self.register_buffer("sd", torch.ones(config.variables))
        channels = (config.variables, *FILTERS)
        self.conv = nn.ModuleList(nn.Conv1d(i, o, k) for i, o, k in zip(channels[:-1], FILTERS, KERNELS, strict=True))
        self.norm = nn.ModuleList(nn.BatchNorm1d(o) for o in FILTERS)
        self.excite = nn.ModuleList(SqueezeExcite(o) for o in FILTERS[:-1])
        self.lstm = nn.LSTM(config.samples if config.shuffle else config.variables, config.hidden, batch_first=True)
        self.dropout = nn.Dropout(config.dropout)
        self._initialise()

    def forward(self, windows: Tensor) -> Tensor:
        """Features of windows (N, variables, samples), in float32 whatever autocast says.

        Raises:
            NetworkInputError: windows of another shape.
        """
        wanted = (self.config.variables, self.config.samples)
        if windows.ndim != 3 or tuple(windows.shape[1:]) != wanted:
            raise NetworkInputError(f"vibration has shape {tuple(windows.shape)}, expected (N, {wanted[0]}, "
                                    f"{wanted[1]}): gyro xyz [rad/s] and specific force xyz [m/s²] by samples at 40 Hz")
        with torch.autocast(windows.device.type, enabled=False):
            x = (windows.to(self.mean.dtype) - self.mean[:, None]) / self.sd[:, None]
            return torch.cat([self._recurrent(x), self._convolutional(x)], 1)

    def fit_normalisation(self, windows: Tensor) -> None:
        """Set mean and deviation of every channel from training windows (N, variables, samples).

        Raises:
            ConfigError: a channel that is constant or not finite.
        """
        sd, mean = torch.std_mean(windows.double(), dim=(0, 2), correction=0)
        wrong = ~(torch.isfinite(mean) & (sd > 0))
        if wrong.any():
            k = int(torch.argmax(wrong.int()))
            raise ConfigError(f"vibration channel {k}: mean {float(mean[k]):g}, deviation {float(sd[k]):g} over "
                              f"{len(windows)} windows; must be finite and vary, check the IMU log")
        self.mean.copy_(mean)
        self.sd.copy_(sd)

    def _convolutional(self, x: Tensor) -> Tensor:
        for k, (conv, norm) in enumerate(zip(self.conv, self.norm, strict=True)):
            pad = KERNELS[k] - 1
            x = F.relu(norm(conv(F.pad(x, (pad // 2, pad - pad // 2)))))
            if k < len(self.excite):
                x = self.excite[k](x)
        return x.mean(-1)

    def _recurrent(self, x: Tensor) -> Tensor:
        last: Tensor = self.lstm(x if self.config.shuffle else x.transpose(1, 2))[1][0][0]
        out: Tensor = self.dropout(last)
        return out

    def _initialise(self) -> None:
        """As in the article's framework: He-uniform convolutions; Glorot, orthogonal and forget bias 1 in the LSTM."""
        for conv in self.conv:
            if isinstance(conv, nn.Conv1d) and conv.bias is not None:
                nn.init.kaiming_uniform_(conv.weight, nonlinearity="relu")
                nn.init.zeros_(conv.bias)
        from_input, from_state, bias, second_bias = self.lstm.all_weights[0]
        nn.init.xavier_uniform_(from_input)
        for gate in from_state.chunk(4):
            nn.init.orthogonal_(gate)
        nn.init.zeros_(bias)
        nn.init.zeros_(second_bias)
        nn.init.ones_(bias[self.config.hidden:2 * self.config.hidden])


class SqueezeExcite(nn.Module):
    """Channels weighted by what their means say (Hu et al., CVPR 2018); no biases, ratio 16."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.squeeze = nn.Linear(channels, channels // SQUEEZE, bias=False)
        self.excite = nn.Linear(channels // SQUEEZE, channels, bias=False)
        nn.init.kaiming_normal_(self.squeeze.weight, nonlinearity="relu")
        nn.init.kaiming_normal_(self.excite.weight, nonlinearity="relu")

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, samples) → same shape."""
        weights: Tensor = torch.sigmoid(self.excite(F.relu(self.squeeze(x.mean(-1)))))
        return x * weights[..., None]
