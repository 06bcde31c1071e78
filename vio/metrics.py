"""How good a trajectory is: errors against truth under a declared alignment.

Absolute and relative pose errors are those of Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems"
(IROS 2012), and equal evo's. Whether covariances are honest is measured in `vio.consistency`. The twelve metrics
of the V²-SfMLearner paper are in `vio.paper_metrics`; its "ATE" is another quantity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.alignment import MODES, Mode, align, associate, check_pair, sim3_scale
from vio.consistency import coverage, fix_gauge, nees
from vio.errors import DegenerateAlignmentError, TrajectoryError
from vio.trajectory import Trajectory

Array = NDArray[np.float64]

__all__ = ["AteResult", "RpeResult", "accuracy_table", "ate", "coverage", "fix_gauge", "nees", "rpe", "rpe_lengths",
           "scale_drift", "scale_error"]


@dataclass(frozen=True)
class AteResult:
    """Absolute trajectory error after one alignment."""

    mode: Mode
    rmse_m: float
    """Root mean square distance of matched positions; the next three are of the same distances."""
    mean_m: float
    median_m: float
    max_m: float
    rotation_rmse_rad: float
    """Root mean square angle between matched rotations, after the same alignment."""
    matched: int
    """How many poses were compared."""
    scale: float
    """Factor that the alignment put on the estimate; 1 except under `sim3`."""


@dataclass(frozen=True)
class RpeResult:
    """Relative pose error: how far relative motions over one distance are from the true ones."""

    delta: float
    """Distance between the two poses of a pair."""
    unit: Literal["frames", "m"]
    pairs: int
    """How many pairs were compared."""
    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    rotation_rmse_rad: float
    rotation_mean_rad: float
    rotation_median_rad: float
    rotation_max_rad: float


def _statistics(errors: Array) -> tuple[float, float, float, float]:
    """Root mean square, mean, median and maximum."""
    return (float(np.sqrt(np.mean(errors**2))), float(errors.mean()), float(np.median(errors)), float(errors.max()))


def _angles_rad(R: Array) -> Array:
    angles: Array = np.linalg.norm(se3.so3_log(R), axis=-1)
    return angles


def ate(estimate: Trajectory, reference: Trajectory, mode: Mode = "se3") -> AteResult:
    """Absolute trajectory error of N poses after the alignment `mode`; equals evo's APE.

    Raises:
        DegenerateAlignmentError: the positions do not determine the alignment.
        TrajectoryError: unknown mode, different lengths or times.
    """
    alignment = align(estimate, reference, mode)
    aligned = alignment.apply(estimate)
    distances = np.linalg.norm(aligned.positions_m - reference.positions_m, axis=1)
    angles = _angles_rad(np.swapaxes(reference.rotations, 1, 2) @ aligned.rotations)
    return AteResult(mode, *_statistics(distances), _statistics(angles)[0], len(estimate), alignment.scale)


def rpe(estimate: Trajectory, reference: Trajectory, delta_frames: int = 1, all_pairs: bool = False) -> RpeResult:
    """Relative pose error over `delta_frames` poses; needs no alignment, but metric scale. Equals evo's RPE.

    Args:
        estimate: N poses.
        reference: N poses at the same times.
        delta_frames: poses from the first to the second of a pair.
        all_pairs: start a pair at every pose; otherwise each pair starts where the last one ended.

    Raises:
        TrajectoryError: different lengths or times, or fewer than `delta_frames` + 1 poses.
    """
    check_pair(estimate, reference, "rpe")
    if delta_frames < 1 or delta_frames != int(delta_frames):
        raise TrajectoryError(f"rpe: delta_frames is {delta_frames}, must be a whole number, 1 or more")
    if len(estimate) <= delta_frames:
        raise TrajectoryError(f"rpe: {len(estimate)} poses hold no pair {delta_frames} apart; use a smaller delta")
    i = np.arange(0, len(estimate) - delta_frames, 1 if all_pairs else delta_frames)
    return _rpe(estimate, reference, i, i + delta_frames, delta_frames, "frames")


def rpe_lengths(estimate: Trajectory, reference: Trajectory, lengths_m: ArrayLike,
                all_pairs: bool = False) -> list[RpeResult]:
    """Relative pose error over lengths of path: one result per length.

    Lengths are measured along the REFERENCE, so that two estimates are judged on the same pairs (evo's
    `pairs_from_reference`). With `all_pairs` every pose starts a pair, which counts when its length is within 10 %.

    Raises:
        TrajectoryError: different lengths or times, or a path too short for one of `lengths_m`.
    """
    check_pair(estimate, reference, "rpe")
    along = _path_m(reference)
    results = []
    for length in np.atleast_1d(np.asarray(lengths_m, float)):
        if not (np.isfinite(length) and length > 0):
            raise TrajectoryError(f"rpe: length {length} m must be positive")
        i, j = _all_pairs(along, length) if all_pairs else _consecutive_pairs(along, length)
        if len(i) == 0:
            raise TrajectoryError(
                f"rpe: no poses lie {length:g} m of path apart (path {along[-1]:g} m); use a shorter length"
            )
        results.append(_rpe(estimate, reference, i, j, float(length), "m"))
    return results


def _path_m(trajectory: Trajectory) -> Array:
    """(N,) path from the first pose."""
    steps = np.linalg.norm(np.diff(trajectory.positions_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _consecutive_pairs(along: Array, length: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    ends = [0]
    while True:
        here = along[ends[-1]]
        # At least one step of motion on, also where `length` is lost in the rounding of the path.
        k = max(int(np.searchsorted(along, here + length)), int(np.searchsorted(along, here, "right")))
        if k >= len(along):
            break
        ends.append(k)
    index = np.array(ends, np.intp)
    return index[:-1], index[1:]


def _all_pairs(along: Array, length: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    start = np.arange(len(along) - 1)
    target = along[:-1] + length
    after = np.clip(np.searchsorted(along, target), start + 1, len(along) - 1)
    # Where the capsule rests, many poses share one path length: the first of them ends the pair.
    before = np.maximum(np.searchsorted(along, along[np.maximum(after - 1, start + 1)]), start + 1)
    end = np.where(np.abs(along[before] - target) <= np.abs(along[after] - target), before, after)
    keep = np.abs(along[end] - target) <= 0.1 * length
    return start[keep], end[keep]


def _rpe(estimate: Trajectory, reference: Trajectory, i: NDArray[Any], j: NDArray[Any], delta: float,
         unit: Literal["frames", "m"]) -> RpeResult:
    moved = [se3.inverse(track.T_world_body[i]) @ track.T_world_body[j] for track in (reference, estimate)]
    error = se3.inverse(moved[0]) @ moved[1]
    distances = np.linalg.norm(error[:, :3, 3], axis=1)
    return RpeResult(delta, unit, len(i), *_statistics(distances), *_statistics(_angles_rad(error[:, :3, :3])))


def scale_error(estimate: Trajectory, reference: Trajectory) -> float:
    """Scale of the estimate over the true scale, minus 1: +0.05 means that the estimate is 5 % too long.

    The inverse of the `sim3` scale, which maps the estimate onto the reference; defined on straight tracks too.

    Raises:
        DegenerateAlignmentError: a track is motionless, or the two share no motion.
        TrajectoryError: different lengths or times.
    """
    return 1.0 / sim3_scale(estimate, reference) - 1.0


def scale_drift(estimate: Trajectory, reference: Trajectory, segments: int = 10) -> Array:
    """`scale_error` of consecutive pieces of equal reference path.

    Returns:
        (segments,) errors along the path; nan where a piece holds too little motion to tell.

    Raises:
        DegenerateAlignmentError: the reference does not move.
        TrajectoryError: different lengths or times, or `segments` below 1.
    """
    check_pair(estimate, reference, "scale drift")
    if segments < 1:
        raise TrajectoryError(f"scale drift: {segments} segments, must be 1 or more")
    along = _path_m(reference)
    if along[-1] <= 0:
        raise DegenerateAlignmentError("scale drift: the reference is motionless; there is no path to divide")
    edges = np.linspace(0, along[-1], segments + 1)
    drift = np.full(segments, np.nan)
    for k in range(segments):
        inside = (along >= edges[k]) & (along <= edges[k + 1])
        if inside.sum() < 2:
            continue
        try:
            drift[k] = scale_error(estimate.select(inside), reference.select(inside))
        except DegenerateAlignmentError:
            continue
    return drift


def accuracy_table(estimate: Trajectory, reference: Trajectory, max_dt_s: float = 0.01) -> dict[str, Any]:
    """The `accuracy` block of `summary.json` for one trajectory: every alignment, and the scale error.

    Poses are associated first (`vio.alignment.associate`). What the positions do not determine is
    `{"unavailable": reason}`, so no row is ever missing.

    Raises:
        TrajectoryError: no pose matches in time.
    """
    matched, truth = associate(estimate, reference, max_dt_s)
    table: dict[str, Any] = {}
    for mode in MODES:
        try:
            result = ate(matched, truth, mode)
        except DegenerateAlignmentError as error:
            table[mode] = {"unavailable": str(error)}
            continue
        table[mode] = {"ate_rmse_m": result.rmse_m, "rotation_rmse_rad": result.rotation_rmse_rad,
                       "matched": result.matched}
    try:
        table["scale_error"] = scale_error(matched, truth)
    except DegenerateAlignmentError as error:
        table["scale_error"] = {"unavailable": str(error)}
    return table
