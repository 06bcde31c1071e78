"""What a combination of losses returns: the number to minimise and the numbers to look at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class LossTerms:
    """One loss and what it is made of."""

    total: Tensor
    """Scalar to minimise, weights applied."""
    parts: Mapping[str, Tensor]
    """Scalars by name, before their weights and without gradient, for logs."""


def full_precision(values: Tensor) -> Tensor:
    """The values in float32 if they come in half precision: variances and logarithms do not survive eight bits."""
    return values.float() if values.dtype in (torch.float16, torch.bfloat16) else values


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of values (B, C, H, W) where the mask (B, 1, H, W), bool or weights, says so; 0 where it never does."""
    weights = mask.to(values.dtype)
    return (values * weights).sum() / (weights.sum() * values.shape[1]).clamp(min=1)
