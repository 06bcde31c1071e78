"""Few factors between frames far apart, in a system that is a band without them: loops.

With the band H, rows U (6 per factor, white) and X = H⁻¹ Uᵀ, Woodbury's identity gives the solution and the covariance
of H + Uᵀ U,

    x = x₀ + X G⁻¹ (b - U x₀),    Σ = H⁻¹ - X G⁻¹ Xᵀ,    G = 1 + U X,

and a draw x₀ of the band's errors becomes one of all factors' by the same step with b white (Matheron's rule). Every
column of X costs one banded solve; they are made a few at a time, so memory does not grow with the factors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from vio.errors import EstimationError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Solve: TypeAlias = "Callable[[Array], Array]"

DIM, JOINED = 16, 7
"""Unknowns of a frame, and how many of them, the first, a factor joins: log scale and pose."""
ROWS = 6
COLUMNS = 60
"""Solved at a time."""


@dataclass(frozen=True)
class FarFactors:
    """K factors |A_i x_i + A_j x_j - b|² between any two frames."""

    i: Indices
    j: Indices
    A_i: Array
    """(K, 6, 7) by log scale and pose of the first frame."""
    A_j: Array
    """(K, 6, 7) by those of the second."""
    b: Array
    """(K, 6)"""

    def times(self, x_i: Array, x_j: Array) -> Array:
        """U x as (6K, c), from the joined unknowns (K, 7, c) of both ends."""
        return np.asarray((self.A_i @ x_i + self.A_j @ x_j).reshape(ROWS * len(self.i), -1))

    def of(self, x: Array) -> Array:
        """U x as (6K, c) of whole columns (n, c)."""
        by_node = x.reshape(-1, DIM, x.shape[1])
        return self.times(by_node[self.i, :JOINED], by_node[self.j, :JOINED])

    def transposed(self, weights: Array, size: int) -> Array:
        """Uᵀ W as (n, c), of weights (6K, c)."""
        out = np.zeros((size // DIM, DIM, weights.shape[1]))
        blocks = weights.reshape(len(self.i), ROWS, -1)
        joined = out[:, :JOINED]
        np.add.at(joined, self.i, np.swapaxes(self.A_i, 1, 2) @ blocks)
        np.add.at(joined, self.j, np.swapaxes(self.A_j, 1, 2) @ blocks)
        return out.reshape(size, -1)


class Conditioned:
    """What the far factors change about a factored band.

    Args:
        far: the factors.
        solve: H⁻¹ on columns (n, c).
        size: n.

    Raises:
        EstimationError: the far factors leave no positive definite system.
    """

    def __init__(self, far: FarFactors, solve: Solve, size: int) -> None:
        self.far, self._solve, self._size = far, solve, size
        G = np.concatenate([far.of(columns) for _, columns in self._columns(np.eye(ROWS * len(far.i)))], axis=1)
        try:
            self._lower = cholesky(0.5 * (G + G.T) + np.eye(len(G)), lower=True)
        except (LinAlgError, ValueError) as error:
            raise EstimationError(f"graph: the loops leave no solution ({error})") from None

    def _columns(self, weights: Array) -> Iterator[tuple[slice, Array]]:
        """H⁻¹ Uᵀ W, a few columns at a time."""
        for first in range(0, weights.shape[1], COLUMNS):
            cut = slice(first, first + COLUMNS)
            yield cut, self._solve(self.far.transposed(weights[:, cut], self._size))

    def solution(self, x: Array) -> Array:
        """The (n, 1) solution with the far factors, from the band's."""
        off = self.far.b.reshape(-1, 1) - self.far.of(x)
        weights = solve_triangular(self._lower.T, solve_triangular(self._lower, off, lower=True), lower=False)
        return np.asarray(x + self._solve(self.far.transposed(weights, self._size)))

    def marginals_and_samples(self, cov: Array, node: Indices, drawn: Array,
                              rng: np.random.Generator) -> tuple[Array, Array]:
        """Marginals (M, 16, 16) and joint draws (S, 16, c) at the S ordered frames `node`, far factors' included."""
        at = [np.searchsorted(node, ends) for ends in (self.far.i, self.far.j)]
        off = self.far.times(drawn[at[0], :JOINED], drawn[at[1], :JOINED])
        off = solve_triangular(self._lower, off + rng.standard_normal(off.shape), lower=True)
        root = solve_triangular(self._lower, np.eye(len(self._lower)), lower=True).T
        cov, drawn = cov.copy(), drawn.copy()
        for cut, columns in self._columns(root):
            by_node = columns.reshape(-1, DIM, columns.shape[1])
            cov -= by_node[:len(cov)] @ np.swapaxes(by_node[:len(cov)], 1, 2)
            drawn -= by_node[node] @ off[cut]
        return cov, drawn
