"""Which pixels are worth comparing."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from learned.camera_rays import pixel_grid

CLIP_LEVEL = 250 / 255
"""Brightness from which a pixel of all channels counts as a specular highlight, as in `vio.tracking`."""


def whole_windows(mask: Tensor, margin: int = 1) -> Tensor:
    """Pixels (B, 1, H, W) bool whose window of `margin` pixels around lies in the mask; the image's edge is no hole."""
    holes = F.max_pool2d((~mask).float(), 2 * margin + 1, 1, margin)
    return holes < 0.5


def without_highlights(image: Tensor, margin: int = 1, level: float = CLIP_LEVEL) -> Tensor:
    """Pixels (B, 1, H, W) bool at least `margin` away from specular highlights of images (B, C, H, W) in 0..1.

    A highlight stays where lamp, wall and lens put it while the wall moves: it is no texture to follow.
    """
    return whole_windows(image.amin(1, keepdim=True) < level, margin)


def moving(warped_difference: Tensor, still_difference: Tensor) -> Tensor:
    """Pixels (B, 1, H, W) bool that the synthesised image explains better than the unmoved source does.

    The auto-mask of Monodepth2 (Godard et al., 2019): it leaves out what moves with the camera.
    """
    return warped_difference.detach() < still_difference.detach()


def visible_from(flow_source_target: Tensor, threshold: float = 0.95) -> Tensor:
    """Target pixels (B, 1, H, W) bool that pixels of the source land on: the others are occluded in it.

    Every source pixel is moved by its flow and leaves its bilinear weight on the four pixels around where it lands;
    a target pixel that gathers more than `threshold` is visible (the forward splat of AF-SfMLearner).

    Args:
        flow_source_target: (B, 2, H, W) [pixels], from pixels of the source to where the target shows the same.
        threshold: least weight.
    """
    batch, _, height, width = flow_source_target.shape
    flow = flow_source_target.detach()
    x, y = (flow + pixel_grid(height, width, flow)).unbind(1)
    gathered = flow.new_zeros(batch, height * width)
    for column in (x.floor(), x.floor() + 1):
        for row in (y.floor(), y.floor() + 1):
            weight = (1 - (x - column).abs()) * (1 - (y - row).abs())
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            place = torch.where(inside, row * width + column, torch.zeros_like(row)).long()
            gathered.scatter_add_(1, place.flatten(1), torch.where(inside, weight, torch.zeros_like(weight)).flatten(1))
    return gathered.view(batch, 1, height, width) > threshold
