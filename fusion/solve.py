"""Gauss-Newton on native factors plus the batched motions, solved by METIS-ordered Cholesky.

METIS never failed on a healthy chain of 86,400 nodes, where COLAMD + Cholesky can turn out
indeterminate. When Cholesky does fail, the same step is solved by QR.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import gtsam
import numpy as np
from gtsam.symbol_shorthand import S, X
from numpy.typing import NDArray

from fusion.graph import Values, read_log_scales, read_poses
from fusion.scaled_motion import Linearized, ScaledMotions, linearize, residuals
from vio.errors import EstimationError

Array = NDArray[np.float64]
Which: TypeAlias = "NDArray[np.int64] | slice"

BLOCK_MOTIONS = 1500
"""Motions handled at a time: what stays in a processor's cache is several times faster."""
SMALLEST_STEP = 1 / 128
GROSS = 30.0
"""Whitened norm beyond which the Huber loss only grows like a logarithm: a motion that claims 0.05 mm and is off by
a metre would otherwise bend everything that the IMU does not hold."""


@dataclass(frozen=True)
class MotionTerm:
    """The relative motions as one term of the cost."""

    motions: ScaledMotions
    segment: NDArray[np.int64] | None
    """(N,) scale segment of every motion; None when scale is held."""
    held_log_scale: float
    """Used where `segment` is None."""
    huber: float | Array | None
    """Threshold of the Huber loss (logarithmic beyond `GROSS`), of all or (N,) of each; None for plain weights."""
    weight: Array
    """(N,) fixed weights (the gate) on top of the loss."""
    first_node: int = 0
    """Key of the motions' node 0."""

    @property
    def segments(self) -> int:
        """Number of scale variables."""
        return 0 if self.segment is None else int(self.segment.max()) + 1

    def log_scale(self, values: Values) -> Array:
        """(N,) log scale that applies to every motion."""
        if self.segment is None:
            return np.full(len(self.motions), self.held_log_scale)
        return np.asarray(read_log_scales(values, self.segments)[self.segment])

    def losses(self, squared_norm: Array, which: Which | None = None) -> tuple[float, Array]:
        """Total cost and the weights of the next linear step, of all motions or of some (K,)."""
        fixed = self.weight if which is None else self.weight[which]
        if self.huber is None:
            return float(0.5 * (fixed * squared_norm).sum()), fixed
        k = self.huber if which is None or np.ndim(self.huber) == 0 else np.asarray(self.huber)[which]
        norm = np.maximum(np.sqrt(squared_norm), 1e-12)
        straight = k * np.minimum(norm, GROSS) - 0.5 * k**2
        loss = np.where(norm <= k, 0.5 * squared_norm, straight + k * GROSS * np.log(np.maximum(norm / GROSS, 1.0)))
        weight = np.where(norm <= k, 1.0, k / norm * np.minimum(1.0, GROSS / norm))
        return float((fixed * loss).sum()), fixed * weight

    def blocks(self, values: Values, which: Which, log_scale: Array) -> Linearized:
        """Unweighted linearisation of some motions (K,), given the log scales (N,) of all."""
        return linearize(self.motions.select(which), *read_poses(values), log_scale[which])

    def cost(self, values: Values) -> float:
        """Robust cost at the given values."""
        return self.losses(self.squared_norm(values))[0]

    def squared_norm(self, values: Values) -> Array:
        """(N,) whitened residuals squared, unweighted."""
        (R, p), log_scale = read_poses(values), self.log_scale(values)
        squared = np.empty(len(self.motions))
        for first in range(0, len(squared), BLOCK_MOTIONS):
            cut = slice(first, first + BLOCK_MOTIONS)
            r = residuals(self.motions.select(cut), R, p, log_scale[cut])
            squared[cut] = np.einsum("nk,nk->n", r, r)
        return squared

    def signal(self, values: Values) -> float:
        """Root mean square of the estimated steps over the motions' noise, per axis; gated motions left out."""
        blocks = linearize(self.motions, *read_poses(values), self.log_scale(values))
        squared = np.einsum("nki,nki->n", blocks.A_s, blocks.A_s)  # dr/ds is the whitened step itself
        return float(np.sqrt(np.average(squared, weights=self.weight) / 3))


