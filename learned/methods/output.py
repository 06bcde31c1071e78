"""What a method returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class DepthPyramid:
    """One frame's depth at the scales a method predicts, finest first."""

    disparity: tuple[Tensor, ...]
    """(B, 1, h, w) each, in 0..1: what the published losses smooth and compare."""
    depth: tuple[Tensor, ...]
    """(B, 1, h, w) each, z-depth in motion units."""
    nearness: Tensor | None = None
    """(B,) the number that brings everything in the image nearer, for a method that tells one."""


@dataclass(frozen=True)
class MethodOutput:
    """Depth and motion of B snippets; frames are numbered within the snippet."""

    depth: dict[int, DepthPyramid]
    """Of every frame asked for."""
    T_i_j: dict[tuple[int, int], Tensor]
    """(i, j) → (B, 4, 4), the pose of camera j in camera i: points of camera j to camera i, motion units."""
    snr_depth: dict[int, Tensor]
    """Frame → (B, blocks) SNR in the depth encoder; empty where the fusion has none."""
    snr_pose: dict[tuple[int, int], Tensor]
    """Pair → (B, blocks) SNR in the pose encoder; empty where the fusion has none."""
    intrinsics: dict[tuple[int, int], Tensor]
    """Pair → K (B, 3, 3) in pixels of the frames, for a method that estimates it; else empty."""


def snr_summary(output: MethodOutput) -> dict[str, float]:
    """Mean and deviation of the SNR over the batch, per network and block, for a log.

    A mean that stays where it started, or a deviation of zero over different windows, is a branch that does not learn;
    a mean at the floor is a block that lets nothing through. The loss shows neither.

    Returns:
        {"snr_depth_0_mean": …, "snr_depth_0_sd": …, …, "snr_pose_4_sd": …}; empty without SNR.
    """
    summary: dict[str, float] = {}
    for name, values in (("depth", list(output.snr_depth.values())), ("pose", list(output.snr_pose.values()))):
        if values:
            joined = torch.cat([v.detach() for v in values])
            for block in range(joined.shape[1]):
                summary[f"snr_{name}_{block}_mean"] = float(joined[:, block].mean())
                summary[f"snr_{name}_{block}_sd"] = float(joined[:, block].std(correction=0))
    return summary
