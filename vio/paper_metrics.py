"""The twelve metrics of the V²-SfMLearner paper (section 4.3, table of ego-motion metrics) and the 5-frame ATE.

The paper's "ATE" is the mean error of the ADJACENT-FRAME displacement: no trajectory, no alignment, no scale. It is
called `ate_paper` here and does not compare with `vio.metrics.ate`. Where the paper leaves a choice open (Euler
order, units, division by a truth of zero, scaling of depth) the choice is stated below and named in the result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.errors import TrajectoryError

Array = NDArray[np.float64]

EULER = "roll, pitch, yaw about the fixed x, y, z axes of the first camera (R = Rz Ry Rx) [rad]"


class PaperMotionMetrics(TypedDict):
    """Six metrics of adjacent-frame motion, in the unit of the translations and in rad."""

    ate_paper: float
    """Mean Euclidean norm of the translation error."""
    abs_diff_t: float
    """Mean over pairs of the summed absolute error of x, y, z."""
    abs_rel_t: float | None
    """The same, each error divided by the absolute truth; None when every truth is below the limit."""
    are_paper: float
    """Mean Euclidean norm of the Euler angle errors [rad]."""
    abs_diff_r: float
    abs_rel_r: float | None
    abs_rel_t_excluded: int
    """Coordinates, of 3 per pair, left out of `abs_rel_t` because the truth is below `limit_t`."""
    abs_rel_r_excluded: int
    limit_t: float
    limit_r_rad: float
    pairs: int
    euler: str


class PaperDepthMetrics(TypedDict):
    """Six metrics of depth, averaged over images, in the unit of the depths."""

    abs_diff: float
    """Mean |error|."""
    abs_rel: float
    """Mean |error| / truth."""
    sq_rel: float
    """Mean error² / truth."""
    rmse: float
    """Root mean error²."""
    log_rmse: float
    """Root mean squared difference of natural logarithms."""
    acc_1_25: float
    """Fraction of pixels with max(prediction / truth, truth / prediction) below 1.25."""
    depth_scale: Literal["none", "median"]
    """Whether each prediction was first multiplied by median truth / median prediction."""
    images: int
    pixels: int
    """Valid pixels of all images."""


@dataclass(frozen=True)
class SnippetAte:
    """The SfMLearner family's ATE over all overlapping snippets, in the unit of the truth."""

    mean: float
    sd: float
    """Population standard deviation over snippets."""
    rmse: float
    """Root mean square position error over the same scaled snippets: what the name promises."""
    frames: int
    """Poses per snippet."""
    snippets: int


def euler_angles_rad(R: ArrayLike) -> Array:
    """Roll φ, pitch ϑ, yaw ψ (..., 3) [rad] of rotations (..., 3, 3): `R = Rz(ψ) Ry(ϑ) Rx(φ)`, scipy's "xyz".

    The paper names no order. Between adjacent frames all orders agree to first order in the angle.
    """
    R = np.asarray(R, float)
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 0, 0], R[..., 1, 0]))
    # From the second column of R Rx(φ)ᵀ = Rz Ry, which does not vanish where pitch is ±90°.
    s, c = np.sin(roll), np.cos(roll)
    yaw = np.arctan2(s * R[..., 0, 2] - c * R[..., 0, 1], c * R[..., 1, 1] - s * R[..., 1, 2])
    return np.stack([roll, pitch, yaw], axis=-1)


