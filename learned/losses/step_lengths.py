"""How long steps are, told by a refined trajectory, as a gyro tells how far they turn.

Two images show a step as a share of the depth, and nothing but a known length says how deep that is. A refined
trajectory knows it, for its accelerometer measured it: in the warp it takes the place of the network's length, so that
depth becomes metric and alike over a whole recording, and the network learns the length beside it. Ours; poses with
wheel odometry's lengths are an old idea, see "velocity supervision" of Guizilini et al. (CVPR 2020).
"""

from __future__ import annotations

import torch
from torch import Tensor

from learned.losses.terms import full_precision

ROUNDING_M = 1e-3
"""A refined step is known to about a millimetre: shorter ones say little."""
SHORTEST = 1e-6  # motion units


def with_length(T_i_j: Tensor, step_m: Tensor, unit_m: float) -> Tensor:
    """Motions (N, 4, 4) in units of unit_m with the lengths step_m (N,) [m] where known; directions stay."""
    translation = full_precision(T_i_j[:, :3, 3])
    length = translation.norm(dim=1).clamp(min=SHORTEST)
    known = torch.isfinite(step_m)
    wanted = torch.where(known, step_m.to(length.dtype) / unit_m, length)
    out = T_i_j.clone()
    out[:, :3, 3] = (translation * (wanted / length)[:, None]).to(out.dtype)
    return out


def told_by(step_m: Tensor) -> Tensor:
    """How much steps of known lengths (any shape) [m] can tell: 0..1, 0 where none is known."""
    known = torch.isfinite(step_m)
    length = torch.where(known, step_m, 0.0)
    return length**2 / (length**2 + ROUNDING_M**2)


def length_difference(T_i_j: Tensor, step_m: Tensor, unit_m: float, depth_i: Tensor | None) -> Tensor:
    """Weighted mean |log ratio| of the network's lengths to the known ones.

    Args:
        T_i_j: (N, 4, 4) of the network [motion units].
        step_m: (N,) known lengths [m], NaN where none is.
        unit_m: metres that a motion unit stands for.
        depth_i: (N, 1, H, W) whose geometric mean is a factor of the translation; no gradient flows into it. None
            where the network tells translations without depth.
    """
    step = full_precision(T_i_j[:, :3, 3]).norm(dim=1)
    if depth_i is not None:
        nearness = full_precision(depth_i).clamp(min=1e-12).log().mean((1, 2, 3))
        step = step * (nearness.detach() - nearness).exp()
    known = torch.isfinite(step_m) & (step.detach() > SHORTEST)
    length = torch.where(known, step_m.to(step.dtype), 1.0)
    weight = torch.where(known, told_by(length), 0.0)
    found = torch.where(known, step, 1.0).log()
    wanted = (length / unit_m).clamp(min=1e-6).log()
    return (weight * (found - wanted).abs()).sum() / weight.sum().clamp(min=1e-6)
