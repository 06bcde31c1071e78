"""What a trained method says about pairs of frames, and the signals that tell how far to trust it.

The network looks at every pair in both orders; the motion is the mean of the two, and how far they are apart is one of
the signals. No truth and no gyro rotation enters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from learned.camera_rays import CameraBatch
from learned.lie import halfway, inverse, so3_log
from learned.losses.photometric import Photometric, countable, match_brightness, photometric_map
from learned.methods import Method
from learned.warping import WHOLE, DepthKind, project_depth, sample, to_z_depth

SIGNALS = ("photometric", "unwarped", "length", "rotation", "order", "order_rotation", "depth", "snr")
"""Names of the signals, all as natural logarithms: photometric residual of the warp, difference of the unmoved images,
step length over median depth, rotation angle, distance between the two orders' translations over their length, and of
their rotations, median depth, mean SNR (0 without one)."""
LEAST = 1e-4
DARK = 0.01
"""Grey level of 0..1 up to which a pixel lies in the vignette."""


@dataclass(frozen=True)
class PairEstimate:
    """B pairs."""

    T_i_j: Tensor
    """(B, 4, 4) pose of camera j in camera i, motion units."""
    z_depth_i: Tensor
    """(B, 1, H, W) z-depth of frame i in motion units, 0 where the camera sees nothing."""
    snr: Tensor | None
    """(B,) geometric mean of the SNR over the blocks of both networks; None without vibration."""
    signals: Tensor
    """(B, S) the signals that were wanted."""


@dataclass(frozen=True)
class Shots:
    """F frames that make up B pairs."""

    frames: Tensor
    """(F, 3, H, W)."""
    i: tuple[int, ...]
    """B numbers of the earlier frames among them."""
    j: tuple[int, ...]
    """B numbers of the later ones."""
    pair: list[int]
    """F numbers of the pairs whose window belongs to the frame: the one it begins, or else ends."""


def distinct(frames: Tensor) -> Shots:
    """Pairs (B, 2, 3, H, W) told apart into frames: where a pair begins with what the one before ended with, one."""
    shown, pair, first, second = [frames[0, 0]], [0], [0], [1]
    for k in range(1, len(frames)):
        shown.append(frames[k - 1, 1])
        pair.append(k)
        if not torch.equal(frames[k, 0], frames[k - 1, 1]):
            pair[-1] = k - 1
            shown.append(frames[k, 0])
            pair.append(k)
        first.append(len(shown) - 1)
        second.append(len(shown))
    shown.append(frames[-1, 1])
    return Shots(torch.stack(shown), tuple(first), tuple(second), [*pair, len(frames) - 1])


@torch.no_grad()
def estimate_pairs(method: Method, frames: Tensor, vibration: Tensor | None, cameras: CameraBatch,
                   depth_kind: DepthKind, wanted: Sequence[str] = SIGNALS) -> PairEstimate:
    """Measure pairs of frames.

    Args:
        method: in eval mode.
        frames: (B, 2, 3, H, W) in 0..1, the earlier frame first.
        vibration: (B, 6, n) windows centred at the earlier frames; None for a vision-only method.
        cameras: B cameras of images of that size.
        depth_kind: what the depth network's numbers mean.
        wanted: names of the signals to compute.
    """
    shots = distinct(frames)
    windows = None if vibration is None else vibration[shots.pair][None]
    ahead = list(zip(shots.i, shots.j, strict=True))
    out = method(shots.frames[None], windows, depth_frames=shots.i, pairs=[*ahead, *((j, i) for i, j in ahead)])
    depth = torch.cat([out.depth[i].depth[0] for i in shots.i]).float()
    there = torch.cat([out.T_i_j[i, j] for i, j in ahead]).float()
    back = inverse(torch.cat([out.T_i_j[j, i] for i, j in ahead]).float())
    T = halfway(there, back)
    snr = None
    if out.snr_depth:
        every = torch.cat([torch.cat([out.snr_depth[i], out.snr_pose[i, j]], 1) for i, j in ahead]).float()
        snr = every.clamp(min=LEAST).log().mean(1).exp()
    z = to_z_depth(depth, cameras, depth_kind)
    found = _motion_signals(T, there, back, snr)
    if not {"depth", "length"}.isdisjoint(wanted):
        found["depth"] = depth.flatten(1).median(1).values
        found["length"] = T[:, :3, 3].norm(dim=1) / found["depth"]
    if not {"photometric", "unwarped"}.isdisjoint(wanted):
        found["photometric"], found["unwarped"] = _photometric_signals(shots, depth, T, cameras, depth_kind)
    signals = [found[name].clamp(min=LEAST).log() for name in wanted]
    return PairEstimate(T, z, snr, torch.stack(signals, 1) if signals else T.new_zeros(len(T), 0))


def _motion_signals(T: Tensor, there: Tensor, back: Tensor, snr: Tensor | None) -> dict[str, Tensor]:
    """What the motions tell, (B,) each."""
    length = T[:, :3, 3].norm(dim=1)
    apart = (there[:, :3, 3] - back[:, :3, 3]).norm(dim=1)
    turn = so3_log(there[:, :3, :3].transpose(1, 2) @ back[:, :3, :3]).norm(dim=1)
    return {"rotation": so3_log(T[:, :3, :3]).norm(dim=1), "order": apart / (length + 10 * LEAST),
            "order_rotation": turn, "snr": torch.ones_like(length) if snr is None else snr}


def _photometric_signals(shots: Shots, depth: Tensor, T: Tensor, cameras: CameraBatch,
                         depth_kind: DepthKind) -> tuple[Tensor, Tensor]:
    """How far the second frames, warped and as they are, are from the first, at half the size, (B,) each."""
    every = F.avg_pool2d(shots.frames.mean(1, keepdim=True), 2)
    first, second = every[list(shots.i)], every[list(shots.j)]
    where = project_depth(1 / F.avg_pool2d(1 / depth, 2), T, cameras.halved, depth_kind)
    pixels = torch.where(where.valid, where.pixels, torch.zeros_like(where.pixels))
    seen = sample(torch.cat([second, (second > DARK).to(second.dtype)], 1), pixels)
    valid = where.valid & (first > DARK) & (seen[:, 1:] > WHOLE)
    settings, target = Photometric(), first.repeat(2, 1, 1, 1)
    shown = match_brightness(torch.cat([seen[:, :1], second]), target, valid.repeat(2, 1, 1, 1), settings)
    different = torch.unflatten(photometric_map(shown, target, settings), 0, (2, len(first)))
    weights = countable(valid, settings).to(different.dtype)
    warped, still = (different * weights).sum((2, 3, 4)) / weights.sum((1, 2, 3)).clamp(min=1)
    return warped, still
