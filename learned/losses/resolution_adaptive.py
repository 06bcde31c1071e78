"""The loss of RA-Depth (He et al., ECCV 2022): the same scene at three sizes must have the same depth.

Every snippet is seen three times: enlarged and cropped (high), as it is (middle), shrunk (low). One motion, from the
middle view, serves all three; each view has its camera. Per view the better of the sources counts, and what the
unmoved source explains better does not (min-reprojection and auto-mask, Godard et al. 2019).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from learned.camera_rays import CameraBatch
from learned.losses.masks import moving
from learned.losses.photometric import Photometric, countable, photometric_map
from learned.losses.smoothness import edge_aware_smoothness, mean_normalised
from learned.losses.terms import LossTerms, masked_mean
from learned.warping import WHOLE, DepthKind, project_depth, sample

HIGH, LOW = (1.1, 2.0), (0.7, 0.9)
NEVER = 1e3  # difference of a pixel that its source does not show: any other source or standing still is better


@dataclass(frozen=True)
class ResolutionAdaptive:
    """Weights. Defaults: RA-Depth's."""

    smoothness_weight: float = 1e-3
    consistency_weight: float = 1.0
    photometric: Photometric = field(default_factory=lambda: Photometric(match_brightness=False))
    depth_kind: DepthKind = "z"
    mismatched_corners: bool = False
    """Parity with a published slip: see `learned.warping.sample`."""
    masks_of_whole_batch: bool = False
    """Parity with RA-Depth's published code: the low view's consistency uses all masks of the batch for each image."""


@dataclass(frozen=True)
class View:
    """B snippets at one of the three sizes."""

    target: Tensor
    """(B, C, H, W) in 0..1."""
    sources: Tensor
    """(B, S, C, H, W)."""
    cameras: CameraBatch
    """B cameras of this view."""
    usable: Tensor
    """(B, 1, H, W) bool: not the repetition that fills a shrunk image up, not the vignette."""


def scale_views(target: Tensor, sources: Tensor, cameras: CameraBatch, generator: torch.Generator,
                usable: Tensor | None = None) -> tuple[View, View, View]:
    """High, middle and low views of images (B, C, H, W) and (B, S, C, H, W), all of their size.

    High: enlarged by U(1.1, 2) and cropped at random. Low: shrunk by U(0.7, 0.9) into the upper left, repeated to
    fill the image; only the first copy is usable. The generator is one on the CPU.
    """
    height, width = target.shape[-2:]
    everywhere = torch.ones_like(target[:, :1], dtype=torch.bool) if usable is None else usable
    random = torch.rand(4, len(target), generator=generator, dtype=torch.float64).to(target.device, target.dtype)
    high, low = (a + (b - a) * random[k] for k, (a, b) in enumerate((HIGH, LOW)))
    left, top = ((size * (high - 1) * random[2 + k]).floor() for k, size in enumerate((width, height)))
    nothing = torch.zeros_like(left)

    def view(ratio: Tensor, left: Tensor, top: Tensor, repeated: bool) -> View:
        pixels, first = _original_pixels(cameras, ratio, left, top, repeated)
        stack = torch.cat([target, sources.flatten(1, 2), everywhere.to(target.dtype)], 1)
        seen = sample(stack, pixels)
        images = seen[:, :-1].view(len(target), 1 + sources.shape[1], *target.shape[1:])
        fx, fy, cx, cy = cameras.intrinsics.unbind(1)
        scaled = torch.stack([fx * ratio, fy * ratio, (cx + 0.5) * ratio - 0.5 - left,
                              (cy + 0.5) * ratio - 0.5 - top], 1)
        return View(images[:, 0], images[:, 1:], cameras.with_intrinsics(scaled), first & (seen[:, -1:] > WHOLE))
    return (view(high, left, top, False), View(target, sources, cameras, everywhere),
            view(low, nothing, nothing, True))


