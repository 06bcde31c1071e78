"""What the pictures compare: both estimates in the frame of truth, under one alignment, with their errors."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fusion.frame_blocks import FramesInMemory, FrameSource
from fusion.report.kept import Kept, angles_rad, first_pose_off_m, keep_frames, worst_sd_m
from fusion.result import Refinement
from vio import se3
from vio.alignment import Mode
from vio.motions import RelativeMotions
from vio.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TruthErrors:
    """Errors of the C of K frames that truth covers, under one alignment for both estimates."""

    mode: Mode
    t_s: Array
    """(C,)"""
    truth_m: Array
    """(C, 3) positions of truth."""
    refined_m: Array
    """(C,) distance of the refined positions from truth."""
    motions_m: Array
    """(C,) distance of the motions alone."""
    refined_rad: Array
    """(C,) angle of the refined rotations from true ones, under the same alignment."""
    motions_rad: Array
    """(C,) angle of the motions alone."""
    first_pose_m: Array
    """(C,) the refined error when the FIRST poses agree in position and yaw, which is what the covariance speaks of."""
    within_3_sigma: float | None
    """Share of ALL frames inside their claimed 3-sigma ellipsoid; None without covariances."""


@dataclass(frozen=True)
class Scene:
    """Everything the pictures show, in one frame of reference, of K of the M frames."""

    kept: Kept
    """Which frames those are, their states, and the numbers that come from all."""
    t_s: Array
    """(K,)"""
    refined_m: Array
    """(K, 3) positions in the world of truth where there is any, else in the estimator's."""
    motions_m: Array
    """(K, 3)"""
    claimed_sd_m: Array | None
    """(K,) claimed standard deviation of position along its worst axis, relative to the first pose."""
    claimed_cov_m2: Array | None
    """(K, 3, 3) claimed covariance of position relative to the first pose, in the axes of `refined_m`."""
    errors: TruthErrors | None
    rejected_frames: NDArray[np.int64] | None
    """Rows, of K, that rejected motions start from; None when the refinement alone cannot tell."""
    T_scene_world: Array
    """(4, 4) from the estimator's world to the frame of the pictures."""


def make_scene(refinement: Refinement | FrameSource, motions: RelativeMotions | None = None) -> Scene:
    """Lay both estimates over truth, under the first alignment that truth and both estimates determine.

    Args:
        refinement: what to show; frames that are streamed are gone through twice.
        motions: the motions it was made from; they tell the times of the rejected ones.

    Raises:
        FormatError: frames that cannot be read.
    """
    source = FramesInMemory(refinement) if isinstance(refinement, Refinement) else refinement
    rejected = _rejected_frames(source, motions)
    kept = keep_frames(source, rejected)
    claimed = kept.refinement.trajectory
    refined, only = claimed, kept.refinement.motions_only
    if kept.maps is not None:
        refined, only = kept.maps[0].apply(refined), kept.maps[1].apply(only)
    T_scene_world = refined.T_world_body[0] @ se3.inverse(claimed.T_world_body[0])
    return Scene(
        kept, refined.t_s, refined.positions_m, only.positions_m,
        None if claimed.cov is None else worst_sd_m(claimed), _claimed_cov(claimed, refined.rotations),
        _errors(kept, refined, only), None if rejected is None else kept.rows_of(rejected), T_scene_world)


def _errors(kept: Kept, refined: Trajectory, only: Trajectory) -> TruthErrors | None:
    truth = kept.refinement.truth
    if truth is None or kept.mode is None:
        return None
    claimed = kept.refinement.trajectory
    at = np.searchsorted(claimed.t_s, truth.t_s)
    refined_k, only_k, claimed_k = refined.select(at), only.select(at), claimed.select(at)
    firsts = claimed_k.select([0]), only_k.select([0]), truth.select([0])
    return TruthErrors(
        kept.mode, truth.t_s, truth.positions_m,
        np.linalg.norm(refined_k.positions_m - truth.positions_m, axis=1),
        np.linalg.norm(only_k.positions_m - truth.positions_m, axis=1),
        angles_rad(refined_k, truth), angles_rad(only_k, truth),
        np.linalg.norm(first_pose_off_m(firsts, claimed_k, truth), axis=1), kept.within_3_sigma)


def _claimed_cov(trajectory: Trajectory, R_scene_body: Array) -> Array | None:
    if trajectory.cov is None:
        return None
    return np.asarray(R_scene_body @ trajectory.cov[:, 3:, 3:] @ np.swapaxes(R_scene_body, 1, 2))


def _rejected_frames(source: FrameSource, motions: RelativeMotions | None) -> NDArray[np.int64] | None:
    header = source.header
    rejected = header.rejected
    if motions is not None:  # then all frames are in memory
        t = header.trajectory.t_s
        index = np.clip(np.searchsorted(t, motions.t_i_s[rejected] - 1e-3), 0, len(t) - 1)
        return np.asarray(index, np.int64)
    if len(rejected) == 0:
        return rejected
    neighbours_only = header.motions_used + len(rejected) == len(source) - 1 and header.bridged == 0
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