@dataclass(frozen=True)
class Solution:
    """Where Gauss-Newton ended."""

    values: Any
    """`gtsam.Values`, or the `ChainState` of a chain."""
    squared_norm: Array
    """(N,) of the motions, unweighted."""
    native_cost: float
    """Of the native factors alone."""
    iterations: int


def linear_graph(native: gtsam.NonlinearFactorGraph, values: gtsam.Values, term: MotionTerm,
                 blocks: Linearized | None = None) -> gtsam.GaussianFactorGraph:
    """All factors linearised at `values`, the motions as `blocks` has them if given."""
    gaussian = native.linearize(values)
    _push(gaussian, blocks or linearize(term.motions, *read_poses(values), term.log_scale(values)), term)
    return gaussian


def _push(gaussian: gtsam.GaussianFactorGraph, blocks: Linearized, term: MotionTerm) -> None:
    root = np.sqrt(term.losses(blocks.squared_norm)[1])
    A_i, A_j, A_s = (_fortran(A * root[:, None, None]) for A in (blocks.A_i, blocks.A_j, blocks.A_s))
    b = blocks.b * root[:, None]
    unit = gtsam.noiseModel.Unit.Create(6)
    i, j = (term.motions.i + term.first_node).tolist(), (term.motions.j + term.first_node).tolist()
    if term.segment is None:
        for n in range(len(b)):
            gaussian.add(gtsam.JacobianFactor(X(i[n]), A_i[n], X(j[n]), A_j[n], b[n], unit))
        return
    segment = term.segment.tolist()
    for n in range(len(b)):
        gaussian.add(gtsam.JacobianFactor(X(i[n]), A_i[n], X(j[n]), A_j[n], S(segment[n]), A_s[n], b[n], unit))


def _fortran(blocks: Array) -> Array:
    """Column-major blocks, as Eigen stores them: pybind then copies without conversion."""
    return np.swapaxes(np.ascontiguousarray(np.swapaxes(blocks, 1, 2)), 1, 2)


def linear_step(gaussian: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.VectorValues:
    """Solve a linear graph by Cholesky, or by QR where that fails.

    Raises:
        EstimationError: the system has no unique solution.
    """
    try:
        return gaussian.optimize(ordering)
    except RuntimeError:  # indeterminate under Cholesky: gtsam has no class of its own for it
        pass
    try:
        return gaussian.optimize(ordering, gtsam.EliminateQR)
    except RuntimeError as error:
        raise EstimationError(f"graph: the linear system is indeterminate ({_first_line(error)})") from None


def _first_line(error: Exception) -> str:
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__


def gauss_newton(native: gtsam.NonlinearFactorGraph, values: gtsam.Values, term: MotionTerm, max_iterations: int,
                 relative_tolerance: float) -> Solution:
    """Minimise the native factors plus the motion term, halving any step that raises the cost.

    Raises:
        EstimationError: the cost is not finite, or no linear solver finds a step.
    """
    cost = native.error(values) + term.cost(values)
    ordering = None
    iterations = 0
    while iterations < max_iterations:
        if not np.isfinite(cost):
            raise EstimationError(f"graph: the cost is {cost} after {iterations} iterations")
        gaussian = linear_graph(native, values, term)
        if ordering is None:
            ordering = gtsam.Ordering.MetisGaussianFactorGraph(gaussian)  # the structure never changes
        delta = linear_step(gaussian, ordering)
        values, new_cost, moved = _line_search(native, term, values, delta, cost)
        iterations += 1
        converged = cost - new_cost <= relative_tolerance * cost
        cost = new_cost
        if converged or not moved:
            break
    return Solution(values, term.squared_norm(values), native.error(values), iterations)


def _line_search(native: gtsam.NonlinearFactorGraph, term: MotionTerm, values: gtsam.Values,
                 delta: gtsam.VectorValues, cost: float) -> tuple[gtsam.Values, float, bool]:
    """The first of the full, half, quarter … step that lowers the cost."""
    step = 1.0
    while step >= SMALLEST_STEP:
        candidate = values.retract(delta if step == 1.0 else delta.scale(step))
        new_cost = native.error(candidate) + term.cost(candidate)
        if np.isfinite(new_cost) and new_cost <= cost:
            return candidate, new_cost, True
        step *= 0.5
    return values, cost, False
