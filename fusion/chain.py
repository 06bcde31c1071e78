"""The linear system of a recording as a chain: block-tridiagonal in the order of time, stored as a band.

Every factor of a recording joins frames that are close in time. With the 16 unknowns of a frame side by side (log
scale, pose, velocity, biases) the information matrix is a narrow band, which LAPACK factors in one pass; nothing has to
be ordered, and no tree is built. Frames that wide motions join are put together into one block. Log scales belong to
segments of many frames: each frame holds a copy, tied to its neighbours'.

With H = L Lᵀ and white z, L⁻ᵀ z has covariance H⁻¹; backwards through the blocks

    x_k = C_k^½ z_k - G_kᵀ x_{k+1},   C_k = (L_kk L_kkᵀ)⁻¹,   G_k = L_{k+1,k} L_kk⁻¹

which gives the marginals, and joint samples at any blocks, in steps that add and never subtract.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dpbtrs

from fusion.chain_far import Conditioned, FarFactors
from fusion.joint import SAMPLES, JointSamples, checkpoints, square_root
from vio.errors import EstimationError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

DIM = 16
SCALE, POSE, VELOCITY, BIAS = (slice(*ends) for ends in ((0, 1), (1, 7), (7, 10), (10, 16)))
"""Where a frame's unknowns stand: log scale; rotation and translation in body axes; velocity; accelerometer, gyro."""
JOINED = slice(0, BIAS.start)
"""Unknowns that a factor with an earlier frame may speak of."""
OF_FIRST, OF_SECOND, RIGHT = slice(0, DIM), slice(DIM, DIM + JOINED.stop), DIM + JOINED.stop
"""Columns of a factor's rows: unknowns of its first frame, joined unknowns of its second, right-hand side."""
BLOCK_NODES, CHAIN_NODES = 1000, 250
"""Frames handled at a time, in general and as whole blocks: what stays in a processor's cache is several times
faster."""


