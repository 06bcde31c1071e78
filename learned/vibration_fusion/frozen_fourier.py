"""The Wiener filter of one block for prediction: what depends on the kernel alone is computed once per size of map."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from learned.vibration_fusion.fourier import FourierFusion, transfer_function
from learned.vibration_fusion.interface import FusedMap, VibrationFusion

AT_ONCE = 2**18
"""Numbers filtered at once: spectra that stay in a processor's cache take two thirds of the time."""


class FrozenFourier(VibrationFusion):
    """`FourierFusion` with a kernel, in eval mode: equal up to rounding, no gradients.

    F' = IFFT{ FFT(F) · H* / (|H|² + 1 / r) } is the same filter for r > 0; where r = 0, 1 / r is infinite and
    nothing passes, as there.
    """

    def __init__(self, fusion: FourierFusion) -> None:
        super().__init__()
        assert fusion.kernel is not None, "a fusion without a kernel has no spectrum"
        self.fusion = fusion
        self._spectra: dict[tuple[int, int, torch.device], tuple[Tensor, Tensor]] = {}

    def forward(self, features: Tensor, vibration: Tensor) -> FusedMap:
        """(N, C, H, W) and (N, D) → the filtered map, laid out as it came, and its SNR (N,)."""
        with torch.autocast(features.device.type, enabled=False):
            snr = self.fusion.snr(vibration.to(self.fusion.snr_head.weight.dtype))
            margin = self.fusion.config.edge_padding
            work = F.pad(features, (margin,) * 4, mode="replicate") if margin else features
            out = torch.empty_like(features)
            inner = slice(margin, -margin) if margin else slice(None)
            step = max(1, AT_ONCE // work[0].numel())
            for first in range(0, len(work), step):
                some = slice(first, first + step)
                out[some] = self._filtered(work[some].to(snr.dtype).contiguous(), snr[some])[..., inner, inner]
        return FusedMap(out, snr.mean(1))

    def _filtered(self, maps: Tensor, snr: Tensor) -> Tensor:
        height, width = maps.shape[-2:]
        conjugate, square = self._spectrum(height, width, maps.device)
        spectrum = torch.fft.rfft2(maps).mul_(conjugate)
        torch.view_as_real(spectrum).div_(square + (1 / snr)[..., None, None, None])
        filtered: Tensor = torch.fft.irfft(torch.fft.ifft(spectrum, dim=-2), n=width)
        return filtered

    def _spectrum(self, height: int, width: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """H* (C, H, W // 2 + 1), and |H|² (C, H, W // 2 + 1, 2) once for each of real and imaginary part."""
        key = (height, width, device)
        if key not in self._spectra:
            assert self.fusion.kernel is not None
            H = transfer_function(self.fusion.kernel, height, width)
            square = (H.real**2 + H.imag**2)[..., None]
            self._spectra[key] = H.conj().resolve_conj(), square.expand(*H.shape, 2).contiguous()
        return self._spectra[key]
