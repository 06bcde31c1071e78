"""Local correlation: how well a cell of one map matches the cells around the same place of another map."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def local_correlation(first: Tensor, second: Tensor, radius: int) -> Tensor:
    """Inner products of every cell with the (2r + 1)² cells around it in the other map.

    One batched matrix product per row offset: a row of `first` against the whole padded row of `second`, of which only
    the band |x' - x| ≤ r is kept.

    Args:
        first: (N, C, H, W).
        second: (N, C, H, W); zero beyond its borders.
        radius: r in cells.

    Returns:
        (N, (2r + 1)², H, W); channel (dy + r)(2r + 1) + (dx + r) is Σ_c first[y, x] · second[y + dy, x + dx].
    """
    height, width = first.shape[-2:]
    padded = F.pad(second, (radius,) * 4).permute(0, 2, 1, 3)
    rows = first.permute(0, 2, 3, 1)
    bands = [_band(rows @ padded[:, dy:dy + height], 2 * radius + 1) for dy in range(2 * radius + 1)]
    return torch.stack(bands, 3).flatten(3).permute(0, 3, 1, 2).reshape(len(first), -1, height, width)


def _band(products: Tensor, count: int) -> Tensor:
    """(N, H, W, W + count - 1) → (N, H, W, count): entry (x, d) is products[x, x + d].

    Rows that are one longer in the same memory shift by one from row to row: the band becomes a block.
    """
    batch, height, width, length = products.shape
    skewed = F.pad(products.flatten(2), (0, width)).reshape(batch, height, width, length + 1)
    return skewed[..., :count]


def locally_normalised(features: Tensor, window: int = 9, eps: float = 1e-3) -> Tensor:
    """Features (N, C, H, W) less their mean over an odd window, at unit length: slowly varying light cancels."""
    mean = F.avg_pool2d(features, window, 1, padding=window // 2, count_include_pad=False)
    return F.normalize(features - mean, dim=1, eps=eps)