class ChainSystem:
    """Normal equations `H x = g` of M frames, of which factors join at most `reach` apart.

    The band's column c holds H[c : c + width, c]. A block of `reach` frames and the next one are a window; seen
    through strides, entry (block, column, row) of that window lies at its place in the band. Only rows at or below
    their column exist: what is added to a frame's own block goes in without its upper triangle. No factor joins a
    frame with the biases of a later one, apart from the links of neighbours, which keeps the band as narrow as it is.
    """

    def __init__(self, nodes: int, reach: int) -> None:
        self.nodes, self.reach = nodes, max(reach, 1)
        self.blocks = -(-nodes // self.reach)
        self.side = DIM * self.reach
        width = self.side + BIAS.start
        self.band = np.zeros((self.blocks * self.side, width))
        size = self.band.itemsize
        self._window = as_strided(self.band, (self.blocks, self.reach, DIM, 2 * self.reach, DIM),
                                  tuple(size * s for s in (self.side * width, DIM * (width - 1), width - 1, DIM, 1)))
        self.gradient = np.zeros((self.blocks * self.reach, DIM))
        self.far: FarFactors | None = None
        self._blocks = np.zeros((CHAIN_NODES + 1, DIM, RIGHT + DIM))
        self._fill_up()

    def clear(self) -> None:
        """Forget all factors; the memory stays."""
        self.band.fill(0.0)
        self.gradient.fill(0.0)
        self.far = None
        self._fill_up()

    def _fill_up(self) -> None:
        self.band[self.nodes * DIM:, 0] = 1.0  # frames that only fill the last block

    def add(self, i: Indices, j: Indices, rows: Array) -> None:
        """Add factors between frames with 0 < j - i ≤ reach, each unique in `i` and in `j`.

        Args:
            i: (N,) first frames.
            j: (N,) second frames.
            rows: (N, r, 27) whitened rows, laid out as `OF_FIRST`, `OF_SECOND` and `RIGHT` say.
        """
        A_i, A_j, b = rows[:, :, OF_FIRST], rows[:, :, OF_SECOND], rows[:, :, RIGHT:]
        A_i_t, A_j_t = np.swapaxes(A_i, 1, 2), np.swapaxes(A_j, 1, 2)
        self._add_diagonal(i, slice(0, DIM), A_i_t @ A_i.copy())  # a copy: numpy is slow at products with oneself
        self._add_diagonal(j, JOINED, A_j_t @ A_j.copy())
        block, place = i // self.reach, i % self.reach
        self._window[block, place, :, j - block * self.reach, JOINED] += A_i_t @ A_j
        self.gradient[i] += (A_i_t @ b)[:, :, 0]
        self.gradient[j, JOINED] += (A_j_t @ b)[:, :, 0]

    def add_chain(self, first: int, rows: Array) -> None:
        """Add factors of frames `first` to `first + N - 1`, each with its successor, where frames make no blocks.

        Args:
            first: the first frame.
            rows: (N, r, 27) as of `add`.
        """
        for begin, end in spans(len(rows), CHAIN_NODES):
            self._add_chain(first + begin, rows[begin:end])

    def _add_chain(self, first: int, rows: Array) -> None:
        n = len(rows)
        # Of every frame its own 16 columns; rows are the frame's own and the next one's. Every column one row further
        # right than the last, they stand as in the band; what lies beyond them is zero.
        blocks = self._blocks[:n + 1]
        np.matmul(np.swapaxes(rows[:, :, OF_FIRST], 1, 2), rows, out=blocks[:n, :, :RIGHT + 1])
        blocks[n] = 0.0
        of_next = np.swapaxes(rows[:, :, OF_SECOND], 1, 2) @ rows[:, :, OF_SECOND.start:]
        blocks[1:, JOINED, JOINED] += of_next[:, :, :-1]
        gradient = self.gradient[first:first + n + 1]
        gradient[:n] += blocks[:n, :, RIGHT]
        gradient[1:, JOINED] += of_next[:, :, -1]
        blocks[:, :, RIGHT] = 0.0
        size, long = blocks.itemsize, blocks.shape[2]
        skewed = as_strided(blocks, (n + 1, DIM, RIGHT), (size * DIM * long, size * (long + 1), size))
        self.band[first * DIM:(first + n + 1) * DIM].reshape(n + 1, DIM, RIGHT)[:] += skewed

    def add_prior(self, node: int, information: Array, gradient: Array) -> None:
        """Add information (16, 16) and gradient (16,) to one frame."""
        self._add_diagonal(np.array([node]), slice(0, DIM), information[None])
        self.gradient[node] += gradient

    def add_everywhere(self, component: int, information: float) -> None:
        """Add information to one unknown of all frames."""
        self.band[component:self.nodes * DIM:DIM, 0] += information

    def _add_diagonal(self, node: Indices, rows: slice, information: Array) -> None:
        lower = information * np.tri(information.shape[1]).T  # (column, row)
        block, place = node // self.reach, node % self.reach
        self._window[block, place, rows, place, rows] += lower

    def add_links(self, variable: slice, information: Array, difference: Array) -> None:
        """Tie a variable of all neighbours: information (M-1, d) per component, wanted (M-1, d) change of x_j - x_i."""
        column = self.band.reshape(self.blocks * self.reach, DIM, -1)
        k = self.nodes - 1
        for n, c in enumerate(range(DIM)[variable]):
            q, d = information[:, n], information[:, n] * difference[:, n]
            column[:k, c, 0] += q
            column[1:k + 1, c, 0] += q
            column[:k, c, DIM] -= q
            self.gradient[:k, c] -= d
            self.gradient[1:k + 1, c] += d

    def gain(self, x: Array) -> float:
        """By how much the solution (M, 16) lowers half the squared rows, as long as they are linear."""
        gain = 0.5 * float(np.vdot(self.gradient[:self.nodes], x))
        if self.far is not None:
            gain += 0.5 * float(np.vdot(self.far.b, self.far.of(x.reshape(-1, 1))))
        return gain

    def factor(self) -> ChainFactor:
        """Cholesky factor; the system's own memory is used for it.

        Raises:
            EstimationError: the matrix is not positive definite.
        """
        band, info = dpbtrf(self.band.T, lower=1, overwrite_ab=1)
        if info != 0:
            raise EstimationError(f"graph: the linear system is indeterminate (frame {(info - 1) // DIM})")
        return ChainFactor(self, band.T)


@dataclass(frozen=True)
class ChainFactor:
    """A factored chain."""

    system: ChainSystem
    band: Array
    """(blocks · side, width) lower band of L, by columns."""

    def solve(self) -> Array:
        """The (M, 16) solution of the normal equations, far factors included."""
        x = self._solved(self.system.gradient.reshape(-1, 1))
        if self.system.far is not None:
            x = Conditioned(self.system.far, self._solved, len(x)).solution(x)
        return x.reshape(-1, DIM)[:self.system.nodes]

    def solve_columns(self, right: Array) -> Array:
        """The (M, 16, c) solutions for other right-hand sides (N, 16, c); far factors want nothing moved."""
        x = self._solved(right.reshape(-1, right.shape[2]))
        if self.system.far is not None:
            still = replace(self.system.far, b=np.zeros_like(self.system.far.b))
            x = Conditioned(still, self._solved, len(x)).solution(x)
        return x.reshape(-1, DIM, right.shape[2])[:self.system.nodes]

    def _solved(self, right: Array) -> Array:
        """H⁻¹ of columns (n, c), by the band alone."""
        x, info = dpbtrs(self.band.T, right, lower=1)
        if info != 0 or not np.isfinite(x).all():
            raise EstimationError("graph: the linear system has no finite solution")
        return np.asarray(x)

    def backward(self) -> tuple[Array, Array, Array]:
        """C (K, side, side) and -G (K, side, side) of all blocks, and C^½ (side, side) of the last."""
        side, K = self.system.side, self.system.blocks
        flat = self.band.reshape(-1)
        size, width = flat.itemsize, self.band.shape[1]
        columns = as_strided(flat, (K, side, side), (size * side * width, size * (width - 1), size))
        below = as_strided(flat[side:], (K - 1, side, side), (size * side * width, size * (width - 1), size))
        reached = np.tri(side, side, width - 1 - side)  # by column, then row
        own, carry = np.empty((K, side, side)), np.zeros((K, side, side))
        inverse = np.zeros((0, side, side))
        for first, last in spans(K, max(1, CHAIN_NODES // self.system.reach)):
            inverse = _inverse_of_lower(np.swapaxes(columns[first:last], 1, 2))
            np.matmul(np.swapaxes(inverse, 1, 2), inverse.copy(), out=own[first:last])
            stop = min(last, K - 1)
            np.matmul(np.swapaxes(below[first:stop] * -reached, 1, 2), inverse[:stop - first], out=carry[first:stop])
        return own, carry, inverse[-1].T

    def marginals_and_samples(self, rng: np.random.Generator) -> tuple[Array, JointSamples]:
        """Marginal covariances (M, 16, 16) of all frames, and joint samples of poses and log scales."""
        conditional, carry, root = self.backward()
        reach, side, K = self.system.reach, self.system.side, self.system.blocks
        kept, far = checkpoints(self.system.nodes), self.system.far
        node = kept if far is None else np.unique(np.concatenate([kept, far.i, far.j]))
        stop = np.unique(node // reach)
        if stop[-1] != K - 1:
            raise EstimationError("graph: the last frame is not in the last block")
        A, Q = _between(conditional, carry, stop)
        cov = np.empty((K, side, side))
        drawn = np.empty((len(stop), side, SAMPLES))
        drawn[-1] = root @ rng.standard_normal((side, SAMPLES))
        cov[K - 1] = conditional[K - 1]
        noise = square_root(Q)
        for k in range(len(stop) - 2, -1, -1):
            cov[stop[k]] = A[k] @ cov[stop[k + 1]] @ A[k].T + Q[k]
            drawn[k] = A[k] @ drawn[k + 1] + noise[k] @ rng.standard_normal((side, SAMPLES))
        _fill(cov, conditional, carry, stop)
        at = np.searchsorted(stop, node // reach)
        values, own = drawn.reshape(len(stop), reach, DIM, SAMPLES)[at, node % reach], self._own(cov)
        if far is not None:
            conditioned = Conditioned(far, self._solved, len(self.band))
            own, values = conditioned.marginals_and_samples(own, node, values, rng)
            values = values[np.searchsorted(node, kept)]
        samples = JointSamples(kept, np.ascontiguousarray(np.moveaxis(values[:, POSE], 2, 0)),
                               np.ascontiguousarray(values[:, 0].T))
        return own, samples

    def _own(self, cov: Array) -> Array:
        """The frames' own blocks (M, 16, 16) of block covariances."""
        reach = self.system.reach
        if reach == 1:
            return cov
        split = cov.reshape(self.system.blocks, reach, DIM, reach, DIM)
        own = np.stack([split[:, a, :, a, :] for a in range(reach)], axis=1).reshape(-1, DIM, DIM)
        return own[:self.system.nodes]


def spans(count: int, size: int) -> Iterator[tuple[int, int]]:
    """Consecutive (first, last) of at most `size`."""
    for first in range(0, count, size):
        yield first, min(first + size, count)


def _inverse_of_lower(L: Array) -> Array:
    """Inverses of lower triangular matrices (N, n, n), row by row for all at once; the upper triangles are not read."""
    by_entry = np.ascontiguousarray(np.moveaxis(L, 0, 2))
    out = np.zeros_like(by_entry)
    for r in range(len(out)):
        out[r, r] = 1 / by_entry[r, r]
        np.einsum("kn,kjn->jn", by_entry[r, :r], out[:r, :r], out=out[r, :r])
        out[r, :r] *= -out[r, r]
    return np.ascontiguousarray(np.moveaxis(out, 2, 0))


def _between(conditional: Array, carry: Array, stop: Indices) -> tuple[Array, Array]:
    """x at stop k = A x at stop k+1 + noise of covariance Q: (S-1, n, n) each, over all gaps at once."""
    side = carry.shape[1]
    A = np.tile(np.eye(side), (len(stop) - 1, 1, 1))
    Q = np.zeros_like(A)
    for active, block in _steps(stop):
        G = carry[block]
        G_t = np.swapaxes(G, 1, 2)
        A[active] = G_t @ A[active]
        Q[active] = G_t @ (Q[active] @ G) + conditional[block]
    return A, Q


def _fill(cov: Array, conditional: Array, carry: Array, stop: Indices) -> None:
    """Marginals between the stops, from those at the stops."""
    for _, block in _steps(stop):
        inner = block[~np.isin(block, stop)]
        G = carry[inner]
        cov[inner] = np.swapaxes(G, 1, 2) @ (cov[inner + 1] @ G) + conditional[inner]


def _steps(stop: Indices) -> Iterator[tuple[Indices, Indices]]:
    """Backwards from every stop to the one before: which gaps are still on their way, and the block each is at."""
    length = np.diff(stop)
    for t in range(int(length.max(initial=0))):
        active = np.flatnonzero(length > t)
        yield active, stop[1:][active] - 1 - t
