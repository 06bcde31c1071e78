"""A few neighbouring frames with what networks said about them, and their directed pairs as one batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from learned.camera_rays import CameraBatch
from learned.lie import inverse
from vio.errors import ConfigError

Motions = Mapping[tuple[int, int], Tensor]


@dataclass(frozen=True)
class Snippet:
    """B snippets of F frames."""

    images: Tensor
    """(B, F, C, H, W) in 0..1."""
    depth: Tensor
    """(B, F, 1, H, W) in motion units."""
    motions: Motions
    """`T_i_j` (B, 4, 4) under (i, j): the pose of the source camera j in the target camera i; any pairs, any order."""
    cameras: CameraBatch
    """B cameras, of all frames of a snippet."""
    usable: Tensor | None = None
    """(B, F, 1, H, W) bool: outside the vignette, without highlights; None = everywhere."""

    def luminance(self) -> Snippet:
        """The same with grey images: the mean of the channels."""
        return replace(self, images=self.images.mean(2, keepdim=True))

    def halved(self) -> Snippet:
        """The same at half the size: areas averaged, depth through its inverse, usable where all four pixels are.

        Raises:
            ConfigError: an odd width or height.
        """
        height, width = self.images.shape[-2:]
        if height % 2 or width % 2:
            raise ConfigError(f"losses: images of {width} x {height} pixels cannot be halved; use fewer pyramid levels "
                              "or a size that is a multiple of a higher power of two")
        known = self.depth > 0
        nearness = _halved(torch.where(known, 1 / torch.where(known, self.depth, 1.0), 0.0))
        depth = torch.where(nearness > 0, 1 / torch.where(nearness > 0, nearness, 1.0), 0.0)
        usable = self.usable
        return replace(
            self, images=_halved(self.images), depth=depth,
            cameras=self.cameras.resized(width // 2, height // 2),
            usable=None if usable is None else _halved(usable.to(self.images.dtype)) > 0.999)


@dataclass(frozen=True)
class Pairs:
    """P directed pairs of B snippets, one after the other: N = P · B rows."""

    target: Tensor
    """(N, C, H, W) image."""
    source: Tensor
    """(N, C, H, W) image."""
    target_depth: Tensor
    """(N, 1, H, W)"""
    source_depth: Tensor
    """(N, 1, H, W)"""
    T_target_source: Tensor
    """(N, 4, 4)"""
    cameras: CameraBatch
    """N cameras."""
    target_usable: Tensor | None
    """(N, 1, H, W) bool"""
    source_usable: Tensor | None
    """(N, 1, H, W) bool"""
    count: int
    """P"""


def directed_pairs(snippet: Snippet) -> Pairs:
    """The pairs under `snippet.motions`, in their order.

    Raises:
        ConfigError: no pair, or a pair of frames that the snippet lacks.
    """
    frames, pairs = snippet.images.shape[1], list(snippet.motions)
    if not pairs or any(not (0 <= i < frames and 0 <= j < frames) or i == j for i, j in pairs):
        raise ConfigError(f"losses: pairs {pairs} in snippets of {frames} frames; give motions between two of them")

    def stack(values: Tensor, side: int) -> Tensor:
        return torch.cat([values[:, pair[side]] for pair in pairs])
    usable = snippet.usable
    return Pairs(
        stack(snippet.images, 0), stack(snippet.images, 1), stack(snippet.depth, 0), stack(snippet.depth, 1),
        torch.cat([snippet.motions[pair] for pair in pairs]), snippet.cameras.repeated(len(pairs)),
        None if usable is None else stack(usable, 0), None if usable is None else stack(usable, 1), len(pairs))


def both_directions(motions: Motions) -> dict[tuple[int, int], Tensor]:
    """The given motions and the inverse of each, for networks that look at every pair once."""
    return dict(motions) | {(j, i): inverse(T) for (i, j), T in motions.items()}


def _halved(values: Tensor) -> Tensor:
    half = F.avg_pool2d(values.flatten(0, 1), 2)
    return half.view(*values.shape[:2], *half.shape[1:])
