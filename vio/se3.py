"""Batched SO(3) and SE(3) in numpy: every function maps over any leading shape.

Transforms are (..., 4, 4) arrays named `T_a_b`, which map coordinates of frame b to frame a.
Tangent vectors are rotation first, then translation, applied on the right: `T = T_bar · Exp(xi)`.
Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from vio.errors import GeometryError

Array = NDArray[np.float64]

SMALL_ANGLE = 1e-4  # below it the Taylor series is exact to double precision
ORTHONORMAL_TOLERANCE = 1e-4  # text files with 5 digits pass, a scaled or sheared matrix does not


def skew(v: ArrayLike) -> Array:
    """Cross-product matrix of (..., 3) vectors: `skew(a) @ b == cross(a, b)`."""
    v = np.asarray(v, float)
    out: Array = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def _rotation(matrices: Array) -> Rotation:
    return Rotation.from_matrix(matrices.reshape(-1, 3, 3))


def so3_exp(rotvec: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    w = np.asarray(rotvec, float)
    R: Array = Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(*w.shape[:-1], 3, 3)
    return R


def so3_log(R: ArrayLike) -> Array:
    """Rotation vectors (..., 3) [rad], of length at most pi, of rotation matrices (..., 3, 3)."""
    R = np.asarray(R, float)
    cosine = 0.5 * (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0)
    if cosine.size and cosine.min() > 0.0:  # far from half a turn the sine says it all, ten times faster
        sine = 0.5 * np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]],
                              axis=-1)
        size = np.sqrt(np.einsum("...k,...k->...", sine, sine))
        angle = np.arctan2(size, cosine)
        ratio = np.where(size > 1e-8, angle / np.where(size > 1e-8, size, 1.0), 1.0)
        return np.asarray(sine * ratio[..., None])
    rotvec: Array = _rotation(R).as_rotvec().reshape(*R.shape[:-2], 3)
    return rotvec


def _jacobian_coefficients(angle: Array) -> tuple[Array, Array]:
    """(1 - cos a) / a² and (a - sin a) / a³, with their series near zero."""
    small = angle < SMALL_ANGLE
    a = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24, 2 * np.sin(0.5 * a) ** 2 / a**2)
    # a - sin a loses all digits below about 1e-2, so the series reaches further there.
    series = 1 / 6 - angle**2 / 120 + angle**4 / 5040
    second = np.where(angle < 1e-2, series, (a - np.sin(a)) / a**3)
    return first, second


def so3_right_jacobian(rotvec: ArrayLike) -> Array:
    """J_r with `Exp(w + d) ≈ Exp(w) Exp(J_r(w) d)`, shape (..., 3, 3)."""
    w = np.asarray(rotvec, float)
    squared = np.einsum("...k,...k->...", w, w)
    first, second = _jacobian_coefficients(np.sqrt(squared))
    return _about(w, squared, -first, second)


def _about(w: Array, squared: Array, a: Array, b: Array) -> Array:
    """1 + a K + b K² with K = skew(w), K² = w wᵀ - |w|² 1, and |w|² given."""
    out: Array = skew(a[..., None] * w)
    out += (b[..., None] * w)[..., :, None] * w[..., None, :]
    for k in range(3):
        out[..., k, k] += 1.0 - b * squared
    return out


def so3_right_jacobian_inverse(rotvec: ArrayLike) -> Array:
    """Inverse of `so3_right_jacobian`, finite for |w| < 2 pi, shape (..., 3, 3)."""
    w = np.asarray(rotvec, float)
    squared = np.einsum("...k,...k->...", w, w)
    angle = np.sqrt(squared)
    small = angle < 1e-2
    a = np.where(small, 1.0, angle)
    half = 0.5 * a
    coefficient = np.where(small, 1 / 12 + squared / 720, (1 - half / np.tan(half)) / a**2)
    return _about(w, squared, np.full_like(angle, 0.5), coefficient)


def transform(R: ArrayLike, t: ArrayLike) -> Array:
    """Stack rotations (..., 3, 3) and translations (..., 3) into transforms (..., 4, 4)."""
    R, t = np.asarray(R, float), np.asarray(t, float)
    shape = np.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def exp(xi: ArrayLike) -> Array:
    """Transforms (..., 4, 4) of tangent vectors (..., 6), rotation first."""
    xi = np.asarray(xi, float)
    w, v = xi[..., :3], xi[..., 3:]
    left_jacobian = np.swapaxes(so3_right_jacobian(w), -1, -2)
    return transform(so3_exp(w), (left_jacobian @ v[..., None])[..., 0])


def log(T: ArrayLike) -> Array:
    """Tangent vectors (..., 6), rotation first, of transforms (..., 4, 4)."""
    T = np.asarray(T, float)
    w = so3_log(T[..., :3, :3])
    left_inverse = np.swapaxes(so3_right_jacobian_inverse(w), -1, -2)
    return np.concatenate([w, (left_inverse @ T[..., :3, 3:])[..., 0]], axis=-1)


def inverse(T: ArrayLike) -> Array:
    """`T_b_a` of `T_a_b`, using that the rotation part is orthonormal."""
    T = np.asarray(T, float)
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_t, -(R_t @ T[..., :3, 3:])[..., 0])


def adjoint(T: ArrayLike) -> Array:
    """Ad (..., 6, 6) with `T Exp(xi) T⁻¹ = Exp(Ad xi)`, rotation first."""
    T = np.asarray(T, float)
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = skew(T[..., :3, 3]) @ R
    return out


def interpolate(T_w_a: ArrayLike, T_w_b: ArrayLike, fraction: ArrayLike) -> Array:
    """Poses between a (fraction 0) and b (fraction 1): slerp for rotation, straight line for position."""
    T_w_a, T_w_b, f = np.asarray(T_w_a, float), np.asarray(T_w_b, float), np.asarray(fraction, float)
    turn = so3_log(np.swapaxes(T_w_a[..., :3, :3], -1, -2) @ T_w_b[..., :3, :3])
    R = T_w_a[..., :3, :3] @ so3_exp(f[..., None] * turn)
    t = (1 - f[..., None]) * T_w_a[..., :3, 3] + f[..., None] * T_w_b[..., :3, 3]
    return transform(R, t)


def chain(T_k_k1: ArrayLike, T_first: ArrayLike | None = None) -> Array:
    """Poses (N+1, 4, 4) of N consecutive relative motions (N, 4, 4), starting at `T_first`.

    Stretches of about sqrt(N) motions are chained side by side, and then onto each other. Rotations are brought back
    onto SO(3) at the end of every stretch, so 100,000 products stay orthonormal.
    """
    steps = np.asarray(T_k_k1, float)
    first = np.eye(4) if T_first is None else np.asarray(T_first, float)
    T = np.concatenate([first[None], steps])
    size = int(np.ceil(np.sqrt(len(T))))
    stretches = -(-len(T) // size)
    inside = np.broadcast_to(np.eye(4), (stretches * size, 4, 4)).copy()
    inside[:len(T)] = T
    inside = inside.reshape(stretches, size, 4, 4)
    for k in range(1, size):
        inside[:, k] = inside[:, k - 1] @ inside[:, k]
    for k in range(1, stretches):
        begin = inside[k - 1, -1]
        begin[:3, :3] = _rotation(begin[:3, :3]).as_matrix()
        inside[k] = begin @ inside[k]
    T = inside.reshape(-1, 4, 4)[:len(T)]
    T[:, :3, :3] = _rotation(T[:, :3, :3]).as_matrix()
    return T


def quat_xyzw_from_matrix(R: ArrayLike) -> Array:
    """Unit quaternions (..., 4) in x, y, z, w order with w ≥ 0, of rotation matrices (..., 3, 3)."""
    R = np.asarray(R, float)
    quat_xyzw: Array = _rotation(R).as_quat(canonical=True).reshape(*R.shape[:-2], 4)
    return quat_xyzw


def matrix_from_quat_xyzw(quat_xyzw: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) in x, y, z, w order."""
    q = np.asarray(quat_xyzw, float)
    R: Array = Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)
    return R


