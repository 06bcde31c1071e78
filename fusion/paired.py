"""Is one estimate better than another, or could it be chance? Paired differences with bootstrap intervals.

Errors of neighbouring frames hang together, so frames are drawn in blocks, circularly (Politis and Romano, "A circular
block-resampling procedure for stationary data", 1992): an interval over the frames of ONE recording. What other
recordings would say, only other recordings tell: there whole recordings are drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEVEL = 0.95
DRAWS = 2000
FEWEST_BLOCKS = 4
FEWEST_RECORDINGS = 5
"""Fewer recordings can all point one way by chance: a two-sided test of five signs cannot go below 6 %."""


@dataclass(frozen=True)
class PairedDifference:
    """Error of one estimate less that of another on the same frames, under the same alignment."""

    difference_m: float
    """Root mean square of the second less that of the first: negative where the second is better."""
    low_m: float
    high_m: float
    """Central 95 % interval."""
    block_frames: int
    """Frames that were drawn together."""

    @property
    def significant(self) -> bool:
        """Whether the interval leaves out zero."""
        return self.low_m > 0 or self.high_m < 0

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {"difference_m": self.difference_m, "low_m": self.low_m, "high_m": self.high_m,
                "block_frames": self.block_frames, "significant": self.significant}


@dataclass(frozen=True)
class RatioOverRecordings:
    """How much of one estimate's error another leaves, over several recordings."""

    ratio: float
    """Geometric mean over the recordings."""
    low: float | None
    high: float | None
    """Central 95 % interval; None with fewer than five recordings."""
    better: int
    """In how many recordings the second has the smaller error."""
    recordings: int

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return dict(self.__dict__)


def paired_difference(first_m: Array, second_m: Array, seed: int = 0) -> PairedDifference:
    """Difference of the root mean squares of two series of errors, with its block-bootstrap interval.

    Args:
        first_m: (N,) distances from truth.
        second_m: (N,) distances of the other estimate at the same frames.
        seed: of the draws; the same seed gives the same interval.
    """
    squares = np.stack([np.asarray(first_m, float) ** 2, np.asarray(second_m, float) ** 2])
    n = squares.shape[1]
    block = block_length(squares[1] - squares[0])
    starts = np.random.default_rng(seed).integers(n, size=(DRAWS, -(-n // block)))
    sums = np.concatenate([np.zeros((2, 1)), np.cumsum(np.concatenate([squares, squares[:, :block]], axis=1), axis=1)],
                          axis=1)
    drawn = np.maximum((sums[:, starts + block] - sums[:, starts]).mean(axis=2) / block, 0.0)
    first, second = np.sqrt(drawn)
    low, high = np.quantile(second - first, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    before, after = np.sqrt(squares.mean(axis=1))
    return PairedDifference(float(after - before), float(low), float(high), block)


def block_length(values: Array) -> int:
    """Frames (of N) to be drawn together: twice the series' integrated autocorrelation time.

    The sum of autocorrelations runs until lag 5 tau (Sokal, "Monte Carlo methods in statistical mechanics", 1997); at
    least N^(1/3), and at most a quarter of the series.
    """
    n = len(values)
    longest = max(1, n // FEWEST_BLOCKS)
    shortest = min(max(1, int(np.cbrt(n) + 0.5)), longest)
    centred = values - values.mean()
    variance = float(centred @ centred)
    if variance <= 0:
        return shortest
    spectrum = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    correlation = np.fft.irfft(spectrum)[:n] / variance
    tau = 2 * np.cumsum(correlation) - 1
    enough = np.arange(n) >= 5 * tau
    known = float(tau[np.argmax(enough)]) if enough.any() else float(n)
    return min(max(int(np.ceil(2 * known)), shortest), longest)


def ratio_over_recordings(log_ratios: Sequence[Sequence[float]], seed: int = 0) -> RatioOverRecordings:
    """What share of the error is left, over recordings: geometric mean, and its interval by drawing recordings.

    Args:
        log_ratios: per recording ln(error of the second / error of the first) of each of its pairs.
        seed: of the draws.
    """
    means = np.array([np.mean(part) for part in log_ratios])
    low = high = None
    if len(means) >= FEWEST_RECORDINGS:
        drawn = means[np.random.default_rng(seed).integers(len(means), size=(DRAWS, len(means)))].mean(axis=1)
        low, high = (float(v) for v in np.exp(np.quantile(drawn, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])))
    return RatioOverRecordings(float(np.exp(means.mean())), low, high, int((means < 0).sum()), len(means))
