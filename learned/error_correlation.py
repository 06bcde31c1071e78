"""How long errors of a network's translations last.

A network that sees a wall too slanted, or a fold too near, does so for several frames. Errors that stay alike add up
along a path where independent ones average out, and no covariance of a single motion says so.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from learned.inference import SIGNALS
from learned.measured import Measured
from learned.uncertainty import UncertaintyModel

Array = NDArray[np.float64]

LONGEST_LAG = 8
"""Steps over which errors are compared."""
LARGEST = 4.0
"""Whitened errors are cut to this: one gross error is no correlation."""


def error_correlation_s(measured: Sequence[Measured], model: UncertaintyModel) -> float:
    """Time constant [s] of an exponential decay with the same sum over all lags as the errors' autocorrelation.

    0 where errors do not last.

    Errors of translation at each recording's own true scale, whitened by the network's own covariances; lags are summed
    up to the first at which nothing is left. What counts along a path is that sum: n errors of variance σ² add up to
    n σ² (1 + 2 Σ ρ).
    """
    products, counts = np.zeros(LONGEST_LAG + 1), np.zeros(LONGEST_LAG + 1)
    for one in measured:
        errors = _whitened(one, model)
        for lag in range(min(LONGEST_LAG, len(errors) - 1) + 1):
            products[lag] += float((errors[:len(errors) - lag] * errors[lag:]).sum())
            counts[lag] += len(errors) - lag
    if counts[-1] == 0 or products[0] <= 0:
        return 0.0
    alike = (products / counts)[1:] / (products[0] / counts[0])
    left = np.flatnonzero(alike <= 0)
    total = float(alike[:left[0] if len(left) else None].sum())
    if total <= 0:
        return 0.0
    step_s = float(np.median(np.concatenate([one.step_s for one in measured])))
    return step_s / float(np.log1p(1 / total))  # Σ ρ^k = ρ / (1 - ρ) = total


def _whitened(measured: Measured, model: UncertaintyModel) -> Array:
    """(N, 3)"""
    errors = measured.errors(measured.log_scale)[:, 3:]
    lower = np.linalg.cholesky(model.covariance(measured.signals, SIGNALS)[:, 3:, 3:])
    white: Array = np.linalg.solve(lower, errors[:, :, None])[:, :, 0]
    return np.clip(white, -LARGEST, LARGEST)
