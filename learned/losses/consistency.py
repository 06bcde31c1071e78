"""The paper's loss, 1 · L_p + 0.1 · L_s + 0.5 · L_g, and its relatives: EndoSfMLearner's own and the measured recipe.

Every directed pair of a snippet is warped and compared; depth must agree between the views (SC-SfMLearner, Bian et
al. 2019), and its inverse must be smooth. The settings differ, the function does not.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from learned.losses.geometry import depth_difference
from learned.losses.masks import moving, without_highlights
from learned.losses.photometric import Photometric, compare
from learned.losses.priors import unit_depth
from learned.losses.smoothness import edge_aware_smoothness, mean_normalised
from learned.losses.snippet import Pairs, Snippet, directed_pairs
from learned.losses.terms import LossTerms, masked_mean
from learned.warping import DepthKind, Padding, synthesise
from vio.errors import ConfigError


@dataclass(frozen=True)
class Consistency:
    """How views are made consistent. The defaults are the paper's, where it says; else what the reference advises."""

    photometric_weight: float = 1.0
    smoothness_weight: float = 0.1
    geometry_weight: float = 0.5
    unit_depth_weight: float = 0.0
    """Of the weak prior (mean log depth)²: needed where the rotation is not known from a gyro."""
    photometric: Photometric = field(default_factory=Photometric)
    depth_kind: DepthKind = "z"
    levels: int = 1
    """Of the image pyramid, each half the size of the one before; L_g and L_s see the first only."""
    smallest_px: int = 32
    """Smallest image side of the pyramid: below 32 pixels the photometric minimum is at rest (measured)."""
    luminance: bool = False
    """Compare grey images: three times less to do."""
    weigh_by_agreement: bool = True
    """Multiply the photometric difference by 1 - the difference of depth; the gradient flows through both."""
    auto_mask: bool = False
    """Leave out what the unmoved source explains better."""
    mask_highlights: bool = False
    smooth: Literal["inverse_depth", "depth"] = "inverse_depth"
    reduction: Literal["mean", "sum"] = "mean"
    """Over directed pairs, and over frames for L_s."""
    padding: Padding = "border"
    mismatched_corners: bool = False
    """Parity with a published slip: see `learned.warping.sample`."""
    least_pixels: int = 0
    """Parity with published code: a mean over so few pixels or fewer of a whole batch is 0, without gradient."""


PAPER = Consistency()
"""Equation of the paper with its weights."""
ENDOSFM = Consistency(smooth="depth", reduction="sum", padding="zeros")
"""EndoSfMLearner's own loss without its slips: four directed pairs summed, depth smoothed in all frames."""
ENDOSFM_PUBLISHED = Consistency(
    smooth="depth", reduction="sum", padding="zeros", mismatched_corners=True, least_pixels=10_000,
    photometric=Photometric(inverted_gain=True, whole_batch=True, only_whole_windows=False))
"""As published, slips included; for comparisons only."""
MEASURED = Consistency(levels=3, luminance=True, unit_depth_weight=0.2)
"""What trained best within minutes: three pyramid levels of luminance, the weak depth prior."""


def consistency_loss(snippet: Snippet, settings: Consistency = PAPER) -> LossTerms:
    """All terms over a batch of snippets.

    Parts: `photometric`, `geometry`, `smoothness`, `unit_depth`, and `valid`, the share of pixels compared.

    Raises:
        ConfigError: the pyramid would go below `smallest_px` or halve an odd size, or a motion names a missing frame.
    """
    snippet = _prepared(snippet, settings)
    photometric, geometry, valid = _pair_terms(directed_pairs(snippet), settings)
    level = snippet
    for _ in range(1, settings.levels):
        level = level.halved()
        photometric = photometric + _pair_terms(directed_pairs(level), settings)[0]
    photometric = photometric / settings.levels
    smoothness, prior = _smoothness(snippet, settings), unit_depth(snippet.depth)
    total = (settings.photometric_weight * photometric + settings.geometry_weight * geometry
             + settings.smoothness_weight * smoothness + settings.unit_depth_weight * prior)
    parts = {"photometric": photometric, "geometry": geometry, "smoothness": smoothness, "unit_depth": prior,
             "valid": valid}
    return LossTerms(total, {name: value.detach() for name, value in parts.items()})


def _prepared(snippet: Snippet, settings: Consistency) -> Snippet:
    height, width = snippet.images.shape[-2:]
    if settings.levels < 1 or (settings.levels > 1 and min(height, width) >> (settings.levels - 1)
                               < settings.smallest_px):
        raise ConfigError(f"losses: {settings.levels} pyramid levels of {width} x {height} pixels (limit: the smallest "
                          f"side stays ≥ {settings.smallest_px}); use fewer levels or larger images")
    dtype = snippet.cameras.intrinsics.dtype
    snippet = replace(snippet, images=snippet.images.to(dtype), depth=snippet.depth.to(dtype))
    if settings.mask_highlights:
        clear = without_highlights(snippet.images.flatten(0, 1)).view_as(snippet.depth)
        usable = clear if snippet.usable is None else clear & snippet.usable
        snippet = replace(snippet, usable=usable)
    return snippet.luminance() if settings.luminance else snippet


def _pair_terms(pairs: Pairs, settings: Consistency) -> tuple[Tensor, Tensor, Tensor]:
    """Photometric and geometric term of all pairs at one size, and the share of valid pixels."""
    seen = synthesise(pairs.source, pairs.source_depth, pairs.target_depth, pairs.T_target_source, pairs.cameras,
                      settings.depth_kind, pairs.target_usable, pairs.source_usable, settings.padding,
                      settings.mismatched_corners)
    different, mask = compare(seen.image, pairs.target, seen.valid, settings.photometric)
    apart = depth_difference(seen.computed_depth, seen.sampled_depth)
    valid = seen.valid
    if settings.auto_mask:
        with torch.no_grad():
            still = compare(pairs.source, pairs.target, seen.valid, settings.photometric)[0]
        mask, valid = mask & moving(different, still), valid & moving(different, still)
    if settings.weigh_by_agreement:
        different = different * (1 - apart)
    photometric = _over_pairs(different, mask, pairs.count, settings)
    return photometric, _over_pairs(apart, valid, pairs.count, settings), valid.float().mean()


def _over_pairs(values: Tensor, mask: Tensor, count: int, settings: Consistency) -> Tensor:
    """Masked means of the pairs of one direction (batch and all), then their mean or sum."""
    parts = zip(values.chunk(count), mask.chunk(count), strict=True)
    means = torch.stack([masked_mean(value, part) * (part.sum() > settings.least_pixels) for value, part in parts])
    return means.mean() if settings.reduction == "mean" else means.sum()


def _smoothness(snippet: Snippet, settings: Consistency) -> Tensor:
    depth, image = snippet.depth.flatten(0, 1), snippet.images.flatten(0, 1)
    known = depth.clamp(min=1e-12)
    smooth = mean_normalised(1 / known if settings.smooth == "inverse_depth" else known)
    mean = edge_aware_smoothness(smooth, image)
    return mean if settings.reduction == "mean" else mean * snippet.images.shape[1]
