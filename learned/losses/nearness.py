"""How near everything in an image is, found by trying: one factor on its whole depth map, all else being known.

A gradient sees no farther than neighbouring pixels look alike. Against a wall three times nearer than predicted, a step
of known length moves the image by many pixels more than the warp says, and no gradient leads there. So the factor that
warps the image best is searched, and the one number per image that tells nearness learns it. Ours; plane-sweep stereo
(Collins, CVPR 1996) searches likewise, for every pixel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from learned.losses.consistency import Consistency
from learned.losses.photometric import compare
from learned.losses.snippet import Pairs, Snippet, directed_pairs
from learned.losses.terms import full_precision
from learned.warping import synthesise

LOG_FACTORS = tuple(float(x) for x in np.linspace(-1.8, 0.6, 17))
"""Tried on depth; 0 is among them."""
SMALL_PX = 64
"""Images are halved while their smaller side stays at least this: the search needs no fine detail."""
LEAST_SHARE = 0.3
"""Of the usable pixels that must be seen in both images for a factor to be judged."""
TEMPERATURE = 0.05
"""Share by which an error must exceed the least one for a factor to count e times less."""
KNOWN_SD = 0.1
"""Spread of the likely factors at which a search counts half. With these two, on calibration recordings: found to 0.055
where the network is off by 0.114, and to 0.25 where it takes a wall for much farther than it is, by 0.75."""

SMALL = 0.15
"""Log factors that a search errs by anyway."""


@dataclass(frozen=True)
class FoundNearness:
    """For F frames of B snippets."""

    log_factor: Tensor
    """(B, F) that its depth wants to be multiplied by; 0 where nothing was found."""
    weight: Tensor
    """(B, F) 0..1, 0 where nothing was found."""


@torch.no_grad()
def search_nearness(snippet: Snippet, step_weight: Mapping[tuple[int, int], Tensor],
                    settings: Consistency) -> FoundNearness:
    """The factor on every frame's depth with which its neighbours warp to it best.

    Args:
        snippet: with motions of known length.
        step_weight: how much each of its motions can tell (B,), 0 = nothing.
        settings: how images are compared, and what depth means.
    """
    level = snippet.luminance()
    while not any(side % 2 or side // 2 < SMALL_PX for side in level.images.shape[-2:]):
        level = level.halved()
    pairs, order = directed_pairs(level), list(snippet.motions)
    errors = torch.stack([_errors(pairs, factor, settings) for factor in LOG_FACTORS])
    errors = errors.view(len(LOG_FACTORS), len(order), -1)
    frames = range(snippet.images.shape[1])
    weight = torch.stack([step_weight[pair].to(errors.dtype) for pair in order])
    of_frame = [_joined(errors, weight, [n for n, pair in enumerate(order) if pair[0] == k]) for k in frames]
    return _least(torch.stack(of_frame, -1))


def nearness_difference(nearness: Tensor, found: FoundNearness) -> Tensor:
    """Weighted mean of the factors that were found, with a gradient for the number that brings everything nearer.

    Log factors within `SMALL` count by their square: by their size, all frames that are nearly right would pull as hard
    as those that are far off, and the number was measured to jump about.

    Args:
        nearness: (B, F) the network's numbers, which add to the log of inverse depth.
        found: for the same frames.
    """
    nearness = full_precision(nearness)
    weight = found.weight.to(nearness.dtype)
    apart = F.smooth_l1_loss(nearness.detach() - nearness, found.log_factor.to(nearness.dtype), reduction="none",
                             beta=SMALL)
    return (weight * apart).sum() / weight.sum().clamp(min=1e-6)


def _errors(pairs: Pairs, log_factor: float, settings: Consistency) -> Tensor:
    """(N,) mean difference of images with the targets' depth so much farther; NaN where too little is seen."""
    depth = pairs.target_depth * float(np.exp(log_factor))
    seen = synthesise(pairs.source, pairs.source_depth, depth, pairs.T_target_source, pairs.cameras,
                      settings.depth_kind, pairs.target_usable, pairs.source_usable, settings.padding)
    different, mask = compare(seen.image, pairs.target, seen.valid, settings.photometric)
    count = mask.sum((1, 2, 3))
    usable = mask[0].numel() if pairs.target_usable is None else pairs.target_usable.sum((1, 2, 3))
    mean = (different * mask).sum((1, 2, 3)) / count.clamp(min=1)
    return torch.where(count > LEAST_SHARE * usable, mean, torch.nan)


def _joined(errors: Tensor, weight: Tensor, pairs: list[int]) -> Tensor:
    """(K, B) weighted mean of the errors (K, P, B) of some pairs; NaN where none can tell."""
    chosen = errors[:, pairs]
    w = torch.where(torch.isfinite(chosen), weight[pairs], 0.0)
    total = w.sum(1)
    return torch.where(total > LEAST_SHARE, (torch.nan_to_num(chosen) * w).sum(1) / total.clamp(min=1e-9), torch.nan)


def _least(errors: Tensor) -> FoundNearness:
    """Where errors (K, B, F) are least, by a parabola through three of them, and how sharply."""
    factors = torch.tensor(LOG_FACTORS, dtype=errors.dtype, device=errors.device)
    filled = torch.where(torch.isfinite(errors), errors, torch.inf)
    least, k = filled.min(0)
    inner = k.clamp(1, len(factors) - 2)
    before, at, after = (filled.gather(0, (inner + d)[None])[0] for d in (-1, 0, 1))
    bend = before - 2 * at + after
    known = (inner == k) & torch.isfinite(bend) & (bend > 0)
    offset = torch.where(known, 0.5 * (before - after) / torch.where(known, bend, 1.0), 0.0)
    likely = torch.where(torch.isfinite(filled), torch.exp(-(filled / least.clamp(min=1e-9) - 1) / TEMPERATURE), 0.0)
    likely = torch.where(known, likely, 1.0)
    likely = likely / likely.sum(0)
    steps = factors.view(-1, 1, 1)
    variance = (likely * (steps - (likely * steps).sum(0)) ** 2).sum(0)
    return FoundNearness(torch.where(known, factors[inner] + (factors[1] - factors[0]) * offset, 0.0),
                         torch.where(known, KNOWN_SD**2 / (KNOWN_SD**2 + variance), 0.0))