def paper_motion_metrics(T_pred: ArrayLike, T_true: ArrayLike, limit_t: float = 1e-6,
                         limit_r_rad: float = 1e-5) -> PaperMotionMetrics:
    """The paper's six ego-motion metrics of N adjacent-frame motions.

    AbsRel divides by |truth|, where the paper divides by the signed truth, and leaves out coordinates whose truth
    is below a limit: three times the mean over the remaining coordinates, which is the paper's sum over axes when
    none is left out. Angle errors are wrapped to [-π, π).

    Args:
        T_pred: (N, 4, 4) predicted motions `T_k_k1`.
        T_true: (N, 4, 4) true motions in the same unit.
        limit_t: smallest |truth| that AbsRel_t divides by, in that unit.
        limit_r_rad: the same for AbsRel_r.

    Raises:
        TrajectoryError: empty, different lengths, or a limit that is not positive.
        GeometryError: a motion that is no rigid transform.
    """
    pred, true = _check_motions(T_pred, T_true)
    for name, limit in (("limit_t", limit_t), ("limit_r_rad", limit_r_rad)):
        if not (np.isfinite(limit) and limit > 0):
            raise TrajectoryError(f"paper metrics: {name} is {limit}, must be a positive number")
    angles = euler_angles_rad(true[:, :3, :3])
    turn = (euler_angles_rad(pred[:, :3, :3]) - angles + np.pi) % (2 * np.pi) - np.pi
    t = _vector_metrics(pred[:, :3, 3] - true[:, :3, 3], true[:, :3, 3], limit_t)
    r = _vector_metrics(turn, angles, limit_r_rad)
    return {
        "ate_paper": t[0], "abs_diff_t": t[1], "abs_rel_t": t[2], "are_paper": r[0], "abs_diff_r": r[1],
        "abs_rel_r": r[2], "abs_rel_t_excluded": t[3], "abs_rel_r_excluded": r[3], "limit_t": limit_t,
        "limit_r_rad": limit_r_rad, "pairs": len(true), "euler": EULER,
    }


def _vector_metrics(error: Array, truth: Array, limit: float) -> tuple[float, float, float | None, int]:
    """Mean norm, mean 1-norm, relative 1-norm and how many coordinates it leaves out, of (N, 3) errors."""
    kept = np.abs(truth) >= limit
    relative = float(3 * np.mean(np.abs(error[kept] / truth[kept]))) if kept.any() else None
    return (float(np.linalg.norm(error, axis=1).mean()), float(np.abs(error).sum(axis=1).mean()), relative,
            int((~kept).sum()))


def snippet_ate(T_pred: ArrayLike, T_true: ArrayLike, frames: int = 5) -> SnippetAte:
    """ATE as SfMLearner, EndoSfMLearner, AF-SfMLearner and EndoDAC print it.

    Every run of `frames` poses starts at the origin and is scaled by its own least-squares factor; its value is
    `sqrt(Σ |error|²) / frames`, NOT the root of the mean, and the exact first pose counts. Such values are smaller
    than an RMSE, hide scale drift and do not compare across snippet lengths. Truncated tails are left out.

    Args:
        T_pred: (N, 4, 4) predicted motions `T_k_k1` of consecutive frames, any scale.
        T_true: (N, 4, 4) true motions.
        frames: poses per snippet, 2 or more.

    Raises:
        TrajectoryError: different lengths, or fewer than `frames` - 1 motions.
        GeometryError: a motion that is no rigid transform.
    """
    pred, true = _check_motions(T_pred, T_true)
    if frames < 2 or len(true) < frames - 1:
        raise TrajectoryError(f"snippet ATE: {len(true)} motions, {frames} frames per snippet; need 2 or more frames "
                              "and one motion fewer than that")
    p, x = _snippet_positions(pred, frames), _snippet_positions(true, frames)
    square = (p**2).sum(axis=(1, 2))
    scale = (p * x).sum(axis=(1, 2)) / np.where(square > 0, square, 1.0)
    square_error = ((scale[:, None, None] * p - x) ** 2).sum(axis=(1, 2))
    value = np.sqrt(square_error) / frames
    rmse = float(np.sqrt(square_error.mean() / frames))
    return SnippetAte(float(value.mean()), float(value.std()), rmse, frames, len(value))