def check_transforms(T: ArrayLike, name: str) -> Array:
    """Return T as float64 (..., 4, 4) with rotations projected onto SO(3).

    Raises:
        GeometryError: wrong shape, a value that is not finite, or a rotation that is not
            orthonormal to 1e-4, naming `name` and the first bad index.
    """
    T = np.array(T, float)
    if T.shape[-2:] != (4, 4):
        raise GeometryError(f"{name}: shape {T.shape}, expected (..., 4, 4)")
    flat = T.reshape(-1, 4, 4)
    finite = np.isfinite(flat).all(axis=(1, 2))
    if not finite.all():
        raise GeometryError(f"{name}[{np.argmin(finite)}]: a value is not finite; drop or repair that entry")
    R = flat[:, :3, :3]
    row = np.abs(flat[:, 3] - [0, 0, 0, 1]).max(axis=1, initial=0.0)
    with np.errstate(over="ignore", invalid="ignore"):  # absurd numbers are found bad below
        off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2), initial=0.0)
        determinant = np.linalg.det(R)
    bad = ~((off <= ORTHONORMAL_TOLERANCE) & (row <= 1e-9) & (determinant > 0))
    if bad.any():
        k = int(np.argmax(bad))
        raise GeometryError(
            f"{name}[{k}]: not a rigid transform (|RᵀR - I| = {off[k]:.2g}, limit {ORTHONORMAL_TOLERANCE:g}, "
            f"det {determinant[k]:.3g}); check row/column order, units and handedness"
        )
    flat[:, :3, :3] = _rotation(R).as_matrix() if len(R) else R
    return flat.reshape(T.shape)


def check_covariances(cov: ArrayLike, name: str) -> Array:
    """Return cov as float64 (..., n, n), symmetrised.

    Raises:
        GeometryError: not square, not finite, not symmetric or not positive definite, naming the index.
    """
    cov = np.array(cov, float)
    if cov.ndim < 2 or cov.shape[-1] != cov.shape[-2]:
        raise GeometryError(f"{name}: shape {cov.shape}, expected (..., n, n)")
    flat = cov.reshape(-1, *cov.shape[-2:])
    finite = np.isfinite(flat).all(axis=(1, 2))
    if not finite.all():
        raise GeometryError(f"{name}[{np.argmin(finite)}]: a value is not finite; drop or repair that entry")
    flat = 0.5 * (flat + np.swapaxes(flat, 1, 2))
    # Scale to unit diagonal first: radians² and metres² differ by many orders of magnitude.
    diagonal = np.diagonal(flat, axis1=1, axis2=2)
    root = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    smallest = np.linalg.eigvalsh(flat / (root[:, :, None] * root[:, None, :])).min(axis=1, initial=np.inf)
    bad = (diagonal <= 0).any(axis=1) | (smallest < 1e-12)
    asymmetric = np.abs(cov.reshape(flat.shape) - flat).max(axis=(1, 2), initial=0) > 1e-6 * diagonal.max(axis=1)
    bad |= asymmetric
    if bad.any():
        k = int(np.argmax(bad))
        raise GeometryError(
            f"{name}[{k}]: not a positive definite covariance (smallest eigenvalue of its correlation "
            f"{smallest[k]:.2g}, limit 1e-12); give rad² and motion-unit² on the diagonal"
        )
    checked: Array = flat.reshape(cov.shape)
    return checked
