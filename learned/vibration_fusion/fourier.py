"""Fourier heterogeneous fusion: the paper's Wiener filter, with an SNR that the vibration tells (its equations 4 to 6).

A map F is taken for a clean map F' blurred by a kernel h, plus noise. The paper's filter H* / (|H|² + 1 / SNR) divides
by an SNR that is 0 for about half of all random inputs; multiplied by SNR it is

    F' = IFFT{ FFT(F) · r H* / (r |H|² + 1) },    r = SNR,

equal for r > 0, and finite with finite derivatives at r = 0, where nothing of the map is believed.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.vibration_fusion.interface import FusedMap, FusionConfig, VibrationFusion


def transfer_function(kernel: Tensor, height: int, width: int) -> Tensor:
    """Spectrum of kernels whose centre tap lies at the origin, on the half-plane that `rfft2` uses.

    The taps are summed directly, so a kernel larger than the map wraps around it like the map itself.

    Args:
        kernel: (C, k, k), k odd.
        height: H of the map.
        width: W of the map.

    Returns:
        (C, H, W // 2 + 1), complex.
    """
    reach = kernel.shape[-1] // 2
    taps = torch.arange(-reach, reach + 1, dtype=kernel.dtype, device=kernel.device)
    v = torch.arange(height, dtype=kernel.dtype, device=kernel.device) / height
    u = torch.arange(width // 2 + 1, dtype=kernel.dtype, device=kernel.device) / width
    rows = torch.polar(torch.ones_like(v[:, None] * taps), -2 * math.pi * v[:, None] * taps)
    columns = torch.polar(torch.ones_like(taps[:, None] * u), -2 * math.pi * taps[:, None] * u)
    spectrum: Tensor = rows @ kernel.to(rows.dtype) @ columns
    return spectrum


def wiener_filter(features: Tensor, kernel: Tensor | None, snr: Tensor) -> Tensor:
    """Deconvolve maps by a kernel as far as their SNR allows.

    Args:
        features: (N, C, H, W), float32 or float64.
        kernel: (C, k, k) or (1, k, k), k odd; None = a delta.
        snr: (N, C) or (N, 1), not negative.

    Returns:
        (N, C, H, W).
    """
    r = snr[..., None, None]
    if kernel is None:
        return features * (r / (r + 1))
    height, width = features.shape[-2:]
    H = transfer_function(kernel, height, width)
    weight = r / (r * (H.real**2 + H.imag**2) + 1)
    gain = torch.complex(H.real * weight, -H.imag * weight)  # real products: complex division costs twice the time
    filtered: Tensor = torch.fft.irfft2(torch.fft.rfft2(features) * gain, s=(height, width))
    return filtered


class FourierFusion(VibrationFusion):
    """The filter at one block; the SNR is a linear map of the vibration's features, the kernel is learned.

    Computes in float32 inside autocast: half-precision FFTs know only few sizes. An SNR means what it says where the
    kernel passes signals unamplified: a kernel of gain c and an SNR of r / c² give the same filter up to a factor.
    """

    def __init__(self, channels: int, vibration_features: int, config: FusionConfig) -> None:
        super().__init__()
        self.config = config
        self.snr_head = nn.Linear(vibration_features, channels if config.snr_per == "channel" else 1)
        nn.init.constant_(self.snr_head.bias, _before_activation(config))
        self.kernel: nn.Parameter | None = None
        if config.kernel != "identity":
            delta = torch.zeros(channels if config.kernel == "channel" else 1, config.kernel_size, config.kernel_size)
            delta[:, config.kernel_size // 2, config.kernel_size // 2] = 1
            self.kernel = nn.Parameter(delta)

    def forward(self, features: Tensor, vibration: Tensor) -> FusedMap:
        """(N, C, H, W) and (N, D) → the filtered map and its SNR (N,)."""
        with torch.autocast(features.device.type, enabled=False):
            work = features.to(self.snr_head.weight.dtype)
            snr = self.snr(vibration.to(self.snr_head.weight.dtype))
            margin = self.config.edge_padding
            if margin:
                work = F.pad(work, (margin,) * 4, mode="replicate")
            out = wiener_filter(work, self.kernel, snr)
            if margin:
                out = out[..., margin:-margin, margin:-margin]
        return FusedMap(out.to(features.dtype), snr.mean(1))

    def snr(self, vibration: Tensor) -> Tensor:
        """(N, D) → SNR (N, 1) or (N, C)."""
        raw: Tensor = self.snr_head(vibration)
        low, high = self.config.snr_floor, self.config.snr_ceiling
        if self.config.snr_activation == "exp":
            return torch.exp(raw.clamp(math.log(low), math.log(high)))
        if self.config.snr_activation == "relu":
            return F.relu(raw).clamp(max=high)
        return (F.softplus(raw) + low).clamp(max=high)


def _before_activation(config: FusionConfig) -> float:
    """The bias at which the activation gives `snr_start`."""
    start = config.snr_start
    if config.snr_activation == "exp":
        return math.log(start)
    if config.snr_activation == "relu":
        return start
    above = start - config.snr_floor
    return above + math.log(-math.expm1(-above))
