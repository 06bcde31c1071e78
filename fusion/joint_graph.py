"""Samples of a solved graph's joint uncertainty: one banded Cholesky factor of its information matrix.

The nodes of a recording form a chain, so that in the order of time the information matrix has a narrow band. Log
scales belong to whole segments and would widen it; each node gets a copy instead, tied to its neighbours'. With
H = L Lᵀ and white z, L⁻ᵀ z has covariance H⁻¹.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import S, X
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky_banded
from scipy.linalg.lapack import dtbtrs

from fusion.joint import SAMPLES, JointSamples, checkpoints

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

DIMENSION = 16
OFFSETS = {"s": (0, 1), "x": (1, 7), "v": (7, 10), "b": (10, 16)}
"""Where the components of a node's log scale, pose, velocity and bias stand among its 16."""
KINDS = {kind: end - begin for kind, (begin, end) in OFFSETS.items()}
TIE_INFORMATION = 1e10
"""Ties the copies of one log scale to 1e-5, far closer than any is known."""
LARGEST_BAND = 250_000_000
"""Numbers in the band (2 GB); motions over very many frames would need more, and gtsam eliminates such a graph."""
COLUMNS = 10


def sample_graph(gaussian: gtsam.GaussianFactorGraph, nodes: int, segment_of_node: Indices | None,
                 rng: np.random.Generator) -> JointSamples | None:
    """Joint samples of all poses (and log scales, where they are variables).

    Args:
        gaussian: the graph linearised at its solution.
        nodes: number of poses M.
        segment_of_node: (M,) segment whose log scale applies at each node; None where scale is held.
        rng: source of the draws.

    Returns:
        None where the graph is too stiff for Cholesky.
    """
    rows, blocks = _factors(gaussian, nodes, segment_of_node)
    width = max(int(np.ptp(index, axis=1).max()) for index in rows) + 1
    if width * nodes * DIMENSION > LARGEST_BAND:
        return _sample_tree(gaussian, nodes, segment_of_node, rng)
    band = _band(rows, blocks, nodes * DIMENSION, width)
    _tie_scales(band, nodes, segment_of_node)
    root = np.sqrt(band[0])
    for offset in range(len(band)):  # unit diagonal: radians and metres differ by many orders of magnitude
        band[offset, :len(root) - offset] /= root[offset:] * root[:len(root) - offset]
    try:
        lower = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)
    except LinAlgError:
        return None
    node = checkpoints(nodes)
    kept = (node[:, None] * DIMENSION + np.arange(7)).ravel()
    draws = np.empty((SAMPLES, len(kept)))
    for first in range(0, SAMPLES, COLUMNS):
        white = rng.standard_normal((len(root), COLUMNS))
        solved, _ = dtbtrs(lower, white, uplo="L", trans="T")
        draws[first:first + COLUMNS] = (solved[kept] / root[kept, None]).T
    values = draws.reshape(SAMPLES, len(node), 7)
    scale = np.zeros(values.shape[:2]) if segment_of_node is None else values[..., 0].copy()
    return JointSamples(node, values[..., 1:].copy(), scale)


def _sample_tree(gaussian: gtsam.GaussianFactorGraph, nodes: int, segment_of_node: Indices | None,
                 rng: np.random.Generator) -> JointSamples | None:
    """The same from gtsam's elimination in METIS order: for motions that join frames far apart. R x = z, z white."""
    try:
        net = gaussian.eliminateSequential(gtsam.Ordering.MetisGaussianFactorGraph(gaussian))
    except RuntimeError:  # indeterminate under Cholesky: gtsam has no class of its own for it
        return None
    node = checkpoints(nodes)
    keys = [(key, KINDS[chr(gtsam.Symbol(key).chr())]) for key in list(net.keyVector())]
    poses = [X(k) for k in node.tolist()]
    scales = None if segment_of_node is None else [S(k) for k in segment_of_node[node].tolist()]
    xi, log_scale = np.empty((SAMPLES, len(node), 6)), np.zeros((SAMPLES, len(node)))
    for n in range(SAMPLES):
        white = gtsam.VectorValues()
        for key, size in keys:
            white.insert(key, rng.standard_normal(size))
        drawn = net.backSubstitute(white)
        xi[n] = [drawn.at(key) for key in poses]
        if scales is not None:
            log_scale[n] = [drawn.at(key)[0] for key in scales]
    return JointSamples(node, xi, log_scale)


def _factors(gaussian: gtsam.GaussianFactorGraph, nodes: int,
             segment_of_node: Indices | None) -> tuple[list[Indices], list[Array]]:
    """Rows (n, d) in the ordered system and information blocks (n, d, d), per kind of factor."""
    starts = np.zeros(1, np.int64) if segment_of_node is None else np.flatnonzero(np.diff(segment_of_node, prepend=-1))
    grouped: dict[tuple[str, ...], tuple[list[list[int]], list[Any]]] = defaultdict(lambda: ([], []))
    for n in range(gaussian.size()):
        factor = gaussian.at(n)
        symbols = [gtsam.Symbol(key) for key in list(factor.keys())]
        kinds = tuple(chr(symbol.chr()) for symbol in symbols)
        places, infos = grouped[kinds]
        places.append(_nodes_of(kinds, [symbol.index() for symbol in symbols], starts))
        infos.append(factor.information())
    rows, blocks = [], []
    for kinds, (places, infos) in grouped.items():
        offsets = [np.arange(*OFFSETS[kind]) for kind in kinds]
        at = np.array(places, np.int64) * DIMENSION
        rows.append(np.concatenate([at[:, [k]] + offset for k, offset in enumerate(offsets)], axis=1))
        blocks.append(np.array(infos))
    return rows, blocks


def _nodes_of(kinds: tuple[str, ...], numbers: list[int], starts: Indices) -> list[int]:
    """The node of every variable; a log scale stands at a node of its segment that keeps the factor narrow."""
    if kinds == ("s", "s"):  # the walk between two segments: where they meet
        meeting = int(starts[max(numbers)])
        return [meeting - 1, meeting] if numbers[0] < numbers[1] else [meeting, meeting - 1]
    poses = [number for kind, number in zip(kinds, numbers, strict=True) if kind == "x"]
    return [(min(poses) if poses else int(starts[number])) if kind == "s" else number
            for kind, number in zip(kinds, numbers, strict=True)]


def _band(rows: list[Indices], blocks: list[Array], size: int, width: int) -> Array:
    """Lower band (width, size) of the information matrix."""
    band = np.zeros((width, size))
    flat = band.reshape(-1)
    for index, block in zip(rows, blocks, strict=True):
        for first in range(0, len(index), 4096):
            row = index[first:first + 4096]
            offset = row[:, :, None] - row[:, None, :]
            lower = offset >= 0
            column = np.broadcast_to(row[:, None, :], offset.shape)
            np.add.at(flat, offset[lower] * size + column[lower], block[first:first + 4096][lower])
    return band


def _tie_scales(band: Array, nodes: int, segment_of_node: Indices | None) -> None:
    scale = np.arange(nodes) * DIMENSION
    if segment_of_node is None:
        band[0, scale] = 1.0  # nobody asks for it
        return
    tied = scale[:-1][np.diff(segment_of_node) == 0]
    band[0, tied] += TIE_INFORMATION
    band[0, tied + DIMENSION] += TIE_INFORMATION
    band[DIMENSION, tied] -= TIE_INFORMATION
