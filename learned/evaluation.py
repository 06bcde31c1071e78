"""How good predictions are on recordings with truth, and how good guesses are that need no network.

Depth: AbsRel = mean |d - d*| / d*, Acc = share of pixels with max(d/d*, d*/d) < 1.25, after one median scale per image
or per recording. Motion: angle of the rotation's error, angle between translations where the camera moves, error of the
step after one least-squares scale per recording.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from learned.losses.priors import depth_from_light
from learned.measured import Measured
from learned.uncertainty import UncertaintyModel, motion_nees
from vio import se3

Array = NDArray[np.float64]
Maps = NDArray[np.float32]

CLIP_M = (0.5e-3, 0.15)
"""Predicted depth is clipped to this after scaling."""
ACCURATE = 1.25


@dataclass(frozen=True)
class DepthScore:
    """Means over the frames of all recordings."""

    abs_rel_image: float
    acc_image: float
    abs_rel_sequence: float
    acc_sequence: float
    scale_sd: float
    """Relative spread of the images' scales within a recording."""


def depth_score(predictions: Sequence[Maps], measured: Sequence[Measured]) -> DepthScore | None:
    """Predicted maps (N, H, W) of every recording against its truth; None when no recording has depth truth."""
    images, sequences, spread = [], [], []
    for maps, recording in zip(predictions, measured, strict=True):
        if recording.depth_true_m is None:
            continue
        masks = (recording.depth_true_m > 0) & recording.usable & (maps > 0)
        kept = [k for k in range(len(maps)) if masks[k].any()]
        scales = np.array([np.median(recording.depth_true_m[k][masks[k]]) / np.median(maps[k][masks[k]]) for k in kept])
        one = float(np.median(scales))
        spread.append(np.std(scales / one))
        for k, scale in zip(kept, scales, strict=True):
            true, found = recording.depth_true_m[k][masks[k]], maps[k][masks[k]]
            images.append(_depth_errors(found * scale, true))
            sequences.append(_depth_errors(found * one, true))
    if not images:
        return None
    (rel_i, acc_i), (rel_s, acc_s) = np.mean(images, axis=0), np.mean(sequences, axis=0)
    return DepthScore(float(rel_i), float(acc_i), float(rel_s), float(acc_s), float(np.mean(spread)))


def _depth_errors(found: Maps, true: Maps) -> tuple[float, float]:
    found = np.clip(found, *CLIP_M)
    ratio = np.maximum(found / true, true / found)
    return float(np.mean(np.abs(found - true) / true)), float(np.mean(ratio < ACCURATE))


def mean_inverse_depth(measured: Sequence[Measured]) -> Maps:
    """(H, W) one over the mean inverse of the true depth: what one knows of a gut before opening one's eyes."""
    total = sum(np.where(m.depth_true_m > 0, 1 / np.maximum(m.depth_true_m, 1e-6), 0).sum(axis=0)
                for m in measured if m.depth_true_m is not None)
    count = sum((m.depth_true_m > 0).sum(axis=0) for m in measured if m.depth_true_m is not None)
    mean = np.asarray(total) / np.maximum(count, 1)
    return np.asarray(1 / np.maximum(mean, 1.0), np.float32)


def trivial_depths(measured: Sequence[Measured], prior: Sequence[Maps]) -> dict[str, list[Maps]]:
    """Depth without a network, per name and recording.

    Args:
        measured: the recordings to guess for.
        prior: (H, W) for each, from `mean_inverse_depth` of training recordings with the same camera.
    """
    light = [depth_from_light(torch.from_numpy(m.images).permute(0, 3, 1, 2).float() / 255)[:, 0].numpy()
             for m in measured]
    both = [np.asarray(np.sqrt(one / np.median(one) * mean / np.median(mean)), np.float32)
            for one, mean in zip(light, prior, strict=True)]
    return {"constant": [np.full_like(m.depth, 0.015) for m in measured],
            "mean inverse depth": [np.broadcast_to(mean, m.depth.shape)
                                   for m, mean in zip(measured, prior, strict=True)],
            "brightness^-1/2": light, "geometric mean of the last two": both}


