"""A refinement's frames, block by block, so that whoever summarises them never needs all at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fusion.result import Refinement
from vio.alignment import associate
from vio.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FrameBlock:
    """Frames `first` to `first + m - 1`."""

    first: int
    refined: Trajectory
    """m poses with covariances."""
    motions_only: Trajectory
    """m poses."""
    gyro_bias_rad_s: Array
    """(m, 3)"""
    accel_bias_m_s2: Array
    """(m, 3)"""
    log_scale: Array
    """(m,)"""
    log_scale_sd: Array
    """(m,)"""
    covered: NDArray[np.int64]
    """(k,) which of the m frames truth covers."""
    truth: Trajectory | None
    """Truth at those k, under the frames' own times; None where k is zero."""

    def __len__(self) -> int:
        return len(self.refined)


class FrameSource(Protocol):
    """M frames that can be gone through as often as needed."""

    @property
    def header(self) -> Refinement:
        """The refinement's conclusions. Its states may be those of fewer frames."""

    @property
    def has_truth(self) -> bool:
        """Whether truth covers any frame."""

    def __len__(self) -> int: ...

    def blocks(self, edges: Sequence[int]) -> Iterator[FrameBlock]:
        """Blocks between consecutive edges, which rise from 0 to M."""


class FramesInMemory:
    """The frames of a refinement."""

    def __init__(self, refinement: Refinement) -> None:
        self._refinement = refinement
        self._covered, self._truth = np.zeros(0, np.int64), refinement.truth
        if refinement.truth is not None:
            matched, self._truth = associate(refinement.trajectory, refinement.truth)
            self._covered = np.searchsorted(refinement.trajectory.t_s, matched.t_s).astype(np.int64)

    @property
    def header(self) -> Refinement:
        """The refinement itself."""
        return self._refinement

    @property
    def has_truth(self) -> bool:
        """Whether truth covers any frame."""
        return len(self._covered) > 0

    def __len__(self) -> int:
        return len(self._refinement.trajectory)

    def blocks(self, edges: Sequence[int]) -> Iterator[FrameBlock]:
        """Blocks between consecutive edges."""
        r = self._refinement
        for first, end in pairwise(edges):
            rows = slice(first, end)
            low, high = np.searchsorted(self._covered, [first, end])
            truth = None if self._truth is None or low == high else self._truth.select(np.arange(low, high))
            yield FrameBlock(first, r.trajectory.select(np.arange(first, end)),
                             r.motions_only.select(np.arange(first, end)), r.gyro_bias_rad_s[rows],
                             r.accel_bias_m_s2[rows], r.log_scale[rows], r.log_scale_sd[rows],
                             self._covered[low:high] - first, truth)
