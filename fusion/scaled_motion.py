"""The scaled relative-motion factor, linearised for all motions at once in numpy.

A motion source reports the CAMERA's motion `T_i_j` with translation in its own units. With body poses
X_i, X_j, camera pose `T_body_camera` = (R_bc, t_bc) and log scale s, the residual is in the source's units:

    R_pred = R_bcᵀ R_iᵀ R_j R_bc
    t_pred = R_bcᵀ (R_iᵀ (p_j - p_i) + R_iᵀ R_j t_bc - t_bc)            [m]
    e_R    = Log(R_measᵀ R_pred)                                         [rad]
    e_t    = R_measᵀ (exp(-s) t_pred - t_meas)                           [motion units]

Residuals in metres, `t_pred - exp(s) t_meas`, would pull s down (errors in variables); these do not.
No Python callback runs inside a C++ optimiser: gtsam copies all values for each call, which is
quadratic in the number of frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vio import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ScaledMotions:
    """N motions between nodes i and j, ready to be linearised."""

    i: NDArray[np.int64]
    """(N,) node of the first frame."""
    j: NDArray[np.int64]
    """(N,) node of the second frame, larger than i."""
    R: Array
    """(N, 3, 3) measured rotation of camera j in camera i."""
    t: Array
    """(N, 3) measured translation, motion units."""
    whiten: Array
    """(N, 6, 6) inverse Cholesky factor of the covariance of [e_R, e_t]."""
    T_body_camera: Array
    """(4, 4)"""
    held_log_scale: Array | None = None
    """(N,) log scale of motions that say nothing of it; NaN where it is estimated. None = of all."""

    def __len__(self) -> int:
        return len(self.i)

    def select(self, index: NDArray[np.int64] | NDArray[np.bool_] | slice, first_node: int = 0) -> ScaledMotions:
        """The motions at `index`, with nodes renumbered from `first_node`."""
        held = None if self.held_log_scale is None else self.held_log_scale[index]
        return ScaledMotions(self.i[index] - first_node, self.j[index] - first_node, self.R[index], self.t[index],
                             self.whiten[index], self.T_body_camera, held)

    def surest_neighbours(self, nodes: int) -> NDArray[np.int64]:
        """(nodes-1,) the surest motion from every node to the next, -1 where none is: the choice of `chain_motions`."""
        order = np.argsort(-self._variance, kind="stable")
        order = order[(self.j - self.i)[order] == 1]
        surest = np.full(nodes - 1, -1, np.int64)
        surest[self.i[order]] = order
        return surest

    @cached_property
    def _variance(self) -> Array:
        """(N,) traces of the covariances."""
        return np.asarray(np.square(np.linalg.inv(self.whiten)).sum(axis=(1, 2)))

    def body_rotation(self) -> Array:
        """(N, 3, 3) measured rotation of body j in body i."""
        R_bc = self.T_body_camera[:3, :3]
        return R_bc @ self.R @ R_bc.T

    def body_motion(self, log_scale: float) -> Array:
        """(N, 4, 4) metric motion of the body at a given log scale."""
        metric = se3.transform(self.R, self.t * np.exp(log_scale))
        return self.T_body_camera @ metric @ se3.inverse(self.T_body_camera)


@dataclass(frozen=True)
class Linearized:
    """Whitened Gauss-Newton blocks of N motions around the current state."""

    columns: Array
    """(N, 6, 14) side by side: A_s, A_i, A_j and b."""
    squared_norm: Array
    """(N,) whitened residual squared, before any robust weight."""

    @property
    def A_s(self) -> Array:
        """(N, 6, 1) with respect to the log scale."""
        return self.columns[:, :, :1]

    @property
    def A_i(self) -> Array:
        """(N, 6, 6) with respect to pose i, right perturbation, rotation first."""
        return self.columns[:, :, 1:7]

    @property
    def A_j(self) -> Array:
        """(N, 6, 6) with respect to pose j."""
        return self.columns[:, :, 7:13]

    @property
    def b(self) -> Array:
        """(N, 6) right-hand side, minus the whitened residual."""
        return self.columns[:, :, 13]


def make_motions(i: NDArray[np.int64], j: NDArray[np.int64], T_i_j: Array, cov: Array,
                 T_body_camera: Array) -> ScaledMotions:
    """Whiten measured motions (N, 4, 4) with their right-perturbation covariances (N, 6, 6)."""
    lower = np.linalg.cholesky(cov)
    return ScaledMotions(i, j, T_i_j[:, :3, :3], T_i_j[:, :3, 3], np.linalg.inv(lower), T_body_camera)


def residuals(motions: ScaledMotions, R: Array, p: Array, log_scale: Array) -> Array:
    """Whitened residuals (N, 6) at body poses R (M, 3, 3), p (M, 3) and per-motion log scales (N,)."""
    R_pred, t_pred, _ = _predict(motions, R, p)
    e = _errors(np.swapaxes(motions.R, 1, 2), motions.t, R_pred, t_pred, _inverse_scale(motions, log_scale))
    return np.asarray((motions.whiten @ e[:, :, None])[:, :, 0])


def linearize(motions: ScaledMotions, R: Array, p: Array, log_scale: Array) -> Linearized:
    """Linearise all motions at body poses R (M, 3, 3), p (M, 3) [m] and per-motion log scales (N,)."""
    R_bc, t_bc = motions.T_body_camera[:3, :3], motions.T_body_camera[:3, 3]
    inverse_scale = _inverse_scale(motions, log_scale)
    R_pred, t_pred, (R_ij, t_ij) = _predict(motions, R, p)
    R_meas_t = np.swapaxes(motions.R, 1, 2)
    e = _errors(R_meas_t, motions.t, R_pred, t_pred, inverse_scale)
    J_inverse = se3.so3_right_jacobian_inverse(e[:, :3])
    to_units = _times_constant(inverse_scale[:, None, None] * R_meas_t, R_bc.T)
    D = np.zeros((len(motions), 6, 14))
    D[:, 3:, 0] = -inverse_scale[:, None] * (R_meas_t @ t_pred[:, :, None])[:, :, 0]
    if motions.held_log_scale is not None:
        D[np.isfinite(motions.held_log_scale), :, 0] = 0.0
    D[:, :3, 7:10] = _times_constant(J_inverse, R_bc.T)
    np.matmul(-J_inverse, np.swapaxes(R_pred, 1, 2) @ R_bc.T, out=D[:, :3, 1:4])
    D[:, 3:, 1:4] = to_units @ se3.skew(t_ij + R_ij @ t_bc)
    D[:, 3:, 4:7] = -to_units
    R_units = to_units @ R_ij
    D[:, 3:, 7:10] = _times_constant(R_units, -se3.skew(t_bc))
    D[:, 3:, 10:13] = R_units
    D[:, :, 13] = -e
    columns = motions.whiten @ D
    return Linearized(columns, np.einsum("nk,nk->n", columns[:, :, 13], columns[:, :, 13]))


def _inverse_scale(motions: ScaledMotions, log_scale: Array) -> Array:
    """(N,) motion units per metre."""
    held = motions.held_log_scale
    return np.exp(-log_scale if held is None else -np.where(np.isnan(held), log_scale, held))


def _predict(motions: ScaledMotions, R: Array, p: Array) -> tuple[Array, Array, tuple[Array, Array]]:
    """Predicted camera rotation and metric translation, and the body's (R_ij, t_ij)."""
    R_bc, t_bc = motions.T_body_camera[:3, :3], motions.T_body_camera[:3, 3]
    R_i_t = np.swapaxes(R[motions.i], 1, 2)
    R_ij = R_i_t @ R[motions.j]
    t_ij = (R_i_t @ (p[motions.j] - p[motions.i])[:, :, None])[:, :, 0]
    t_pred = (t_ij + R_ij @ t_bc - t_bc) @ R_bc
    return _times_constant(R_bc.T @ R_ij, R_bc), t_pred, (R_ij, t_ij)


def _times_constant(A: Array, constant: Array) -> Array:
    """Matrices (N, 3, 3) times one (3, 3), as one long product."""
    return np.asarray((A.reshape(-1, 3) @ constant).reshape(-1, 3, 3))


def _errors(R_meas_t: Array, t_meas: Array, R_pred: Array, t_pred: Array, inverse_scale: Array) -> Array:
    """(N, 6) e_R and e_t."""
    e_t = (R_meas_t @ (inverse_scale[:, None] * t_pred - t_meas)[:, :, None])[:, :, 0]
    return np.concatenate([se3.so3_log(R_meas_t @ R_pred), e_t], axis=1)
