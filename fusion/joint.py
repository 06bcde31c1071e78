"""Joint uncertainty of a whole trajectory, as samples of its error.

Marginal covariances say how well each pose is known, not how the errors of two poses hang together; a distance along
the path needs the latter. Samples carry it for every estimator alike, and a run folder can hold them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from vio import se3

Array = NDArray[np.float64]

SAMPLES = 100
"""Standard deviations estimated from as many samples are good to 7 %."""
CHECKPOINTS = 2000
"""At most about as many frames carry samples; errors between neighbours of them are interpolated."""
SEED = 20


@dataclass(frozen=True)
class JointSamples:
    """S draws of the error of a trajectory, at K of its frames."""

    node: NDArray[np.int64]
    """(K,) frames that carry samples, first and last included."""
    xi: Array
    """(S, K, 6) right perturbations in body axes, rotation first: a possible truth is `T Exp(xi)`."""
    log_scale: Array
    """(S, K) deviations of ln(metres per motion unit)."""

    def position_errors(self, R_world_body: Array, frames: NDArray[np.int64]) -> Array:
        """(S, F, 3) position errors in world axes [m] at some of the M frames of R_world_body (M, 3, 3)."""
        return self._in_world(self.xi[..., 3:], R_world_body, frames)

    def rotation_errors(self, R_world_body: Array, frames: NDArray[np.int64]) -> Array:
        """(S, F, 3) rotation vectors of the errors in world axes [rad] at some of the M frames."""
        return self._in_world(self.xi[..., :3], R_world_body, frames)

    def scale_errors(self, frames: NDArray[np.int64]) -> Array:
        """(S, F) errors of the log scale at some of the M frames."""
        left, right, share = self._around(frames)
        return np.asarray((1 - share) * self.log_scale[:, left] + share * self.log_scale[:, right])

    def _in_world(self, part: Array, R_world_body: Array, frames: NDArray[np.int64]) -> Array:
        left, right, share = self._around(frames)
        ends = [np.swapaxes(np.swapaxes(part[:, k], 0, 1) @ np.swapaxes(R_world_body[self.node[k]], 1, 2), 0, 1)
                for k in (left, right)]
        return np.asarray((1 - share[:, None]) * ends[0] + share[:, None] * ends[1])

    def _around(self, frames: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Checkpoints (F,), (F,) around frames, and how far (F,) these are from the one to the other."""
        right = np.minimum(np.searchsorted(self.node, frames), len(self.node) - 1)
        left = np.maximum(right - 1, 0)
        span = np.maximum(self.node[right] - self.node[left], 1)
        return left, right, np.clip((frames - self.node[left]) / span, 0.0, 1.0)


def checkpoints(frames: int) -> NDArray[np.int64]:
    """Which of M frames carry samples: all, or about `CHECKPOINTS` evenly spread."""
    return np.unique(np.linspace(0, frames - 1, min(frames, CHECKPOINTS)).round().astype(np.int64))


def with_assumed_scale(joint: JointSamples, T_world_body: Array, log_scale_sd: float, T_body_camera: Array,
                       rng: np.random.Generator) -> JointSamples:
    """Samples widened for what was assumed about scale, not estimated: one draw stretches a whole trajectory.

    As `fusion.estimate.add_scale_uncertainty` does for covariances.
    """
    count = len(joint.xi)
    # Equally likely quantiles in random order: their standard deviation is not left to chance.
    draw = log_scale_sd * rng.permutation(norm.ppf((np.arange(count) + 0.5) / count))
    xi = joint.xi.copy()
    xi[..., 3:] += draw[:, None, None] * stretch_directions(T_world_body, T_body_camera)[joint.node]
    return JointSamples(joint.node, xi, joint.log_scale + draw[:, None])


def stretch_directions(T_world_body: Array, T_body_camera: Array) -> Array:
    """d(position)/d(log scale) (M, 3) in body axes: the camera's way from its first position, which scale stretches."""
    camera = (T_world_body @ T_body_camera)[:, :3, 3]
    return np.asarray((np.swapaxes(T_world_body[:, :3, :3], 1, 2) @ (camera - camera[0])[:, :, None])[:, :, 0])


def chain_samples(T_world_body: Array, first_cov: Array, step_cov: Array, rng: np.random.Generator) -> JointSamples:
    """Samples of chained motions whose errors are independent: ξ_{k+1} = Ad ξ_k + q_k.

    Args:
        T_world_body: (M, 4, 4) the chained poses.
        first_cov: (6, 6) of the first pose.
        step_cov: (M-1, 6, 6) of the motions of the body.
        rng: source of the draws.
    """
    m = len(T_world_body)
    node = checkpoints(m)
    keep = np.zeros(m, bool)
    keep[node] = True
    back = se3.adjoint(se3.inverse(se3.inverse(T_world_body[:-1]) @ T_world_body[1:]))
    error = rng.standard_normal((SAMPLES, 6)) @ square_root(first_cov).T
    kept = [error]
    for k in range(m - 1):
        error = error @ back[k].T + rng.standard_normal((SAMPLES, 6)) @ square_root(step_cov[k]).T
        if keep[k + 1]:
            kept.append(error)
    return JointSamples(node, np.stack(kept, axis=1), np.zeros((SAMPLES, len(node))))


def square_root(cov: Array) -> Array:
    """A with A Aᵀ = cov (..., n, n), also for covariances that are only positive semidefinite."""
    root = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))
    unit = np.where(root > 0, root, 1.0)
    values, vectors = np.linalg.eigh(cov / (unit[..., :, None] * unit[..., None, :]))
    scaled: Array = unit[..., :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return scaled
