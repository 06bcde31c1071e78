"""The two stages of AF-SfMLearner (Shao et al., Medical Image Analysis 2022), and EndoDAC, which shares them.

Stage 1 learns optical flow, which aligns ("registers") a source to the target whatever the light does. Stage 2 learns
depth, motion and an appearance flow, the change of brightness between the frames: the target plus that change should
look like the registered source, and like the source warped through depth and motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from learned.camera_rays import CameraBatch, pixel_grid
from learned.losses.photometric import Photometric, countable, photometric_map
from learned.losses.smoothness import edge_aware_smoothness, mean_normalised
from learned.losses.terms import LossTerms, full_precision, masked_mean
from learned.warping import WHOLE, DepthKind, project_depth, sample


@dataclass(frozen=True)
class AppearanceFlow:
    """Weights of the two stages. Defaults: AF-SfMLearner's."""

    flow_smoothness_weight: float = 1e-3
    residue_weight: float = 0.01
    """Of |refined target - registered source|: the appearance flow explains the change of light."""
    appearance_smoothness_weight: float = 0.01
    disparity_smoothness_weight: float = 1e-4
    photometric: Photometric = field(default_factory=lambda: Photometric(match_brightness=False))
    depth_kind: DepthKind = "z"
    mismatched_corners: bool = False
    """Parity with AF-SfMLearner's published code, whose trajectories suffer from it."""


AF_SFM = AppearanceFlow()
ENDODAC = AppearanceFlow(disparity_smoothness_weight=1e-3)


@dataclass(frozen=True)
class Registered:
    """B targets aligned with S sources by optical flow, all from the finest scale."""

    image: Tensor
    """(B, S, C, H, W) the sources sampled where the flow says; used without gradient."""
    visible: Tensor
    """(B, S, 1, H, W) bool: target pixels that the source shows (`learned.losses.masks.visible_from`)."""


def register(sources: Tensor, flow_target_source: Tensor, settings: AppearanceFlow = AF_SFM) -> Tensor:
    """Sources (B, S, C, H, W) sampled where the flow (B, S, 2, h, w) sends the target's pixels.

    Flow is in pixels of the full image at any size of its map; smaller maps are interpolated.
    """
    height, width = sources.shape[-2:]
    flow = _full_size(flow_target_source.flatten(0, 1).to(sources.dtype), height, width)
    pixels = flow + pixel_grid(height, width, flow)
    return sample(sources.flatten(0, 1), pixels, "border", settings.mismatched_corners).view(sources.shape)


def flow_loss(target: Tensor, sources: Tensor, flows_target_source: Sequence[Tensor],
              settings: AppearanceFlow = AF_SFM) -> LossTerms:
    """Stage 1: the best registered source should look like the target, and flow be smooth; mean over scales.

    Args:
        target: (B, C, H, W) in 0..1.
        sources: (B, S, C, H, W).
        flows_target_source: per scale, finest first, (B, S, 2, h, w) in pixels of the full image.
        settings: weights.
    """
    photometric, smoothness, weighted = (target.new_zeros(()) for _ in range(3))
    for scale, flow in enumerate(flows_target_source):
        seen = register(sources, flow, settings)
        apart = _difference(seen, target[:, None].expand_as(seen), settings)
        best = apart.amin(1).mean()
        guide = F.interpolate(target, flow.shape[-2:], mode="area")
        rough = edge_aware_smoothness(flow.flatten(0, 1), guide.repeat_interleave(flow.shape[1], 0))
        photometric, smoothness = photometric + best, smoothness + rough
        weighted = weighted + best + settings.flow_smoothness_weight / 2**scale * rough
    count = len(flows_target_source)
    return LossTerms(weighted / count, {"photometric": (photometric / count).detach(),
                                        "flow_smoothness": (smoothness / count).detach()})


def appearance_loss(target: Tensor, sources: Tensor, depths: Sequence[Tensor], disparities: Sequence[Tensor],
                    T_target_source: Tensor, cameras: CameraBatch, appearance: Sequence[Tensor],
                    registered: Registered, usable: Tensor | None = None,
                    settings: AppearanceFlow = AF_SFM) -> LossTerms:
    """Stage 2: mean over scales and sources of how far warped, registered and refined images are apart.

    Args:
        target: (B, C, H, W) in 0..1.
        sources: (B, S, C, H, W).
        depths: per scale, finest first, (B, 1, H, W) of the target at full size, motion units.
        disparities: per scale (B, 1, h, w), what the network put out; smoothed at its own size.
        T_target_source: (B, S, 4, 4) poses of the source cameras in the target camera.
        cameras: B cameras.
        appearance: per scale (B, S, C, H, W), the change of light to add to the target, about -1..1.
        registered: from stage 1.
        usable: (B, 1, H, W) bool, of targets and sources alike (the vignette stays); None = everywhere.
        settings: weights.
    """
    batch, count = sources.shape[:2]
    still, visible = full_precision(registered.image.detach()).flatten(0, 1), registered.visible.flatten(0, 1)
    wide = target.repeat_interleave(count, 0)
    rows = torch.arange(batch, device=target.device).repeat_interleave(count)
    views = cameras.select(rows)
    whole = torch.ones_like(visible) if usable is None else usable[rows]
    visible = visible & whole
    sums: dict[str, Tensor] = {}
    weighted = target.new_zeros(())
    for scale, (depth, disparity, change) in enumerate(zip(depths, disparities, appearance, strict=True)):
        where = project_depth(depth[rows], T_target_source.flatten(0, 1), views, settings.depth_kind)
        pixels = torch.where(where.valid, where.pixels, torch.zeros_like(where.pixels))
        warped = sample(sources.flatten(0, 1), pixels, "border", settings.mismatched_corners)
        shown = whole & where.valid & (sample(whole.to(pixels.dtype), pixels) > WHOLE)
        counted = visible & countable(shown, settings.photometric)  # visible has pores where the view grows
        change = full_precision(change).flatten(0, 1)
        refined = (wide + visible * change).clamp(0, 1)
        guide = F.interpolate(target, disparity.shape[-2:], mode="area")
        terms = {
            "photometric": masked_mean(photometric_map(warped, refined, settings.photometric), counted),
            "residue": masked_mean((refined - still).abs(), visible),
            "appearance_smoothness": edge_aware_smoothness(change, (still - wide).abs(), visible),
            "disparity_smoothness": edge_aware_smoothness(mean_normalised(disparity), guide),
        }
        sums = {name: sums.get(name, 0) + value for name, value in terms.items()}
        weighted = (weighted + terms["photometric"] + settings.residue_weight * terms["residue"]
                    + settings.appearance_smoothness_weight * terms["appearance_smoothness"]
                    + settings.disparity_smoothness_weight / 2**scale * terms["disparity_smoothness"])
    return LossTerms(weighted / len(depths), {name: (value / len(depths)).detach() for name, value in sums.items()})


def _difference(seen: Tensor, target: Tensor, settings: AppearanceFlow) -> Tensor:
    """Photometric map (B, S, 1, H, W) of images (B, S, C, H, W)."""
    apart = photometric_map(seen.flatten(0, 1), target.flatten(0, 1), settings.photometric)
    return apart.view(*seen.shape[:2], *apart.shape[1:])


def _full_size(flow: Tensor, height: int, width: int) -> Tensor:
    if flow.shape[-2:] == (height, width):
        return flow
    return F.interpolate(flow, (height, width), mode="bilinear", align_corners=True)
