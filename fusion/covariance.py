"""Marginal covariances from one METIS elimination: the Bayes tree answers for every node.

`gtsam.Marginals` takes no ordering and fails on very long chains; the tree does not.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import S, X
from numpy.typing import NDArray

from vio.errors import EstimationError

Array = NDArray[np.float64]


def marginal_covariances(gaussian: gtsam.GaussianFactorGraph, nodes: int, segments: int) -> tuple[Array, Array]:
    """Pose covariances (nodes, 6, 6), body axes, rotation first, and log-scale variances (segments,).

    Raises:
        EstimationError: the linear system has no unique solution.
    """
    try:
        ordering = gtsam.Ordering.MetisGaussianFactorGraph(gaussian)
        tree = gaussian.eliminateMultifrontal(ordering)
        # Asked in key order, every query reuses the cached separators of the one before.
        information = np.array([tree.marginalFactor(X(k)).information() for k in range(nodes)]).reshape(-1, 6, 6)
        scale = np.array([tree.marginalFactor(S(k)).information()[0, 0] for k in range(segments)])
    except RuntimeError as error:
        raise EstimationError(f"graph: covariances are indeterminate ({str(error).strip().splitlines()[0]})") from None
    return _invert(information), 1.0 / scale


def _invert(information: Array) -> Array:
    """Invert after scaling to unit diagonal: radians and metres differ by many orders of magnitude."""
    root = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    scaled = information / (root[:, :, None] * root[:, None, :])
    cov = np.linalg.inv(scaled) / (root[:, :, None] * root[:, None, :])
    symmetric: Array = 0.5 * (cov + np.swapaxes(cov, 1, 2))
    return symmetric
