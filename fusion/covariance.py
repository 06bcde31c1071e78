"""Marginal covariances from one METIS elimination: the Bayes tree answers for every node.

`gtsam.Marginals` takes no ordering and fails on very long chains; the tree does not.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import S, X
from numpy.typing import NDArray

from vio.errors import EstimationError

Array = NDArray[np.float64]

LARGEST_VARIANCE_M2 = 1e12
"""Position variance [m²] that only a graph without a gauge has: QR answers for it too, with rounding errors."""


def marginal_covariances(gaussian: gtsam.GaussianFactorGraph, nodes: int, segments: int) -> tuple[Array, Array]:
    """Pose covariances (nodes, 6, 6), body axes, rotation first, and log-scale variances (segments,).

    Raises:
        EstimationError: the linear system has no unique solution.
    """
    ordering = gtsam.Ordering.MetisGaussianFactorGraph(gaussian)
    try:
        information, scale = _marginals(gaussian, ordering, nodes, segments)
    except RuntimeError:  # indeterminate under Cholesky, which squares the condition: QR does not
        try:
            information, scale = _marginals(gaussian, ordering, nodes, segments, gtsam.EliminateQR)
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[0]
            raise EstimationError(f"graph: covariances are indeterminate ({reason})") from None
    cov = _invert(information)
    lost = ~(np.diagonal(cov[:, 3:, 3:], axis1=1, axis2=2).max(axis=1, initial=0.0) < LARGEST_VARIANCE_M2)
    if lost.any():
        raise EstimationError(f"graph: covariances are indeterminate (nothing holds the position of pose "
                              f"{int(np.argmax(lost))})")
    return cov, 1.0 / scale


def _marginals(gaussian: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, nodes: int, segments: int,
               *eliminate: Any) -> tuple[Array, Array]:
    """Marginal information of poses (nodes, 6, 6) and log scales (segments,), under one elimination function."""
    tree = gaussian.eliminateMultifrontal(ordering, *eliminate)
    # Asked in key order, every query reuses the cached separators of the one before.
    poses = [tree.marginalFactor(X(k), *eliminate).information() for k in range(nodes)]
    scales = [tree.marginalFactor(S(k), *eliminate).information()[0, 0] for k in range(segments)]
    return np.array(poses).reshape(-1, 6, 6), np.array(scales)


def _invert(information: Array) -> Array:
    """Invert after scaling to unit diagonal: radians and metres differ by many orders of magnitude."""
    root = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    scaled = information / (root[:, :, None] * root[:, None, :])
    cov = np.linalg.inv(scaled) / (root[:, :, None] * root[:, None, :])
    symmetric: Array = 0.5 * (cov + np.swapaxes(cov, 1, 2))
    return symmetric
