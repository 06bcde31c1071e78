"""Poses over time, with covariances when they are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.errors import TrajectoryError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """N poses of the body in the world.

    Raises:
        TrajectoryError: shapes disagree, times are not strictly increasing, or fewer than one pose.
        GeometryError: a pose or covariance is not one.
    """

    t_s: Array
    """(N,) seconds, strictly increasing."""
    T_world_body: Array
    """(N, 4, 4) metres."""
    cov: Array | None = None
    """(N, 6, 6) right-perturbation covariance in body axes, rotation first; None when unknown."""

    def __post_init__(self) -> None:
        t = np.asarray(self.t_s, float)
        if t.ndim != 1 or len(t) == 0:
            raise TrajectoryError("trajectory: no poses; give at least one")
        if not np.isfinite(t).all():
            raise TrajectoryError(f"trajectory: time {np.argmin(np.isfinite(t))} is not finite")
        if (np.diff(t) <= 0).any():
            k = int(np.argmax(np.diff(t) <= 0)) + 1
            raise TrajectoryError(
                f"trajectory: time {t[k]:.9f} s at row {k} does not follow {t[k - 1]:.9f} s; sort and drop duplicates"
            )
        T = se3.check_transforms(self.T_world_body, "T_world_body")
        if T.shape != (len(t), 4, 4):
            raise TrajectoryError(f"trajectory: {len(t)} times but poses of shape {T.shape}")
        object.__setattr__(self, "t_s", t)
        object.__setattr__(self, "T_world_body", T)
        if self.cov is not None:
            cov = np.asarray(self.cov, float)
            if cov.shape != (len(t), 6, 6):
                raise TrajectoryError(f"trajectory: {len(t)} times but covariances of shape {cov.shape}")
            object.__setattr__(self, "cov", cov)

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def positions_m(self) -> Array:
        """(N, 3) body origin in the world."""
        return self.T_world_body[:, :3, 3]

    @property
    def rotations(self) -> Array:
        """(N, 3, 3) `R_world_body`."""
        return self.T_world_body[:, :3, :3]

    @property
    def path_length_m(self) -> float:
        """Length of the polyline through all positions."""
        return float(np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1).sum())

    def select(self, index: ArrayLike) -> Trajectory:
        """The poses at the given indices (or boolean mask), in their order."""
        index = np.asarray(index)
        return Trajectory(self.t_s[index], self.T_world_body[index], None if self.cov is None else self.cov[index])

    def interpolate(self, t_s: ArrayLike) -> Trajectory:
        """Poses at other times: straight lines and slerp; covariances are dropped.

        Raises:
            TrajectoryError: a time outside the trajectory (nothing is extrapolated).
        """
        t = np.asarray(t_s, float)
        outside = (t < self.t_s[0] - 1e-9) | (t > self.t_s[-1] + 1e-9)
        if outside.any():
            raise TrajectoryError(
                f"trajectory: time {t[outside][0]:.6f} s is outside {self.t_s[0]:.6f} to {self.t_s[-1]:.6f} s; "
                "nothing is extrapolated"
            )
        if len(self) == 1:
            return Trajectory(t, np.repeat(self.T_world_body, len(t), axis=0))
        k = np.clip(np.searchsorted(self.t_s, t, "right") - 1, 0, len(self) - 2)
        fraction = np.clip((t - self.t_s[k]) / (self.t_s[k + 1] - self.t_s[k]), 0, 1)
        return Trajectory(t, se3.interpolate(self.T_world_body[k], self.T_world_body[k + 1], fraction))
