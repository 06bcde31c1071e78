"""The motion between two views from their rays alone: five-point RANSAC and the choice of a start.

Five points: Stewénius, Engels and Nistér, "Recent developments on direct relative orientation" (2006).
Everything works on unit rays, so a fisheye's field of view may exceed 180 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.rays import Rays

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

SAMPLES = 300
REAL = 1e-6  # largest imaginary part, relative, of an eigenvalue that counts as real


@dataclass(frozen=True)
class TwoView:
    """Relative pose of view 2 in view 1; its translation has length 1."""

    T_1_2: Array
    """(4, 4)"""
    inlier: Bools
    """(n,) correspondences within the threshold and in front of both views."""


@cache
def _products() -> tuple[Array, Array]:
    """Tables that multiply polynomials in x, y, z: (10, 4, 4) linear by linear and (20, 10, 4) quadratic by linear.

    Linear terms are the letters x, y, z, 1; other monomials are words of two or three letters.
    """
    quadratic = list(combinations_with_replacement(range(4), 2))
    cubic = list(combinations_with_replacement(range(4), 3))
    # Third powers first, for they are eliminated; then second powers, x, y, z and 1.
    cubic.sort(key=lambda m: (m.count(3), m))
    two, three = np.zeros((10, 4, 4)), np.zeros((20, 10, 4))
    for a in range(4):
        for b in range(4):
            two[quadratic.index(tuple(sorted((a, b)))), a, b] = 1
        for q, pair in enumerate(quadratic):
            three[cubic.index(tuple(sorted((*pair, a)))), q, a] = 1
    return two, three


@cache
def _action_rows() -> Ints:
    """For x times every basis monomial: the eliminated row it is, or -1 - its place in the basis."""
    cubic = sorted(combinations_with_replacement(range(4), 3), key=lambda m: (m.count(3), m))
    basis = cubic[10:]
    rows = []
    for monomial in basis:
        letters = list(monomial)
        letters[letters.index(3)] = 0  # x replaces one "1"
        k = cubic.index(tuple(sorted(letters)))
        rows.append(k if k < 10 else -1 - (k - 10))
    return np.array(rows)


def essential_candidates(first: Array, second: Array) -> Array:
    """Essential matrices (K, 3, 3) with `second · E first = 0` for samples (N, 5, 3) of rays in both views."""
    two, three = _products()
    system = (second[:, :, :, None] * first[:, :, None, :]).reshape(len(first), 5, 9)
    null = np.linalg.svd(system)[2][:, 5:].reshape(-1, 4, 3, 3)
    E = np.moveaxis(null, 1, -1)  # (N, 3, 3, 4): entries linear in x, y, z, 1
    EEt = np.einsum("qab,nika,njkb->nijq", two, E, E, optimize=True)
    trace = np.einsum("niiq->nq", EEt)
    core = EEt - 0.5 * trace[:, None, None, :] * np.eye(3)[:, :, None]
    cubic = np.einsum("cqa,nikq,nkja->nijc", three, core, E, optimize=True).reshape(-1, 9, 20)
    minors = np.einsum("qab,nia,njb->nijq", two, E[:, 1], E[:, 2], optimize=True)
    cofactor = np.stack([minors[:, 1, 2] - minors[:, 2, 1], minors[:, 2, 0] - minors[:, 0, 2],
                         minors[:, 0, 1] - minors[:, 1, 0]], axis=1)
    determinant = np.einsum("cqa,nkq,nka->nc", three, cofactor, E[:, 0], optimize=True)
    equations = np.concatenate([cubic, determinant[:, None]], axis=1)
    usable = np.abs(np.linalg.det(equations[:, :, :10])) > 1e-30
    reduced = -np.linalg.solve(equations[usable, :, :10], equations[usable, :, 10:])
    rows = _action_rows()
    action = np.where(rows[None, :, None] >= 0, reduced[:, np.maximum(rows, 0)], np.eye(10)[np.maximum(-1 - rows, 0)])
    value, vector = np.linalg.eig(action)
    real = (np.abs(value.imag) <= REAL * (1 + np.abs(value))) & (np.abs(vector[:, -1]) > 1e-12)
    n, k = np.nonzero(real)
    xyz = (vector[n, -4:-1, k] / vector[n, -1, k][:, None]).real
    found = np.einsum("nija,na->nij", E[usable][n], np.column_stack([xyz, np.ones(len(xyz))]))
    return np.asarray(found / np.linalg.norm(found, axis=(1, 2), keepdims=True))


def epipolar_distance(E: Array, first: Array, second: Array) -> Array:
    """First-order angular distance (..., n) [rad] of rays (n, 3) from the constraint of E (..., 3, 3)."""
    forward = first @ np.swapaxes(E, -1, -2)
    backward = second @ E
    size = np.sqrt((forward**2).sum(axis=-1) + (backward**2).sum(axis=-1))
    return np.asarray(np.abs((forward * second).sum(axis=-1)) / np.maximum(size, 1e-12))


def decompose_essential(E: Array) -> Array:
    """The four poses (4, 4, 4) `T_2_1` of an essential matrix (3, 3), translation of length 1."""
    U, _, Vt = np.linalg.svd(E)
    U, Vt = U * np.sign(np.linalg.det(U)), Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    R = np.array([U @ W @ Vt, U @ W.T @ Vt])
    return np.concatenate([se3.transform(R, U[:, 2]), se3.transform(R, -U[:, 2])])


def ray_depths(T_2_1: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Distances (..., n) along both rays to the point nearest to both, for poses (..., 4, 4)."""
    turned = first @ np.swapaxes(T_2_1[..., :3, :3], -1, -2)
    t = T_2_1[..., None, :3, 3]
    cosine = (turned * second).sum(-1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    a, b = (turned * t).sum(-1), (second * t).sum(-1)
    return (cosine * b - a) / sine2, (b - cosine * a) / sine2


def relative_pose(first: Rays, second: Rays, threshold_px: float, rng: np.random.Generator) -> TwoView | None:
    """RANSAC over five-point samples of n corresponding rays; None when nothing fits.

    Args:
        first, second: n rays in the two views.
        threshold_px: distance from the epipolar line at which a correspondence counts as wrong.
        rng: source of the samples.
    """
    n = len(first)
    if n < 6:
        return None
    sample = rng.random((SAMPLES, n)).argsort(axis=1)[:, :5]
    E = essential_candidates(first.bearing[sample], second.bearing[sample])
    if len(E) == 0:
        return None
    scale = np.sqrt(first.pixels_per_radian * second.pixels_per_radian)
    distance = epipolar_distance(E, first.bearing, second.bearing) * scale / threshold_px
    best = E[np.minimum(distance**2, 1).sum(axis=1).argmin()]
    near = epipolar_distance(best, first.bearing, second.bearing) * scale < threshold_px
    poses = decompose_essential(best)
    d1, d2 = ray_depths(poses, first.bearing, second.bearing)
    front = near & (d1 > 0) & (d2 > 0)
    k = int(front.sum(axis=1).argmax())
    return TwoView(se3.inverse(poses[k]), front[k])


def parallax(first: Array, second: Array) -> float:
    """Median angle [rad] between rays (n, 3) of two views after the rotation that aligns them best is taken out."""
    weight = np.ones(len(first))
    angle = np.zeros(len(first))
    for _ in range(5):
        U, _, Vt = np.linalg.svd((second * weight[:, None]).T @ first)
        R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
        angle = np.linalg.norm(np.cross(first @ R.T, second), axis=1)
        weight = 1 / (1 + (angle / max(float(np.median(angle)), 1e-9)) ** 2)
    return float(np.median(np.arcsin(np.minimum(angle, 1))))
