"""How near everything is, taught by how far the camera moved: a step seen in depths, and its length in metres.

Two images show a step as a share of the depth, and nothing but a known length says how deep that is. A refined
trajectory knows it, for its accelerometer measured it. Ours; the nearest published relative scales poses by odometry
from wheels (Guizilini et al., 2020), with its gradient into the pose.
"""

from __future__ import annotations

import torch
from torch import Tensor

from learned.losses.terms import full_precision

UNIT_M = 0.02
"""What one motion unit is taught to be."""
ROUNDING_M = 1e-3
"""A refined step is known to about a millimetre: shorter ones weigh less."""


def depth_from_steps(depth_i: Tensor, T_i_j: Tensor, step_m: Tensor) -> Tensor:
    """Weighted mean |log ratio| of steps in motion units to their lengths; the gradient flows into depth alone.

    Args:
        depth_i: (N, 1, H, W) of the frame whose depth the translation of T_i_j is told in [motion units].
        T_i_j: (N, 4, 4) with `PoseParametrisation.in_depths` [motion units].
        step_m: (N,) length of the same step [m], NaN where it is not known.
    """
    nearness = full_precision(depth_i).clamp(min=1e-12).log().mean((1, 2, 3))
    step = full_precision(T_i_j[:, :3, 3]).detach().norm(dim=1)
    known = torch.isfinite(step_m) & (step > 1e-6)
    length = torch.where(known, step_m.to(step.dtype), 1.0)
    wanted = (length / UNIT_M / torch.where(known, step, 1.0)).clamp(min=1e-6).log() + nearness.detach()
    weight = torch.where(known, length ** 2 / (length ** 2 + ROUNDING_M ** 2), 0.0)
    return (weight * (wanted - nearness).abs()).sum() / weight.sum().clamp(min=1e-6)