def _snippet_positions(steps: Array, frames: int) -> Array:
    """(S, frames, 3) positions of all overlapping snippets, each in the axes of its first pose."""
    count = len(steps) - frames + 2
    T = np.broadcast_to(np.eye(4), (count, 4, 4))
    positions = [T[:, :3, 3]]
    for k in range(frames - 1):
        T = T @ steps[k : k + count]
        positions.append(T[:, :3, 3])
    return np.stack(positions, axis=1)


def _check_motions(T_pred: ArrayLike, T_true: ArrayLike) -> tuple[Array, Array]:
    pred, true = np.asarray(T_pred, float), np.asarray(T_true, float)
    if pred.shape != true.shape or true.ndim != 3 or len(true) == 0:
        raise TrajectoryError(
            f"motion metrics: predicted {pred.shape} and true motions {true.shape}; both must be (N, 4, 4), N ≥ 1"
        )
    return se3.check_transforms(pred, "T_pred"), se3.check_transforms(true, "T_true")


def paper_depth_metrics(pred: ArrayLike, truth: ArrayLike, valid: ArrayLike | None = None,
                        median_scaling: bool = False) -> PaperDepthMetrics:
    """The paper's six depth metrics: over the valid pixels of each image, then averaged over images.

    Args:
        pred: (H, W) or (N, H, W) predicted depth; nothing is clipped or cropped.
        truth: true depth, same shape and unit; zero, negative and non-finite pixels are not valid.
        valid: mask of the pixels to compare, (H, W) or the shape of `truth`; all when None.
        median_scaling: multiply each prediction by median truth / median prediction first, as published code does.
            The paper does not mention it; off by default, and named in the result.

    Raises:
        TrajectoryError: shapes differ, an image without valid pixels, or a prediction there that is not positive.
    """
    p, x = np.asarray(pred, float), np.asarray(truth, float)
    if p.shape != x.shape or x.ndim not in (2, 3) or x.size == 0:
        raise TrajectoryError(f"depth metrics: predicted {p.shape} and true depth {x.shape} must agree as (N, H, W)")
    mask = np.isfinite(x) & (x > 0)
    if valid is not None:
        chosen = np.asarray(valid, bool)
        if chosen.shape not in (x.shape, x.shape[-2:]):
            raise TrajectoryError(f"depth metrics: mask {chosen.shape} does not fit depth {x.shape}")
        mask &= chosen
    p, x, mask = (array.reshape(-1, *array.shape[-2:]) for array in (p, x, mask))
    rows = np.array([_depth_row(p[k], x[k], mask[k], median_scaling, k) for k in range(len(x))])
    abs_diff, abs_rel, sq_rel, rmse, log_rmse, acc = (float(value) for value in rows.mean(axis=0))
    return {
        "abs_diff": abs_diff, "abs_rel": abs_rel, "sq_rel": sq_rel, "rmse": rmse, "log_rmse": log_rmse,
        "acc_1_25": acc, "depth_scale": "median" if median_scaling else "none", "images": len(x),
        "pixels": int(mask.sum()),
    }


def _depth_row(pred: Array, truth: Array, mask: NDArray[np.bool_], median_scaling: bool, image: int) -> Array:
    """(6,) metrics of one image."""
    p, x = pred[mask], truth[mask]
    if len(x) == 0:
        raise TrajectoryError(f"depth metrics: image {image} has no valid pixel; leave it out")
    bad = ~(np.isfinite(p) & (p > 0))
    if bad.any():
        raise TrajectoryError(
            f"depth metrics: image {image} predicts {p[bad][0]:g} at {int(bad.sum())} of {len(x)} valid pixels; "
            "depth must be positive, mask them"
        )
    if median_scaling:
        p = p * (np.median(x) / np.median(p))
    error = p - x
    return np.array([
        np.abs(error).mean(), (np.abs(error) / x).mean(), (error**2 / x).mean(), np.sqrt((error**2).mean()),
        np.sqrt((np.log(p / x) ** 2).mean()), (np.maximum(p / x, x / p) < 1.25).mean(),
    ])
