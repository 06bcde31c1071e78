"""How different two images look: structural similarity and absolute difference, after a match of brightness.

    photo(a, b) = w · clamp((1 - SSIM) / 2, 0, 1) + (1 - w) · |a - b|,  w = 0.85

as in the paper's L_p (its second norm is an L2 norm, but all four published codes use L1: `norm` chooses).
SSIM: Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment", 2004, on 3 x 3 means as Godard et al. (2017) have it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from learned.losses.masks import whole_windows
from learned.losses.terms import full_precision

C1, C2 = 0.01**2, 0.03**2
LEAST_VARIANCE = 1e-8  # of an image whose brightness is matched: 1/40 of a grey level


@dataclass(frozen=True)
class Photometric:
    """How images are compared."""

    ssim_weight: float = 0.85
    norm: Literal["l1", "l2"] = "l1"
    """Of the colour difference: mean over channels, or the root of the mean square."""
    match_brightness: bool = True
    """Bring the synthesised image to the target's mean and deviation first, the paper's T(I) = a I + c."""
    per_channel: bool = False
    """One (a, c) per colour channel instead of one per image."""
    only_whole_windows: bool = True
    """Leave out pixels whose 3 x 3 window holds an invalid one; the published codes let such windows count."""
    inverted_gain: bool = False
    """Parity with EndoSfMLearner's published code: a = std(warped) / std(target), which doubles the difference."""
    whole_batch: bool = False
    """Parity with the same: one (a, c) for a batch, from all its pixels, invalid ones too."""


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity (B, C, H, W) of images (B, C, H, W) in 0..1, mirrored at their edges."""
    a, b = (F.pad(image, (1, 1, 1, 1), mode="reflect") for image in (a, b))
    mean = _mean_3x3
    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b = mean(a * a) - mean_a * mean_a, mean(b * b) - mean_b * mean_b
    cov = mean(a * b) - mean_a * mean_b
    above = (2 * mean_a * mean_b + C1) * (2 * cov + C2)
    return above / ((mean_a * mean_a + mean_b * mean_b + C1) * (var_a + var_b + C2))


def _mean_3x3(image: Tensor) -> Tensor:
    """Means (B, C, H - 2, W - 2) of windows of 3 x 3, rows then columns: a third of a pooling's time."""
    rows = image[..., :-2] + image[..., 1:-1] + image[..., 2:]
    return (rows[..., :-2, :] + rows[..., 1:-1, :] + rows[..., 2:, :]) * (1 / 9)


def photometric_map(a: Tensor, b: Tensor, settings: Photometric) -> Tensor:
    """How different images (B, C, H, W) are at every pixel: (B, 1, H, W), 0 where they agree."""
    a, b = full_precision(a), full_precision(b)
    structure = ((1 - ssim(a, b)) / 2).clamp(0, 1).mean(1, keepdim=True)
    if settings.norm == "l1":
        colour = (a - b).abs().mean(1, keepdim=True)
    else:
        colour = ((a - b) ** 2).mean(1, keepdim=True).clamp(min=1e-12).sqrt()
    return settings.ssim_weight * structure + (1 - settings.ssim_weight) * colour


def match_brightness(warped: Tensor, target: Tensor, valid: Tensor, settings: Photometric) -> Tensor:
    """`a · warped + c` with a = std(target) / std(warped) and c = mean(target) - a · mean(warped), over valid pixels.

    Reinhard et al., "Color transfer between images", 2001. Neither a nor c carries a gradient: what a network could
    gain by changing an image's contrast is no motion.

    Args:
        warped: (B, C, H, W) the synthesised images.
        target: (B, C, H, W) what they should look like.
        valid: (B, 1, H, W) bool.
        settings: per image or channel, and the parity switches.
    """
    warped, target = full_precision(warped), full_precision(target)
    with torch.no_grad():
        weights = torch.ones_like(valid) if settings.whole_batch else valid
        weights = weights.to(warped.dtype).expand_as(warped)
        over = (0, 1, 2, 3) if settings.whole_batch else (2, 3) if settings.per_channel else (1, 2, 3)
        count = weights.sum(over, keepdim=True).clamp(min=1)
        mean_w, var_w = _moments(warped, weights, over, count)
        mean_t, var_t = _moments(target, weights, over, count)
        gain = (var_t / var_w).sqrt()
        gain = 1 / gain if settings.inverted_gain else gain
    return (warped - mean_w) * gain + mean_t


def compare(warped: Tensor, target: Tensor, valid: Tensor, settings: Photometric) -> tuple[Tensor, Tensor]:
    """Brightness matched as the settings say, then compared.

    Returns:
        (B, 1, H, W) difference, and the mask (B, 1, H, W) of the pixels where it counts.
    """
    if settings.match_brightness:
        warped = match_brightness(warped, target, valid, settings)
    return photometric_map(warped, target, settings), countable(valid, settings)


def countable(valid: Tensor, settings: Photometric) -> Tensor:
    """Of valid pixels (B, 1, H, W) bool those whose photometric difference counts."""
    return whole_windows(valid) if settings.only_whole_windows else valid


def _moments(image: Tensor, weights: Tensor, over: tuple[int, ...], count: Tensor) -> tuple[Tensor, Tensor]:
    mean = (image * weights).sum(over, keepdim=True) / count
    return mean, (((image - mean) ** 2 * weights).sum(over, keepdim=True) / count).clamp(min=LEAST_VARIANCE)
