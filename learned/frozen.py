"""A method made ready for use: a copy without gradients that predicts the same, up to rounding, in less time.

Batch norms become part of the convolutions before them, convolutions work on channels that lie side by side in memory,
and two parts are replaced by quicker ones (`vibration_fusion/frozen_fourier.py`, `networks/frozen_correlation.py`).
The copy is for prediction only: what is trained, stored and told apart by a digest is the method itself.
"""

from __future__ import annotations

from copy import deepcopy
from itertools import pairwise

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from learned.methods.method import Method
from learned.networks.correlation_pose import CorrelationPoseNetwork
from learned.networks.frozen_correlation import FrozenCorrelationPose
from learned.vibration_fusion.fourier import FourierFusion
from learned.vibration_fusion.frozen_fourier import FrozenFourier


def frozen(method: Method) -> Method:
    """A copy of a method for prediction, on the same device; the method itself stays as it is."""
    with torch.inference_mode(False), torch.no_grad():
        copy = deepcopy(method).eval().requires_grad_(False)
        for part in list(copy.modules()):
            _fold_norms(part)
            for name, child in part.named_children():
                if isinstance(child, FourierFusion) and child.kernel is not None:
                    setattr(part, name, FrozenFourier(child))
                elif isinstance(child, nn.ReLU):
                    child.inplace = True
        if isinstance(copy.pose, CorrelationPoseNetwork):
            copy.pose = FrozenCorrelationPose(copy.pose)
        for part in copy.modules():
            if isinstance(part, nn.Conv2d):
                part.weight.data = part.weight.contiguous(memory_format=torch.channels_last)
        return copy


def _fold_norms(part: nn.Module) -> None:
    """Batch norms that follow a convolution among the children of a module, by order or by name, become part of it."""
    children = dict(part.named_children())
    if isinstance(part, nn.Sequential):
        pairs = list(pairwise(children))
    else:
        pairs = [(name, name.replace("conv", "bn")) for name in children if name.startswith("conv")]
    for first, second in pairs:
        convolution, norm = children[first], children.get(second)
        if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            setattr(part, first, fuse_conv_bn_eval(convolution, norm))
            setattr(part, second, nn.Identity())
