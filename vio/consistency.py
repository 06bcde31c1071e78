"""Whether a trajectory's covariances are honest: normalised errors and the coverage of intervals.

Source: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), section 5.4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import norm

from vio import se3
from vio.alignment import check_pair
from vio.errors import TrajectoryError
from vio.trajectory import Trajectory

Array = NDArray[np.float64]


def fix_gauge(estimate: Trajectory, reference: Trajectory) -> Trajectory:
    """The reference, turned about world z and shifted until the first poses agree in position and yaw.

    Those four degrees of freedom are chosen, not estimated, so they are no error. "Agree in yaw" means that the
    world-z component of `Log(R_reference R_estimateᵀ)` is zero at the first pose.

    Raises:
        TrajectoryError: different lengths or times.
    """
    check_pair(estimate, reference, "gauge")
    _, _, z, w = se3.quat_xyzw_from_matrix(reference.rotations[0] @ estimate.rotations[0].T)
    R = se3.so3_exp([0.0, 0.0, -2 * np.arctan2(z, w)])  # removes the twist about z (swing-twist decomposition)
    t = estimate.positions_m[0] - R @ reference.positions_m[0]
    return Trajectory(reference.t_s, se3.transform(R, t) @ reference.T_world_body)


def nees(estimate: Trajectory, reference: Trajectory) -> Array:
    """Normalised estimation error squared per degree of freedom: `ξᵀ Σ⁻¹ ξ / 6`, `ξ = Log(T_estimate⁻¹ T_reference)`.

    Its mean is 1 when the covariances are honest, above 1 when they are overconfident. The gauge is fixed by the
    first pose (`fix_gauge`), whose own covariance is singular by construction: its entry is nan. That must be the
    pose the estimator started from: where truth begins later, the error there is not zero and NEES is too large.

    Returns:
        (N,) values; index 0 is nan.

    Raises:
        TrajectoryError: no covariances, different lengths or times.
        GeometryError: a covariance after the first is not positive definite.
    """
    if estimate.cov is None:
        raise TrajectoryError("nees: the estimate has no covariances; give a trajectory that carries them")
    moved = fix_gauge(estimate, reference)
    cov = estimate.cov.copy()
    cov[0] = np.eye(6)
    cov = se3.check_covariances(cov, "estimate covariance")
    sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    # Unit diagonal first: rad² and m² may differ by many orders of magnitude.
    factor = np.linalg.cholesky(cov / (sd[:, :, None] * sd[:, None, :]))
    xi = se3.log(se3.inverse(estimate.T_world_body) @ moved.T_world_body)
    whitened = np.linalg.solve(factor, (xi / sd)[:, :, None])[:, :, 0]
    out: Array = (whitened**2).sum(axis=1) / 6
    out[0] = np.nan
    return out


def coverage(values: ArrayLike, sd: ArrayLike, truth: ArrayLike, level: float = 0.95) -> float:
    """Fraction of truths inside the central Gaussian interval `values ± z sd`; honest when it equals `level`.

    Raises:
        TrajectoryError: empty, shapes that differ, values that are not finite, sd not positive, or level not in (0, 1).
    """
    v, s, x = (np.asarray(array, float) for array in (values, sd, truth))
    if v.size == 0 or not v.shape == s.shape == x.shape:
        raise TrajectoryError(f"coverage: shapes {v.shape}, {s.shape}, {x.shape} must be equal and not empty")
    good = np.isfinite(v) & np.isfinite(s) & np.isfinite(x) & (s > 0)
    if not good.all():
        k = int(np.argmin(good.ravel()))
        raise TrajectoryError(f"coverage: entry {k} is not finite or its sd is not positive; leave it out")
    if not 0 < level < 1:
        raise TrajectoryError(f"coverage: level {level} must lie between 0 and 1")
    return float((np.abs(v - x) <= norm.ppf(0.5 + 0.5 * level) * s).mean())
