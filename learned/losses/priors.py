"""What is known without looking at two images: the gyro's rotation, a plausible depth."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from learned.lie import so3_log
from learned.losses.terms import full_precision

GAMMA = 2.2
LIGHT_BLUR_PX = 9
LIGHT_DEPTH_RANGE = (0.15, 3.5)


def rotation_from_gyro(rotvec_i_j: Tensor, R_i_j_gyro: Tensor, known: Tensor | None = None) -> Tensor:
    """Mean L1 distance [rad] of a network's rotation vectors (N, 3) from the gyro's rotations (N, 3, 3).

    Measured: the only signal that a rotation head gets when the gyro's rotation is in the warp.

    Args:
        rotvec_i_j: (N, 3) predicted, camera axes.
        R_i_j_gyro: (N, 3, 3) integrated gyro, camera axes.
        known: (N,) bool, False across a hole of the IMU stream.
    """
    rotvec = full_precision(rotvec_i_j)
    far = (rotvec - so3_log(R_i_j_gyro.to(rotvec.dtype))).abs().sum(-1)
    weights = torch.ones_like(far) if known is None else known.to(far.dtype)
    return (far * weights).sum() / weights.sum().clamp(min=1)


def unit_depth(depth: Tensor) -> Tensor:
    """Square of the mean log depth (B, 1, H, W): a weak pull towards one motion unit, off the sigmoid's bounds."""
    return full_precision(depth).clamp(min=1e-12).log().mean() ** 2


def depth_from_light(image: Tensor) -> Tensor:
    """Depth (B, 1, H, W), median 1, as if a lamp at the camera were all the light: linear luminance to the power -1/2.

    Takes images (B, C, H, W) in 0..1. No learning, and a baseline that every depth network has to beat.
    """
    luminance = full_precision(image).mean(1, keepdim=True).clamp(min=0.01) ** GAMMA
    margin = LIGHT_BLUR_PX // 2
    soft = F.avg_pool2d(F.pad(luminance, (margin,) * 4, mode="reflect"), LIGHT_BLUR_PX, 1)
    depth = soft.rsqrt()
    return (depth / depth.flatten(1).median(1).values.view(-1, 1, 1, 1)).clamp(*LIGHT_DEPTH_RANGE)


def depth_like_light(depth: Tensor, image: Tensor) -> Tensor:
    """Mean |log ratio| of depth (B, 1, H, W) to `depth_from_light` of the image: a start for the first iterations."""
    return (full_precision(depth).clamp(min=1e-12).log() - depth_from_light(image).log()).abs().mean()
