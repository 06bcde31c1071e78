"""Rotations and rigid motions in torch, batched and differentiable everywhere, zero rotation included."""

from __future__ import annotations

import torch
from torch import Tensor

SMALL_ANGLE_SQUARED = 1e-8
"""Below, two terms of the series are exact to double precision."""


def skew(vectors: Tensor) -> Tensor:
    """(N, 3) → (N, 3, 3) with skew(a) b = a x b."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vectors.shape[:-1], 3, 3)


def rotation_from_vector(vectors: Tensor) -> Tensor:
    """Rotation vectors (N, 3) [rad] → matrices (N, 3, 3), by Rodrigues' formula.

    The coefficients are sin θ / θ and ½ (sin ½θ / ½θ)², which does not cancel at small angles.
    """
    squared = (vectors * vectors).sum(-1)[..., None, None]
    small = squared < SMALL_ANGLE_SQUARED
    angle = torch.sqrt(torch.where(small, torch.ones_like(squared), squared))
    half = 0.5 * angle
    first = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
    second = torch.where(small, 0.5 - squared / 24, 0.5 * (torch.sin(half) / half) ** 2)
    K = skew(vectors)
    return torch.eye(3, dtype=vectors.dtype, device=vectors.device) + first * K + second * (K @ K)


def rotation_from_euler_xyz(angles: Tensor) -> Tensor:
    """Angles (N, 3) about x, y, z [rad] → R = Rx Ry Rz (N, 3, 3), the order of the SfMLearner family."""
    (sx, sy, sz), (cx, cy, cz) = torch.sin(angles).unbind(-1), torch.cos(angles).unbind(-1)
    zero, one = torch.zeros_like(sx), torch.ones_like(sx)
    shape = (*angles.shape[:-1], 3, 3)
    Rx = torch.stack([one, zero, zero, zero, cx, -sx, zero, sx, cx], -1).reshape(shape)
    Ry = torch.stack([cy, zero, sy, zero, one, zero, -sy, zero, cy], -1).reshape(shape)
    Rz = torch.stack([cz, -sz, zero, sz, cz, zero, zero, zero, one], -1).reshape(shape)
    return Rx @ Ry @ Rz


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """Rotations (N, 3, 3) and translations (N, 3) → transforms (N, 4, 4)."""
    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], -2)


def inverse_rigid(transform: Tensor) -> Tensor:
    """Inverse of rigid transforms (N, 4, 4), without a solver."""
    transposed = transform[..., :3, :3].transpose(-1, -2)
    return rigid(transposed, -(transposed @ transform[..., :3, 3:])[..., 0])
