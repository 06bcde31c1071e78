"""Fields should be smooth where the image is."""

from __future__ import annotations

from torch import Tensor

from learned.losses.terms import full_precision, masked_mean

LEAST_MEAN = 1e-7


def mean_normalised(field: Tensor) -> Tensor:
    """Field (B, 1, H, W) over its mean per image, so that shrinking it makes it no smoother (the paper's d*)."""
    field = full_precision(field)
    return field / field.mean((2, 3), keepdim=True).clamp(min=LEAST_MEAN)


def edge_aware_smoothness(field: Tensor, guide: Tensor, usable: Tensor | None = None) -> Tensor:
    """Mean of |∂x field| exp(-|∂x guide|) plus the same along y: the paper's L_s (Godard et al., CVPR 2017).

    Args:
        field: (B, C, H, W) what is to be smooth; normalise depth and disparity first (`mean_normalised`).
        guide: (B, G, H, W) image whose edges let the field jump; the mean of its channels' slopes counts.
        usable: (B, 1, H, W) bool; slopes between two usable pixels count.
    """
    field, guide = full_precision(field), full_precision(guide)
    total = field.new_zeros(())
    for axis in (3, 2):
        slope, edge = _steps(field, axis).abs(), _steps(guide, axis).abs().mean(1, keepdim=True)
        weighted = slope * (-edge).exp()
        if usable is None:
            total = total + weighted.mean()
        else:
            size = usable.shape[axis] - 1
            both = usable.narrow(axis, 0, size) & usable.narrow(axis, 1, size)
            total = total + masked_mean(weighted, both)
    return total


def _steps(field: Tensor, axis: int) -> Tensor:
    size = field.shape[axis] - 1
    return field.narrow(axis, 1, size) - field.narrow(axis, 0, size)
