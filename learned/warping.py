"""View synthesis: what the target camera would see, taken from a source image through depth and motion.

A pixel of the target goes out along its ray to its depth, into the source camera, and back onto the source's image.
Depth is either along the optical axis ("z", the contract of depth maps on disk) or along the ray ("range"). Beyond
about 60 degrees from the axis use range: z falls to nothing while the wall stays where it is, and rays with z ≤ 0,
which a fisheye has, are masked as long as depth means z.

Grids follow `grid_sample(align_corners=True)`: coordinates -1 and 1 are the outermost pixel centres, so a pixel at
column x lies at 2 x / (w - 1) - 1. No matrix product is used, so neither autocast nor TF32 touches a coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from learned.camera_rays import CameraBatch

DepthKind = Literal["z", "range"]
Padding = Literal["zeros", "border"]

SMALLEST_COSINE = 0.01  # to the optical axis (89.4 degrees), below which a z-depth says nothing about a ray
WHOLE = 0.999  # share of a bilinear sample that must come from usable pixels


@dataclass(frozen=True)
class Projected:
    """Where the pixels of B targets lie in their sources."""

    pixels: Tensor
    """(B, 2, H, W) columns and rows in the source; without meaning where not valid."""
    depth: Tensor
    """(B, 1, H, W) depth of the targets' points as the source's camera sees it: the computed depth of L_g."""
    valid: Tensor
    """(B, 1, H, W) bool: depth > 0, in front of both cameras, within the lens, inside the source's image."""


@dataclass(frozen=True)
class Synthesis:
    """B targets seen through their sources."""

    image: Tensor
    """(B, C, H, W) the source's colours at the target's pixels."""
    computed_depth: Tensor
    """(B, 1, H, W) depth of the target's points in the source's camera."""
    sampled_depth: Tensor
    """(B, 1, H, W) the source's own depth at the same places: the projected depth of L_g."""
    valid: Tensor
    """(B, 1, H, W) bool: `Projected.valid`, and both pixels usable."""
    pixels: Tensor
    """(B, 2, H, W) columns and rows in the source."""


def depth_rays(cameras: CameraBatch, kind: DepthKind) -> tuple[Tensor, Tensor]:
    """Rays (B, 3, H, W) that depth multiplies, z = 1 or length = 1, and which of them (B, 1, H, W) can be used."""
    rays, reached = cameras.pixel_rays
    if kind == "range":
        return rays, reached[:, None]
    along = rays[:, 2:]
    front = along.detach() > SMALLEST_COSINE
    return rays / torch.where(front, along, torch.ones_like(along)), reached[:, None] & front


def to_z_depth(depth: Tensor, cameras: CameraBatch, kind: DepthKind) -> Tensor:
    """z-depth (B, 1, H, W) of depth of either kind, 0 where the ray looks sideways or backwards."""
    _, front = depth_rays(cameras, "z")
    z = depth if kind == "z" else depth * cameras.pixel_rays[0][:, 2:]
    return torch.where(front, z, torch.zeros_like(z))


def project_depth(depth: Tensor, T_target_source: Tensor, cameras: CameraBatch, kind: DepthKind = "z",
                  source_cameras: CameraBatch | None = None) -> Projected:
    """Carry the targets' pixels into the sources.

    Args:
        depth: (B, 1, H, W) of the targets, in motion units; any floating type, computed in the cameras' type.
        T_target_source: (B, 4, 4) pose of the source camera in the target camera, translation in motion units:
            `T_i_j` with target i and source j.
        cameras: B cameras of the targets, and of the sources unless `source_cameras` are given.
        kind: what depth means.
        source_cameras: B cameras of the sources.
    """
    dtype, sources = cameras.intrinsics.dtype, source_cameras or cameras
    depth, T = depth.to(dtype), T_target_source.to(dtype)
    rays, usable = depth_rays(cameras, kind)
    known = torch.isfinite(depth.detach()) & (depth.detach() > 0)
    points = _into_source(torch.where(known, depth, torch.ones_like(depth)) * rays, T)
    pixels, seen = sources.project(points)
    distance = points[:, 2:] if kind == "z" else (points * points).sum(1, keepdim=True).clamp(min=1e-24).sqrt()
    seen = seen & sources.contains(pixels.detach())
    valid = usable & known & seen[:, None] & (distance.detach() > 0)
    return Projected(pixels, distance, valid)


def sample(image: Tensor, pixels: Tensor, padding: Padding = "border", mismatched_corners: bool = False) -> Tensor:
    """Bilinear samples (B, C, H, W) of images (B, C, h, w) at pixels (B, 2, H, W).

    `mismatched_corners` repeats a published slip: coordinates of the align_corners=True convention are given to a
    sampler of the other one, which shifts samples by up to half a pixel towards the image's edge.
    """
    height, width = image.shape[-2:]
    scale = pixels.new_tensor([2 / max(width - 1, 1), 2 / max(height - 1, 1)]).view(1, 2, 1, 1)
    grid = (pixels * scale - 1).permute(0, 2, 3, 1)
    return F.grid_sample(image.to(grid.dtype), grid, mode="bilinear", padding_mode=padding,
                         align_corners=not mismatched_corners)


def synthesise(source: Tensor, source_depth: Tensor, target_depth: Tensor, T_target_source: Tensor,
               cameras: CameraBatch, kind: DepthKind = "z", usable_target: Tensor | None = None,
               usable_source: Tensor | None = None, padding: Padding = "border",
               mismatched_corners: bool = False) -> Synthesis:
    """Synthesise the targets from the sources.

    Args:
        source: (B, C, H, W) images.
        source_depth: (B, 1, H, W) of the sources.
        target_depth: (B, 1, H, W) of the targets.
        T_target_source: (B, 4, 4) pose of the source camera in the target camera.
        cameras: B cameras, of target and source alike.
        kind: what depth means.
        usable_target: (B, 1, H, W) bool, False in the vignette, in highlights.
        usable_source: (B, 1, H, W) bool, likewise of the source.
        padding: what lies around the source's image; such pixels are not valid either way.
        mismatched_corners: see `sample`.
    """
    where = project_depth(target_depth, T_target_source, cameras, kind)
    valid = where.valid if usable_target is None else where.valid & usable_target
    pixels = torch.where(where.valid, where.pixels, torch.zeros_like(where.pixels))
    layers = [source.to(pixels.dtype), source_depth.to(pixels.dtype)]
    if usable_source is not None:
        layers.append(usable_source.to(pixels.dtype))
    seen = sample(torch.cat(layers, 1), pixels, padding, mismatched_corners)
    channels = source.shape[1]
    if usable_source is not None:
        valid = valid & (seen[:, channels + 1:].detach() > WHOLE)
    return Synthesis(seen[:, :channels], where.depth, seen[:, channels:channels + 1], valid, pixels)


def _into_source(points: Tensor, T_target_source: Tensor) -> Tensor:
    """Points (B, 3, H, W) of the target's axes in the source's: `R^T (p - t)`, by sums of products."""
    from_source = points - T_target_source[:, :3, 3, None, None]
    return (T_target_source[:, :3, :3, None, None] * from_source[:, :, None]).sum(1)
