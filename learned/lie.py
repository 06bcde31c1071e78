"""Rotations and rigid transforms in torch: differentiable everywhere, at rest too.

Same conventions as `vio.se3` (`T_a_b` maps coordinates of b to a; rotation vectors in rad); formulas: Solà, Deray,
Atchuthan, "A micro Lie theory for state estimation in robotics" (2018).
"""

from __future__ import annotations

import torch
from torch import Tensor

SMALL_SQUARE = 1e-6  # rad²; below it the Taylor series is exact to double precision in values and first derivatives


def skew(v: Tensor) -> Tensor:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)


def so3_exp(rotvec: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    square = (rotvec * rotvec).sum(-1)[..., None, None]
    small = square < SMALL_SQUARE
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    sine = torch.where(small, 1 - square / 6 + square**2 / 120, angle.sin() / angle)
    cosine = torch.where(small, 0.5 - square / 24 + square**2 / 720, 2 * (0.5 * angle).sin() ** 2 / safe)
    K = skew(rotvec)
    return torch.eye(3, dtype=rotvec.dtype, device=rotvec.device) + sine * K + cosine * (K @ K)


def rotation_from_euler_xyz(angles: Tensor) -> Tensor:
    """Angles (..., 3) about x, y, z [rad] → R = Rx Ry Rz (..., 3, 3), the order of the SfMLearner family."""
    (sx, sy, sz), (cx, cy, cz) = torch.sin(angles).unbind(-1), torch.cos(angles).unbind(-1)
    zero, one = torch.zeros_like(sx), torch.ones_like(sx)
    shape = (*angles.shape[:-1], 3, 3)
    Rx = torch.stack([one, zero, zero, zero, cx, -sx, zero, sx, cx], -1).reshape(shape)
    Ry = torch.stack([cy, zero, sy, zero, one, zero, -sy, zero, cy], -1).reshape(shape)
    Rz = torch.stack([cz, -sz, zero, sz, cz, zero, zero, zero, one], -1).reshape(shape)
    return Rx @ Ry @ Rz


def so3_log(R: Tensor) -> Tensor:
    """Rotation vectors (..., 3) [rad] of rotation matrices (..., 3, 3) that turn by clearly less than pi.

    Differentiable up to there; at pi itself the axis has no sign, and frames of one camera never turn so far.
    """
    doubled = torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    square = 0.25 * (doubled * doubled).sum(-1, keepdim=True)  # sin²
    cosine = 0.5 * (R.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1)
    small = (square < SMALL_SQUARE) & (cosine > 0)
    sine = torch.where(small, torch.ones_like(square), square).clamp(min=1e-24).sqrt()
    series = 1 + square / 6 + 3 * square**2 / 40  # asin(s) / s
    return 0.5 * doubled * torch.where(small, series, torch.atan2(sine, cosine) / sine)


def transform(R: Tensor, t: Tensor) -> Tensor:
    """Stack rotations (..., 3, 3) and translations (..., 3) into transforms (..., 4, 4)."""
    top = torch.cat([R, t[..., None]], -1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype, device=R.device).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)


def inverse(T: Tensor) -> Tensor:
    """`T_b_a` (..., 4, 4) of `T_a_b`, using that the rotation part is orthonormal."""
    R_t = T[..., :3, :3].transpose(-1, -2)
    return transform(R_t, -(R_t @ T[..., :3, 3:])[..., 0])


def halfway(a: Tensor, b: Tensor) -> Tensor:
    """Between two rigid motions (..., 4, 4): rotation half of the geodesic, translation half of the line."""
    half = so3_exp(0.5 * so3_log(a[..., :3, :3].transpose(-1, -2) @ b[..., :3, :3]))
    return transform(a[..., :3, :3] @ half, 0.5 * (a[..., :3, 3] + b[..., :3, 3]))
