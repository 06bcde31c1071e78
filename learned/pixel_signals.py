"""What a predicted depth map and its frame tell, pixel by pixel, about how wrong the depth may be.

Nothing here needs a second pass of the network: the depth itself, its slope, where the pixel lies, how it is lit.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from learned.errors import NetworkInputError
from vio.camera import Camera

PIXEL_SIGNALS = ("depth", "relative", "relative_squared", "edge", "angle", "angle_squared", "luminance", "highlight")
"""Names of the signals: ln z-depth; the same less its median over the image, and its square; ln of its slope per pixel;
angle to the optical axis [rad] and its square; ln luminance; share of clipped pixels nearby."""
CLIPPED = 250 / 255
"""Brightest channel from which a pixel counts as a specular highlight."""
LEAST_SLOPE = 0.01
LEAST_LUMINANCE = 0.02
LEAST_DEPTH = 1e-6
NEARBY = 5
"""Width of the square in which highlights are counted [pixels]."""


def off_axis_angle(camera: Camera) -> NDArray[np.float32]:
    """(H, W) angle between a pixel's ray and the optical axis [rad]; the widest one where the lens does not reach."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).astype(float)
    rays = camera.unproject(grid)
    angle = np.arccos(np.clip(rays[..., 2] / np.linalg.norm(rays, axis=-1), -1, 1))
    return np.asarray(np.where(np.isfinite(angle), angle, np.nanmax(angle)), np.float32)


def pixel_signals(frames: Tensor, z_depth: Tensor, angle: Tensor) -> Tensor:
    """The `PIXEL_SIGNALS` of B frames, (B, S, H, W).

    Args:
        frames: (B, 3, H, W) in 0..1.
        z_depth: (B, H, W) predicted, motion units; 0 where unknown, which there counts as the image's median.
        angle: (H, W) from `off_axis_angle`.

    Raises:
        NetworkInputError: sizes that do not belong together.
    """
    size = tuple(z_depth.shape[1:])
    if frames.ndim != 4 or (len(frames), *frames.shape[2:]) != tuple(z_depth.shape) or tuple(angle.shape) != size:
        raise NetworkInputError(f"pixel signals: frames {tuple(frames.shape)}, depth {tuple(z_depth.shape)} and angles "
                                f"{tuple(angle.shape)} are not of one size; give (B, 3, H, W), (B, H, W), (H, W)")
    log_z = z_depth.clamp(min=LEAST_DEPTH).log()
    known = torch.where(z_depth > 0, log_z, torch.nan)
    middle = torch.nan_to_num(known.flatten(1).nanmedian(1).values)[:, None, None]
    log_z = torch.where(z_depth > 0, log_z, middle)
    relative, wide = log_z - middle, angle.to(log_z).expand_as(log_z)
    luminance = (frames.mean(1) + LEAST_LUMINANCE).log()
    clipped = (frames.amax(1, keepdim=True) >= CLIPPED).to(log_z)
    near = F.avg_pool2d(clipped, NEARBY, 1, NEARBY // 2, count_include_pad=False)[:, 0]
    return torch.stack([log_z, relative, relative**2, _slope(log_z), wide, wide**2, luminance, near], 1)


def _slope(log_z: Tensor) -> Tensor:
    """ln of the length of the gradient of (B, H, W), per pixel."""
    padded = F.pad(log_z[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    x, y = (padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]) / 2, (padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]) / 2
    return (torch.hypot(x, y) + LEAST_SLOPE).log()