def resolution_adaptive_loss(views: tuple[View, View, View], disparities: tuple[Tensor, Tensor, Tensor],
                             depths: tuple[Tensor, Tensor, Tensor], T_target_source: Tensor,
                             settings: ResolutionAdaptive | None = None) -> LossTerms:
    """L_high + L_middle + L_low + consistency of the high and low disparities with the middle ones.

    Args:
        views: high, middle, low.
        disparities: (B, 1, H, W) of each view's target, what the network put out.
        depths: (B, 1, H, W) of each, motion units.
        T_target_source: (B, S, 4, 4) poses of the source cameras in the target camera, from the middle view.
        settings: weights.
    """
    s = settings or ResolutionAdaptive()
    names, parts, masks = ("high", "middle", "low"), {}, []
    for name, view, disparity, depth in zip(names, views, disparities, depths, strict=True):
        parts[name], mask = _reprojection(view, depth, T_target_source, s)
        parts[f"smoothness_{name}"] = edge_aware_smoothness(mean_normalised(disparity), view.target, view.usable)
        masks.append(mask)
    middle, moved = views[1], masks[1]
    for k, name in ((0, "high"), (2, "low")):
        weights = moved & _shared(middle, views[k])
        if s.masks_of_whole_batch and name == "low":
            mixed = weights.to(disparities[1].dtype).mean(0, keepdim=True).expand_as(disparities[1])
        else:
            mixed = weights.to(disparities[1].dtype)
        aligned = align_disparity(disparities[k], views[k].cameras, middle.cameras)
        parts[f"consistency_{name}"] = masked_mean(photometric_map(aligned, disparities[1], s.photometric), mixed)
    total = sum((parts[name] + s.smoothness_weight * parts[f"smoothness_{name}"] for name in names),
                start=T_target_source.new_zeros(()))
    total = total + s.consistency_weight * (parts["consistency_high"] + parts["consistency_low"])
    return LossTerms(total, {name: value.detach() for name, value in parts.items()})


def align_disparity(disparity: Tensor, cameras: CameraBatch, onto: CameraBatch) -> Tensor:
    """Disparity (B, 1, H, W) of one view, sampled at the pixels of another whose camera differs by scale and crop.

    Depth and disparity of a point do not change when its image is enlarged, so nothing is rescaled.
    """
    return sample(disparity, _matching_pixels(cameras, onto))


def _reprojection(view: View, depth: Tensor, T_target_source: Tensor, s: ResolutionAdaptive) -> tuple[Tensor, Tensor]:
    """Mean over pixels of the least difference, the unmoved sources included, and where a moved one won."""
    batch, count = view.sources.shape[:2]
    rows = torch.arange(batch, device=depth.device).repeat_interleave(count)
    where = project_depth(depth[rows], T_target_source.flatten(0, 1), view.cameras.select(rows), s.depth_kind)
    pixels = torch.where(where.valid, where.pixels, torch.zeros_like(where.pixels))
    sources, target = view.sources.flatten(0, 1), view.target[rows]
    warped = photometric_map(sample(sources, pixels, "border", s.mismatched_corners), target, s.photometric)
    shown = where.valid & (sample(view.usable[rows].to(pixels.dtype), pixels) > WHOLE)
    warped = torch.where(countable(shown, s.photometric), warped, torch.full_like(warped, NEVER))
    still = photometric_map(sources, target, s.photometric)
    warped, still = (values.view(batch, count, *values.shape[1:]).amin(1) for values in (warped, still))
    counted = countable(view.usable, s.photometric)
    return masked_mean(torch.minimum(warped, still), counted), counted & moving(warped, still)


def _shared(middle: View, other: View) -> Tensor:
    """Pixels (B, 1, H, W) bool of the middle view that the other shows too."""
    pixels = _matching_pixels(other.cameras, middle.cameras).detach()
    seen = sample(other.usable.to(pixels.dtype), pixels) > WHOLE
    return middle.usable & seen & other.cameras.contains(pixels)[:, None]


def _matching_pixels(cameras: CameraBatch, onto: CameraBatch) -> Tensor:
    """Where (B, 2, H, W) in images of `cameras` the pixels of `onto` lie: the same lens, other intrinsics."""
    old, new = onto.intrinsics[..., None, None], cameras.intrinsics[..., None, None]
    return (onto.pixel_grid - old[:, 2:]) / old[:, :2] * new[:, :2] + new[:, 2:]


def _original_pixels(cameras: CameraBatch, ratio: Tensor, left: Tensor, top: Tensor,
                     repeated: bool) -> tuple[Tensor, Tensor]:
    """Where (B, 2, H, W) in the original each pixel of a scaled view comes from, and which belong to its first copy."""
    at = cameras.pixel_grid + torch.stack([left, top], 1)[..., None, None]
    size = torch.tensor([cameras.width, cameras.height], dtype=ratio.dtype, device=ratio.device)
    copy = (size * ratio[:, None]).floor()[..., None, None]
    first = (at < copy).all(1, keepdim=True) if repeated else torch.ones_like(at[:, :1], dtype=torch.bool)
    at = torch.remainder(at, copy) if repeated else at
    return (at + 0.5) / ratio.view(-1, 1, 1, 1) - 0.5, first
