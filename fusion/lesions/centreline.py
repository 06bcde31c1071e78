"""The travelled centreline of the gut, and how far along it every frame lies.

A capsule is carried to and fro, rests, and trembles; the length of its track is none of the gut's. So:

1. Walk through the track and keep a chain of nodes: a position that lies beside the chain is a revisit and is only
   projected onto it, one that lies beyond an end, or far aside of it, prolongs it. The search stays near the last
   place, because loops of gut touch each other.
2. Fit one smooth line through all positions, every stretch counted once however often and long the capsule was there,
   with the third-difference Whittaker smoother (Eilers, "A perfect smoother", Analytical Chemistry 75, 2003): it
   leaves the bends of the gut alone and takes out the wobble across it.
3. Measure along the smooth line, project all frames onto it, and repeat from 2.

Step 2 is linear in the positions, so the lines of many sampled trajectories cost little more than one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_array

Array = NDArray[np.float64]

NODE_M = 4e-3
"""Spacing of the chain's nodes."""
STEP_M = 0.5e-3
"""A capsule that moved less since it was last looked at is where it was."""
GRID_M = 2e-3
"""Spacing of the smooth line's points."""
SMOOTHING_M, SMOOTHING_PER_SWAY = 4e-3, 1.1
"""Waves across the line are halved at wavelengths of 2 pi times the smoothing length, and soon vanish below. That
length is the first number and the second times how far (rms) the capsule sways from the line: a wide gut leaves more
room, and bends less tightly."""
FIRST_SWAY_M = 3.5e-3
"""Assumed until a first line is there to measure it from."""
REACH_M = 30e-3
"""How far along the line a frame is looked for from where the frame before was, beyond the distance it moved."""
ZIGZAG_M, ZIGZAG_GRID_M = 15e-3, 1e-3
"""Standard deviation of the average along the track that the chain is laid through, and its grid."""
ASIDE_M = 15e-3
"""Further than this from the line a position does not shape it: the track has drifted between two visits."""
DRIFTED, FOLLOW = 0.5, 0.2
"""From this share of it on, drift is followed by this much per frame, so that a drifting track is not lost."""
ROUNDS = 4


@dataclass(frozen=True)
class Centreline:
    """A smooth line of J points through a track of M frames."""

    points_m: Array
    """(J, 3) in the order of travel."""
    arc_m: Array
    """(J,) length along the line; 0 at the first frame, negative behind it."""
    frame_arc_m: Array
    """(M,) where every frame lies along the line."""
    frame_place: Array
    """(M,) the same in grid steps of the last fit, 0 to J - 1: what `smooth` fits by, with"""
    frame_counts: NDArray[np.bool_]
    """(M,) which frames shape the line."""
    drift_m: Array
    """(M, 3) how far the track is off the line it laid down before; zero unless it drifts by centimetres."""
    smoothing_m: float
    """Smoothing length of the last fit."""
    sway_m: float
    """How far the capsule sways from the line, root mean square."""

    def smooth(self, positions_m: Array) -> Array:
        """The lines (S, J, 3) of other positions (S, M, 3) of the same frames, in the places they have here."""
        sampled = np.asarray(positions_m, float) - self.drift_m
        count, frames = sampled.shape[:2]
        columns = np.moveaxis(sampled, 1, 0).reshape(frames, -1)
        points = _fit(columns, self.frame_place, self.frame_counts, len(self.points_m), self.smoothing_m)
        return np.moveaxis(points.reshape(-1, count, 3), 0, 1)


def trace_centreline(positions_m: Array) -> Centreline:
    """The centreline through positions (M, 3) of a track, in the order they were travelled."""
    p = np.asarray(positions_m, float)
    s, off, drift = _walk(_without_zigzag(p))
    p, sway = p - drift, FIRST_SWAY_M
    for _ in range(ROUNDS):
        place, counts, smoothing = (s - s.min()) / GRID_M, off <= ASIDE_M, SMOOTHING_M + SMOOTHING_PER_SWAY * sway
        points = _fit(p, place, counts, int(np.ceil(place.max())) + 2, smoothing)
        arc = arc_length(points)
        s, off = _project_frames(p, points, arc, place)
        sway = float(np.sqrt(np.mean(np.minimum(off, ASIDE_M) ** 2)))
    if np.cov(s, np.arange(len(s)))[0, 1] < 0:  # the chain took the capsule's first retreat for the way ahead
        points, arc, s, place = points[::-1], arc[-1] - arc[::-1], arc[-1] - s, len(points) - 1 - place
    return Centreline(points, arc - s[0], s - s[0], place, counts, drift, smoothing, sway)


