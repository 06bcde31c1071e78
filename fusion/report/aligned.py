"""What the pictures compare: both estimates in the frame of truth, under one alignment, with their errors."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fusion.result import Refinement
from vio import se3
from vio.alignment import Mode, align, associate
from vio.consistency import fix_gauge
from vio.errors import DegenerateAlignmentError
from vio.motions import RelativeMotions
from vio.trajectory import Trajectory

Array = NDArray[np.float64]

PREFERRED: tuple[Mode, ...] = ("se3", "yaw4", "origin")
CHI2_3_SIGMA = 14.156  # of 3 degrees of freedom, at the 99.73 % that 3 sigma mean for one


@dataclass(frozen=True)
class TruthErrors:
    """Errors of K frames that truth covers, under one alignment for both estimates."""

    mode: Mode
    t_s: Array
    """(K,)"""
    truth_m: Array
    """(K, 3) positions of truth."""
    refined_m: Array
    """(K,) distance of the refined positions from truth."""
    motions_m: Array
    """(K,) distance of the motions alone."""
    refined_rad: Array
    """(K,) angle of the refined rotations from true ones, under the same alignment."""
    motions_rad: Array
    """(K,) angle of the motions alone."""
    first_pose_m: Array
    """(K,) the refined error when the FIRST poses agree in position and yaw, which is what the covariance speaks of."""
    within_3_sigma: float | None
    """Share of frames inside their claimed 3-sigma ellipsoid; None without covariances."""


@dataclass(frozen=True)
class Scene:
    """Everything the pictures show, in one frame."""

    t_s: Array
    """(M,)"""
    refined_m: Array
    """(M, 3) positions in the world of truth where there is any, else in the estimator's."""
    motions_m: Array
    """(M, 3)"""
    claimed_sd_m: Array | None
    """(M,) claimed standard deviation of position along its worst axis, relative to the first pose."""
    claimed_cov_m2: Array | None
    """(M, 3, 3) claimed covariance of position relative to the first pose, in the axes of `refined_m`."""
    errors: TruthErrors | None
    rejected_frames: NDArray[np.int64] | None
    """Frames that rejected motions start from; None when the refinement alone cannot tell."""
    T_scene_world: Array
    """(4, 4) from the estimator's world to the frame of the pictures."""


def make_scene(refinement: Refinement, motions: RelativeMotions | None = None) -> Scene:
    """Lay both estimates over truth, under the first alignment that truth and both estimates determine.

    Args:
        refinement: what to show.
        motions: the motions it was made from; they tell the times of the rejected ones.
    """
    refined, only, truth = refinement.trajectory, refinement.motions_only, refinement.truth
    errors = None
    if truth is not None:
        mode, refined, only = _align_both(refined, only, truth)
        errors = _errors(mode, refinement.trajectory, refined, only, truth)
    T_scene_world = refined.T_world_body[0] @ se3.inverse(refinement.trajectory.T_world_body[0])
    return Scene(refined.t_s, refined.positions_m, only.positions_m, _claimed_sd(refinement.trajectory),
                 _claimed_cov(refinement.trajectory, refined.rotations), errors,
                 _rejected_frames(refinement, motions), T_scene_world)


def _align_both(refined: Trajectory, only: Trajectory, truth: Trajectory) -> tuple[Mode, Trajectory, Trajectory]:
    for mode in PREFERRED[:-1]:
        try:
            maps = [align(*associate(track, truth), mode) for track in (refined, only)]
        except DegenerateAlignmentError:
            continue
        return mode, maps[0].apply(refined), maps[1].apply(only)
    maps = [align(*associate(track, truth), "origin") for track in (refined, only)]
    return "origin", maps[0].apply(refined), maps[1].apply(only)


def _errors(mode: Mode, claimed: Trajectory, refined: Trajectory, only: Trajectory, truth: Trajectory) -> TruthErrors:
    refined_k, truth_k = associate(refined, truth)
    only_k, _ = associate(only, truth)
    claimed_k, _ = associate(claimed, truth)
    off = fix_gauge(claimed_k, truth_k).positions_m - claimed_k.positions_m
    return TruthErrors(
        mode, refined_k.t_s, truth_k.positions_m,
        np.linalg.norm(refined_k.positions_m - truth_k.positions_m, axis=1),
        np.linalg.norm(only_k.positions_m - truth_k.positions_m, axis=1),
        _angles_rad(refined_k, truth_k), _angles_rad(only_k, truth_k),
        np.linalg.norm(off, axis=1), _within_3_sigma(off, claimed_k),
    )


def _angles_rad(estimate: Trajectory, truth: Trajectory) -> Array:
    relative = np.swapaxes(truth.rotations, 1, 2) @ estimate.rotations
    return np.asarray(np.linalg.norm(se3.so3_log(relative), axis=1))


def _within_3_sigma(off_m: Array, claimed: Trajectory) -> float | None:
    if claimed.cov is None or len(off_m) < 2:
        return None
    body = (np.swapaxes(claimed.rotations, 1, 2) @ off_m[..., None])[1:]  # the first pose is the gauge
    cov = claimed.cov[1:, 3:, 3:]
    distance = (np.swapaxes(body, 1, 2) @ np.linalg.pinv(cov, hermitian=True) @ body)[:, 0, 0]
    return float(np.mean(distance <= CHI2_3_SIGMA))


def _claimed_sd(trajectory: Trajectory) -> Array | None:
    if trajectory.cov is None:
        return None
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(trajectory.cov[:, 3:, 3:])[:, -1], 0)))


def _claimed_cov(trajectory: Trajectory, R_scene_body: Array) -> Array | None:
    if trajectory.cov is None:
        return None
    return np.asarray(R_scene_body @ trajectory.cov[:, 3:, 3:] @ np.swapaxes(R_scene_body, 1, 2))


def _rejected_frames(refinement: Refinement, motions: RelativeMotions | None) -> NDArray[np.int64] | None:
    t, rejected = refinement.trajectory.t_s, refinement.rejected
    if motions is not None:
        index = np.clip(np.searchsorted(t, motions.t_i_s[rejected] - 1e-3), 0, len(t) - 1)
        return np.asarray(index, np.int64)
    if len(rejected) == 0:
        return rejected
    neighbours_only = refinement.motions_used + len(rejected) == len(t) - 1 and refinement.bridged == 0
    return rejected if neighbours_only else None


def thin(values: Array, limit: int) -> NDArray[np.int64]:
    """At most about `limit` indices of a series (N,), for the eye: first, last, and every bucket's extremes."""
    n = len(values)
    if n <= limit:
        return np.arange(n)
    edges = np.linspace(0, n, limit // 2 + 1).astype(int).tolist()
    keep = {0, n - 1}
    for start, end in pairwise(edges):
        keep.update((start + int(np.argmin(values[start:end])), start + int(np.argmax(values[start:end]))))
    return np.array(sorted(keep))
