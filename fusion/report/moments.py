"""Means and covariances of pairs of points that come block by block, and an alignment from them alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.trajectory import Trajectory

Array = NDArray[np.float64]


class PairMoments:
    """Running mean and covariance of N pairs of points (Chan, Golub, LeVeque, "Algorithms for computing the sample
    variance", The American Statistician 37, 1983)."""

    def __init__(self) -> None:
        self.count, self._mean, self._scatter = 0, np.zeros(6), np.zeros((6, 6))

    def add(self, estimate_m: Array, reference_m: Array) -> None:
        """Add (m, 3) points of an estimate and of the reference at the same times."""
        rows = np.hstack([estimate_m, reference_m])
        mean, n = rows.mean(axis=0), len(rows)
        off, total = mean - self._mean, self.count + n
        self._scatter += (rows - mean).T @ (rows - mean) + np.outer(off, off) * (self.count * n / total)
        self._mean, self.count = self._mean + off * (n / total), total

    def as_tracks(self) -> tuple[Trajectory, Trajectory]:
        """Twelve pairs of points with exactly these moments: least squares over them is least squares over all."""
        values, vectors = np.linalg.eigh(self._scatter / self.count)
        axes = np.sqrt(6.0 * np.maximum(values, 0.0)) * vectors
        points = self._mean + np.concatenate([axes.T, -axes.T])
        t = np.arange(len(points), dtype=float)
        eye = np.broadcast_to(np.eye(3), (len(points), 3, 3))
        return Trajectory(t, se3.transform(eye, points[:, :3])), Trajectory(t, se3.transform(eye, points[:, 3:]))
