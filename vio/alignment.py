"""Laying one trajectory over another: association in time, then the alignment that the metric declares.

Alignments are closed-form least squares over positions (Umeyama, "Least-squares estimation of transformation
parameters between two point patterns", PAMI 1991). Which one a figure used is part of the figure: 4 degrees of
freedom (`yaw4`) suit visual-inertial odometry, 6 (`se3`) metric vision, 7 (`sim3`) vision without scale
(Zhang and Scaramuzza, "A tutorial on quantitative trajectory evaluation", IROS 2018).

A straight or motionless track leaves rotations undetermined; that is a `DegenerateAlignmentError`, never a guess.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.errors import DegenerateAlignmentError, TrajectoryError
from vio.trajectory import Trajectory

Array = NDArray[np.float64]
Mode = Literal["none", "origin", "yaw4", "se3", "sim3"]

MODES: tuple[Mode, ...] = get_args(Mode)
"""From no freedom to seven degrees of it."""

TIME_TOLERANCE_S = 1e-3  # poses further apart in time than this are not the same moment
# Shares of motion below this are rounding: 1e-10 of a covariance is 1e-5 of an extent, 10 µm sideways per metre.
# A capsule with 0.1 mm of lateral play passes in 5 m of straight bowel; a line read from 6 decimals does not.
DEGENERATE_LIMIT = 1e-10
MIRRORED_SHARE = 1e-3  # sideways motion above it is plain to see, so a tie is one between two reflections
MOTIONLESS_LIMIT_M = 1e-9


@dataclass(frozen=True)
class Alignment:
    """The map from the estimate's world to the reference's: `p_reference = scale · R · p_estimate + t`."""

    mode: Mode
    T: Array
    """(4, 4) rigid part, R and t [m]."""
    scale: float
    """Factor on the estimate's positions; 1 except under `sim3`."""

    def apply(self, trajectory: Trajectory) -> Trajectory:
        """The trajectory as the reference's world sees it; covariances follow (their metres are scaled too)."""
        R = self.T[:3, :3]
        positions = self.scale * trajectory.positions_m @ R.T + self.T[:3, 3]
        cov = trajectory.cov
        if cov is not None:
            stretch = np.repeat([1.0, self.scale], 3)
            cov = cov * stretch[:, None] * stretch
        return Trajectory(trajectory.t_s, se3.transform(R @ trajectory.rotations, positions), cov)


@dataclass(frozen=True)
class _Moments:
    """What least squares needs to know of two position tracks."""

    means_m: tuple[Array, Array]
    """(3,), (3,) centroids of estimate and reference."""
    extents_m: tuple[float, float]
    """Root mean square distance from the centroid, of estimate and reference."""
    moving: tuple[bool, bool]
    """Whether each extent is more than rounding."""
    cross: Array
    """(3, 3) mean of reference ⊗ estimate over both extents; of unit size for tracks of equal shape."""
    U: Array
    values: Array
    """(3,) singular values of `cross`, the largest first."""
    Vt: Array
    handedness: float
    """+1, or -1 where the best orthogonal map would be a reflection."""


def check_pair(estimate: Trajectory, reference: Trajectory, what: str) -> None:
    """Make sure that pose k of both trajectories is the same moment.

    Raises:
        TrajectoryError: different lengths, or times that differ by more than 1 ms.
    """
    if len(estimate) != len(reference):
        raise TrajectoryError(
            f"{what}: {len(estimate)} estimated poses but {len(reference)} reference poses; match them with associate()"
        )
    off = np.abs(estimate.t_s - reference.t_s)
    if (off > TIME_TOLERANCE_S).any():
        k = int(np.argmax(off > TIME_TOLERANCE_S))
        raise TrajectoryError(
            f"{what}: pose {k} is at {estimate.t_s[k]:.6f} s in the estimate but at {reference.t_s[k]:.6f} s in the "
            f"reference (limit {TIME_TOLERANCE_S:g} s); match them with associate()"
        )


