"""Do the depths of two views agree? SC-SfMLearner (Bian et al., NeurIPS 2019), the paper's L_g."""

from __future__ import annotations

from torch import Tensor

LEAST_SUM = 1e-6  # motion units


def depth_difference(computed: Tensor, sampled: Tensor) -> Tensor:
    """|a - b| / (a + b) in 0..1 of computed and sampled depth (B, 1, H, W); 0 where they agree.

    One minus it is the weight that SC-SfMLearner gives a pixel's photometric difference: what moves by itself, or is
    hidden in one of the views, disagrees in depth.
    """
    return ((computed - sampled).abs() / (computed + sampled).clamp(min=LEAST_SUM)).clamp(0, 1)