@dataclass(frozen=True)
class MotionScore:
    """Over the pairs of all recordings."""

    rotation_deg: float
    """Mean angle."""
    direction_deg: float
    """Median angle between translations, where the camera moves; nan where none moved, 90 for a guess of rest."""
    direction_mean_deg: float
    step_mm: float
    """Mean error of the translation after one scale per recording."""
    length_correlation: float
    """Mean over recordings of the correlation of step lengths."""


def motion_score(motions: Sequence[Array], measured: Sequence[Measured]) -> MotionScore:
    """Motions (N, 4, 4) in any unit, per recording, against truth."""
    rotation, direction, step, correlation = [], [], [], []
    for T, recording in zip(motions, measured, strict=True):
        true = recording.T_true_m
        rotation.append(angle_deg(T, true))
        t, t_true = T[:, :3, 3], true[:, :3, 3]
        scale = (t * t_true).sum() / max((t * t).sum(), 1e-12)
        step.append(1e3 * np.linalg.norm(t * max(scale, 0.0) - t_true, axis=1))
        size, size_true = np.linalg.norm(t, axis=1), np.linalg.norm(t_true, axis=1)
        cosine = (t * t_true).sum(axis=1) / np.maximum(size * size_true, 1e-12)
        direction.append(np.degrees(np.arccos(np.clip(cosine, -1, 1)))[recording.moving])
        if size.std() > 1e-12 and size_true.std() > 1e-12:
            correlation.append(np.corrcoef(size, size_true)[0, 1])
    angles = np.concatenate(direction)
    empty = len(angles) == 0
    return MotionScore(float(np.mean(np.concatenate(rotation))), float("nan") if empty else float(np.median(angles)),
                       float("nan") if empty else float(np.mean(angles)), float(np.mean(np.concatenate(step))),
                       float(np.mean(correlation)) if correlation else float("nan"))


def angle_deg(T: Array, T_true: Array) -> Array:
    """(N,) angle of the rotation error [deg] of rotations or transforms."""
    return np.asarray(np.degrees(np.linalg.norm(
        se3.so3_log(np.swapaxes(T[:, :3, :3], 1, 2) @ T_true[:, :3, :3]), axis=1)))


def trivial_motions(measured: Sequence[Measured]) -> dict[str, list[Array]]:
    """Motions without a network: rest, straight ahead, and for an upper bar the true motion of the step before."""
    def each(make: Callable[[Measured], Array]) -> list[Array]:
        return [make(m) for m in measured]

    def ahead(m: Measured) -> Array:
        T = np.broadcast_to(np.eye(4), (len(m), 4, 4)).copy()
        T[:, 2, 3] = 1.0
        return T
    return {"identity": each(lambda m: np.broadcast_to(np.eye(4), (len(m), 4, 4))), "straight ahead": each(ahead),
            "constant velocity (the true step before)": each(
                lambda m: np.concatenate([np.eye(4)[None], m.T_true_m[:-1]]))}


def nees_of(measured: Sequence[Measured], model: UncertaintyModel, names: Sequence[str], log_scale: float | None = None
            ) -> Array:
    """(N,) NEES per degree of freedom of all pairs.

    Args:
        measured: recordings with truth.
        model: of the covariances.
        names: of the signals' columns.
        log_scale: ln(metres per unit) for all; None = each recording's own, for the prior answers for the rest.
    """
    rows = []
    for m in measured:
        scale = m.log_scale if log_scale is None else log_scale
        if np.isfinite(scale):
            rows.append(motion_nees(m.errors(scale), model.covariance(m.signals, names)))
    return np.concatenate(rows) if rows else np.zeros(0)