def arc_length(points_m: Array) -> Array:
    """Length (..., J) along lines of points (..., J, 3), 0 at their first point."""
    steps = np.linalg.norm(np.diff(points_m, axis=-2), axis=-1)
    return np.concatenate([np.zeros((*steps.shape[:-1], 1)), np.cumsum(steps, axis=-1)], axis=-1)


def place_on_lines(points_m: Array, lines_m: Array, first: int, last: int) -> Array:
    """Place (S,) on each line that is nearest to a point, in grid steps from the line's first point.

    Args:
        points_m: (S, 3), one point per line.
        lines_m: (S, J, 3).
        first: first point of the lines to look at.
        last: last one, included.
    """
    start, step = lines_m[:, first:last], np.diff(lines_m[:, first:last + 1], axis=1)
    square = np.maximum(np.einsum("sjc,sjc->sj", step, step), 1e-18)
    along = np.clip(np.einsum("sjc,sjc->sj", points_m[:, None] - start, step) / square, 0.0, 1.0)
    off = points_m[:, None] - start - along[..., None] * step
    best = np.argmin(np.einsum("sjc,sjc->sj", off, off), axis=1)
    return np.asarray(first + best + along[np.arange(len(best)), best])


class _Chain:
    """Nodes numbered from 0, the first one laid down; those in front of it have negative numbers."""

    def __init__(self, first: Array) -> None:
        self._nodes = np.empty((4096, 3))
        self._zero = 2048
        self._nodes[self._zero] = first
        self.low = self.high = 0

    def between(self, first: int, last: int) -> Array:
        """Nodes `first` to `last`, both included."""
        return self._nodes[self._zero + first:self._zero + last + 1]

    def add(self, node: Array, front: bool) -> None:
        """Lay down one more node at either end."""
        if self._zero + self.low == 0 or self._zero + self.high == len(self._nodes) - 1:
            room = np.empty_like(self._nodes)
            self._zero += len(room)
            self._nodes = np.concatenate([room, self._nodes, room])
        number = self.low - 1 if front else self.high + 1
        self._nodes[self._zero + number] = node
        self.low, self.high = min(self.low, number), max(self.high, number)


def _without_zigzag(p: Array) -> Array:
    """The track averaged along its own length: a capsule that sways from wall to wall leaves a zigzag."""
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))]
    grid = np.arange(int(length[-1] / ZIGZAG_GRID_M) + 2) * ZIGZAG_GRID_M
    even = np.column_stack([np.interp(grid, length, p[:, k]) for k in range(3)])
    smooth = gaussian_filter1d(even, ZIGZAG_M / ZIGZAG_GRID_M, axis=0, mode="nearest")
    return np.column_stack([np.interp(length, grid, smooth[:, k]) for k in range(3)])


def _walk(p: Array) -> tuple[Array, Array, Array]:
    """Place (M,) [m] of every position along the chain, from the first node laid down; distance (M,) from it; drift."""
    chain = _Chain(p[0])
    place, off, drift = np.zeros(len(p)), np.zeros(len(p)), np.zeros((len(p), 3))
    last = 0
    for k in range(1, len(p)):
        moved = float(np.linalg.norm(p[k] - p[last]))
        if moved < STEP_M:
            place[k], off[k], drift[k] = place[last], off[last], drift[last]
            continue
        reach = int(np.ceil((REACH_M + moved) / NODE_M))
        place[k], aside = _place_on_chain(chain, p[k] - drift[last], place[last], reach)
        off[k] = float(np.linalg.norm(aside))
        drift[k] = drift[last]
        if off[k] > DRIFTED * ASIDE_M:  # the track has left the chain sideways, which a capsule cannot
            drift[k] += FOLLOW * (1 - DRIFTED * ASIDE_M / off[k]) * aside
        last = k
    return place * NODE_M, off, drift


