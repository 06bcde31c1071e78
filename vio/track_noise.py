"""How the errors of tracks behave: drifting along the track and heavy-tailed.

A tracker that follows a patch from frame to frame hands its error on, so the error of a track is closer to a
random walk than to fresh noise. It is modelled as first-order autoregressive, `e_k = a e_{k-1} + n_k`, with
`n` from a two-dimensional Student-t distribution (slips of a patch are its tail). `a = 0` and many degrees of
freedom are ordinary white Gaussian noise.
Source of the t weights: Lange, Little and Taylor, "Robust statistical modeling using the t distribution" (1989).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class TrackNoise:
    """Autoregressive Student-t noise of the residuals of tracks."""

    sigma_px: float = 0.5
    """Scale of the fresh part `n` of the error."""
    correlation: float = 0.9
    """`a` in `e_k = a e_{k-1} + n_k`."""
    dof: float = 3.0
    """Degrees of freedom of the t distribution."""

    def weights(self, white: Array) -> Array:
        """(O,) weight of whitened residuals (O, 2) [px]: 1 on average, towards 0 for outliers."""
        z2 = (white**2).sum(axis=1) / self.sigma_px**2
        return np.asarray((self.dof + 2) / (self.dof + z2))

    def cost(self, white: Array) -> float:
        """Minus twice the log likelihood of whitened residuals (O, 2), without its constant."""
        z2 = (white**2).sum(axis=1) / self.sigma_px**2
        return float((self.dof + 2) * np.log1p(z2 / self.dof).sum())

    @property
    def information_loss(self) -> float:
        """Fisher information over that of the weighted least squares problem, below 1 for heavy tails."""
        return (self.dof + 2) / (self.dof + 4)


def whiten(values: Array, starts: Bools, correlation: float) -> Array:
    """`v_k - a v_{k-1}` along tracks of (O, ...) values; the first value of a track is scaled to the same variance.

    Args:
        values: rows sorted by track and then by time.
        starts: (O,) the first row of every track.
        correlation: `a`.
    """
    first = starts.reshape(-1, *[1] * (values.ndim - 1))
    before = np.roll(values, 1, axis=0)
    return np.asarray(np.where(first, values * np.sqrt(1 - correlation**2), values - correlation * before))