def align(estimate: Trajectory, reference: Trajectory, mode: Mode) -> Alignment:
    """The map that lays the estimate over the reference with the freedom that `mode` grants.

    Args:
        estimate: N poses.
        reference: N poses at the same times.
        mode: `none` identity; `origin` the first poses coincide; `yaw4` rotation about world z and translation;
            `se3` rotation and translation; `sim3` rotation, translation and scale. The last three are least
            squares over all positions.

    Raises:
        DegenerateAlignmentError: the positions do not determine it; the message names the modes that they do.
        TrajectoryError: unknown mode, different lengths or times.
    """
    if mode not in MODES:
        raise TrajectoryError(f"alignment {mode!r} is unknown; use one of {', '.join(MODES)}")
    check_pair(estimate, reference, f"{mode} alignment")
    if mode == "none":
        return Alignment(mode, np.eye(4), 1.0)
    if mode == "origin":
        return Alignment(mode, reference.T_world_body[0] @ se3.inverse(estimate.T_world_body[0]), 1.0)
    moments = _moments(estimate, reference)
    if mode not in _determined(moments):
        raise _degenerate(moments, mode)
    if mode == "yaw4":
        sine, cosine = _yaw_components(moments.cross)
        R = se3.so3_exp([0.0, 0.0, np.arctan2(sine, cosine)])
    else:
        R = moments.U @ np.diag([1.0, 1.0, moments.handedness]) @ moments.Vt
    scale = _scale(moments) if mode == "sim3" else 1.0
    t = moments.means_m[1] - scale * R @ moments.means_m[0]
    return Alignment(mode, se3.transform(R, t), scale)


def sim3_scale(estimate: Trajectory, reference: Trajectory) -> float:
    """The scale of the `sim3` alignment, which exists on straight tracks too although the rotation does not.

    Raises:
        DegenerateAlignmentError: a track is motionless, or the two share no motion.
        TrajectoryError: different lengths or times.
    """
    check_pair(estimate, reference, "scale")
    moments = _moments(estimate, reference)
    if moments.values[0] <= DEGENERATE_LIMIT:
        raise DegenerateAlignmentError(f"scale: {_why_no_motion(moments)}; no scale can be told")
    return _scale(moments)


def associate(a: Trajectory, b: Trajectory, max_dt_s: float = 0.01) -> tuple[Trajectory, Trajectory]:
    """The poses of both trajectories that belong together: nearest in time, one to one, closest pairs first.

    Poses are not interpolated. Both results carry the times of `a`.

    Raises:
        TrajectoryError: nothing matches within `max_dt_s`, or that limit is negative.
    """
    if not (np.isfinite(max_dt_s) and max_dt_s >= 0):
        raise TrajectoryError(f"association: max_dt_s is {max_dt_s}, must be a number of seconds, zero or more")
    after = np.searchsorted(b.t_s, a.t_s)
    left, right = np.maximum(after - 1, 0), np.minimum(after, len(b) - 1)
    index_a, index_b = np.tile(np.arange(len(a)), 2), np.concatenate([left, right])
    dt = np.abs(a.t_s[index_a] - b.t_s[index_b])
    order = np.lexsort((index_b, index_a, dt))
    partner = np.full(len(a), -1)
    taken = np.zeros(len(b), bool)
    for k in order[: np.searchsorted(dt[order], max_dt_s, "right")]:
        i, j = index_a[k], index_b[k]
        if partner[i] < 0 and not taken[j]:
            partner[i], taken[j] = j, True
    matched = np.flatnonzero(partner >= 0)
    if len(matched) == 0:
        raise TrajectoryError(
            f"association: matched 0 of {min(len(a), len(b))} poses within {max_dt_s:g} s "
            f"({a.t_s[0]:.3f} to {a.t_s[-1]:.3f} s against {b.t_s[0]:.3f} to {b.t_s[-1]:.3f} s); "
            "put both on one clock or raise max_dt_s"
        )
    partners = b.select(partner[matched])
    first = a.select(matched)
    return first, Trajectory(first.t_s, partners.T_world_body, partners.cov)


