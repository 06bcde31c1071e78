"""Whether a network sees quick and slow motion at one scale.

An IMU measures scale on quick motion: accelerations. A network that shows quick motion smaller than slow progress
(blur, and its regression towards what is usual) then leads to a scale that is right for the shaking and wrong for the
path.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from learned.measured import Measured
from vio import se3

Array = NDArray[np.float64]

PROGRESS_STEPS = 10
"""Steps over which motion counts as progress: shaking has averaged out."""
FEWEST_BLOCKS = 3


def scale_gain_sd(measured: Sequence[Measured]) -> float:
    """Root mean square, over recordings, of the log scale of all steps over that of slow progress; 0 if none is long.

    The first is the least squares scale of single steps, as an estimator sees them; the second compares path lengths
    in steps of `PROGRESS_STEPS`.
    """
    found = [_log_ratio(m.T_i_j, m.T_true_m) for m in measured if len(m) >= FEWEST_BLOCKS * PROGRESS_STEPS]
    return float(np.sqrt(np.mean(np.square(found)))) if found else 0.0


def _log_ratio(T_i_j: Array, T_true_m: Array) -> float:
    R = se3.chain(T_true_m)[:-1, :3, :3]  # so that errors of rotation do not count
    seen, true = (np.einsum("nij,nj->ni", R, T[:, :3, 3]) for T in (T_i_j, T_true_m))
    steps = -np.log(max(np.sum(seen * true), 1e-12) / np.sum(true * true))
    return float(steps - np.log(_progress(true) / _progress(seen)))


def _progress(steps: Array) -> float:
    """Path length in long steps."""
    count = len(steps) // PROGRESS_STEPS
    blocks = steps[:count * PROGRESS_STEPS].reshape(count, PROGRESS_STEPS, 3).sum(axis=1)
    return float(np.linalg.norm(blocks, axis=1).sum())