def _place_on_chain(chain: _Chain, point: Array, near: float, reach: int) -> tuple[float, Array]:
    """Where a point lies on the chain [nodes], and its offset from there; beyond an end the chain grows."""
    first, last = max(chain.low, int(near) - reach), min(chain.high, int(near) + 1 + reach)
    if chain.low == chain.high:
        return _grow(chain, point, point - chain.between(0, 0)[0], front=False), np.zeros(3)
    nodes = chain.between(first, last)
    step = np.diff(nodes, axis=0)
    along = np.einsum("jc,jc->j", point - nodes[:-1], step) / np.einsum("jc,jc->j", step, step)
    off = point - nodes[:-1] - np.clip(along, 0.0, 1.0)[:, None] * step
    square = np.einsum("jc,jc->j", off, off)
    best = int(np.argmin(square))
    aside, share = float(np.sqrt(square[best])), float(along[best])
    place = first + best + min(max(share, 0.0), 1.0)
    turn = int(ASIDE_M / NODE_M) if aside > ASIDE_M else 0  # a sharp turn near an end also leads on from there
    if (share > 1 and first + best + 1 == chain.high) or (turn and chain.high - place <= turn):
        outward = point - nodes[-1] if turn else nodes[-1] - nodes[max(len(nodes) - 3, 0)]
        return _grow(chain, point, outward, front=False), np.zeros(3)
    if (share < 0 and first + best == chain.low) or (turn and place - chain.low <= turn):
        outward = point - nodes[0] if turn else nodes[0] - nodes[min(2, len(nodes) - 1)]
        return _grow(chain, point, outward, front=True), np.zeros(3)
    return place, off[best]


def _grow(chain: _Chain, point: Array, outward: Array, front: bool) -> float:
    """Lay nodes from an end of the chain towards a point, as far as it lies ahead; returns the place of the end."""
    number = chain.low if front else chain.high
    end = chain.between(number, number)[0].copy()
    away = point - end
    distance = float(np.linalg.norm(away))
    if float(away @ outward) >= NODE_M * float(np.linalg.norm(outward)) > 0:
        for n in range(1, int(distance / NODE_M) + 1):
            chain.add(end + away * (n * NODE_M / distance), front)
    return float(chain.low if front else chain.high)


def _fit(columns: Array, place: Array, counts: NDArray[np.bool_], count: int, smoothing_m: float) -> Array:
    """Smooth values (count, C) on the grid from those values (M, C) at places (M,) between grid points that count."""
    cell = np.clip(place.astype(np.int64), 0, count - 2)
    right = place - cell
    weight = counts / np.maximum(np.bincount(cell, counts, count)[cell], 1.0)
    frames = np.arange(len(place))
    hat = csr_array((np.r_[1 - right, right], (np.r_[frames, frames], np.r_[cell, cell + 1])), (len(place), count))
    band = _roughness(count, smoothing_m)
    band[3] += np.bincount(cell, weight * (1 - right) ** 2, count) + np.bincount(cell + 1, weight * right**2, count)
    band[2, 1:] += np.bincount(cell, weight * right * (1 - right), count)[:-1]
    return np.asarray(solveh_banded(band, hat.T @ (weight[:, None] * columns)))


def _roughness(count: int, smoothing_m: float) -> Array:
    """Upper band (4, count) of the penalty on third differences, with a trace of one on first differences.

    The trace holds lines that have too few positions for a third difference to mean anything.
    """
    band = np.zeros((4, count))
    for order, strength in ((3, (smoothing_m / GRID_M) ** 6), (1, 1e-9)):
        kernel = np.array({3: [-1.0, 3.0, -3.0, 1.0], 1: [-1.0, 1.0]}[order])
        rows = count - order
        for a in range(order + 1):
            for b in range(a, order + 1):
                band[3 - (b - a), b:b + max(rows, 0)] += strength * kernel[a] * kernel[b]
    return band


def _project_frames(p: Array, points: Array, arc: Array, place: Array) -> tuple[Array, Array]:
    """Arc length (M,) of the places nearest to the frames, each looked for around its last place, and distance (M,)."""
    reach = int(np.ceil(0.5 * REACH_M / GRID_M))
    window = np.arange(-reach, reach)
    last = len(points) - 2
    start = np.clip(np.rint(place).astype(np.int64)[:, None] + window, 0, last)
    step = np.diff(points, axis=0)
    square = np.maximum(np.einsum("jc,jc->j", step, step), 1e-18)
    along = np.einsum("mwc,mwc->mw", p[:, None] - points[start], step[start]) / square[start]
    along = np.clip(along, np.where(start == 0, -reach, 0.0), np.where(start == last, reach, 1.0))
    off = p[:, None] - points[start] - along[..., None] * step[start]
    squared = np.einsum("mwc,mwc->mw", off, off)
    best = np.argmin(squared, axis=1)
    row = np.arange(len(p))
    cell = start[row, best]
    return arc[cell] + along[row, best] * np.sqrt(square[cell]), np.sqrt(squared[row, best])