def _moments(estimate: Trajectory, reference: Trajectory) -> _Moments:
    means, extents, moving, centred = [], [], [], []
    for track in (estimate.positions_m, reference.positions_m):
        mean = track.mean(axis=0)
        x = track - mean
        extent = float(np.sqrt((x**2).sum(axis=1).mean()))
        means.append(mean)
        centred.append(x)
        extents.append(extent)
        moving.append(extent > MOTIONLESS_LIMIT_M + 1e-12 * float(np.abs(mean).max()))
    cross = np.zeros((3, 3))
    if all(moving):
        cross = (centred[1] / extents[1]).T @ (centred[0] / extents[0]) / len(centred[0])
    U, values, Vt = np.linalg.svd(cross)
    handedness = float(np.sign(np.linalg.det(U) * np.linalg.det(Vt)))
    return _Moments((means[0], means[1]), (extents[0], extents[1]), (moving[0], moving[1]),
                    cross, U, values, Vt, handedness)


def _scale(moments: _Moments) -> float:
    correlation = float(moments.values @ [1.0, 1.0, moments.handedness])
    return correlation * moments.extents_m[1] / moments.extents_m[0]


def _yaw_components(cross: Array) -> tuple[float, float]:
    """Sine and cosine of the best rotation about z, times how much horizontal motion the tracks share."""
    return float(cross[1, 0] - cross[0, 1]), float(cross[0, 0] + cross[1, 1])


def _determined(moments: _Moments) -> tuple[Mode, ...]:
    """The modes whose least-squares problem has one solution, most freedom first."""
    modes: list[Mode] = []
    # The best rotation is unique exactly when this is positive: rank 2, and no tie with a reflection.
    if moments.values[1] + moments.handedness * moments.values[2] > DEGENERATE_LIMIT:
        modes += ["sim3", "se3"]
    if np.hypot(*_yaw_components(moments.cross)) > DEGENERATE_LIMIT:
        modes.append("yaw4")
    return (*modes, "origin", "none")


def _why_no_motion(moments: _Moments) -> str:
    for name, moving, extent in zip(("estimate", "reference"), moments.moving, moments.extents_m, strict=True):
        if not moving:
            return (f"the {name} is motionless (its positions spread {extent:.2g} m about their mean, "
                    f"rank 0, limit {MOTIONLESS_LIMIT_M:g} m)")
    return f"the tracks share no motion (correlation {moments.values[0]:.2g}, rank 0, limit {DEGENERATE_LIMIT:g})"


def _degenerate(moments: _Moments, mode: Mode) -> DegenerateAlignmentError:
    *others, last = _determined(moments)
    remedy = f"use {', '.join(others)} or {last}"
    mirrored = bool(moments.values[1] > MIRRORED_SHARE)
    rank = min(int((moments.values > DEGENERATE_LIMIT).sum()), 3 if mirrored else 1)
    shares = ", ".join(f"{value:.2g}" for value in moments.values)
    detail = f"(singular values {shares} of the common extent, rank {rank}, limit {DEGENERATE_LIMIT:g})"
    if rank == 0:
        reason = f"{_why_no_motion(moments)}: {mode} does not determine any rotation"
    elif mode == "yaw4":
        reason = f"the tracks share no horizontal motion {detail}: {mode} does not determine the turn about z"
    elif not mirrored:
        reason = f"positions lie on a straight line {detail}: {mode} does not determine the roll about it"
    else:
        reason = f"the estimate is a mirror image {detail}: {mode} has no single best rotation, check its handedness"
    return DegenerateAlignmentError(f"{mode} alignment: {reason}; {remedy}")
