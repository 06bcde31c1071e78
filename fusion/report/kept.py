"""Which frames a picture of a long recording needs, chosen while all of them stream by; and the numbers that need all.

Curves keep the extremes of short spans of time, tracks keep points evenly along the way, so nothing that the eye could
see is lost. Whatever is said in figures (shares, means, lengths) comes from every frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.frame_blocks import FrameBlock, FrameSource
from fusion.report.moments import PairMoments
from fusion.result import Refinement
from vio import se3
from vio.alignment import Alignment, Mode, align
from vio.consistency import fix_gauge
from vio.errors import DegenerateAlignmentError, FormatError
from vio.trajectory import Trajectory

Array = NDArray[np.float64]
Index = NDArray[np.int64]

WHOLE = 12_000
"""Recordings up to so many frames are drawn from all of them."""
BLOCK = 4096
EVEN, ALONG, SPANS, REJECTED = 1000, 4000, 250, 1500
"""Of longer ones: frames evenly in time; evenly along the way; spans of time that keep their extremes; marks."""
PREFERRED: tuple[Mode, ...] = ("se3", "yaw4", "origin")
CHI2_3_SIGMA = 14.156  # of 3 degrees of freedom, at the 99.73 % that 3 sigma mean for one


@dataclass(frozen=True)
class Kept:
    """K of the M frames of a refinement, and what was found over all M."""

    refinement: Refinement
    """With the states of the K frames; `rejected` still counts the motions of all."""
    frame: Index
    """(K,) their numbers among the M, first and last included."""
    count: int
    """M"""
    way_m: Array
    """(K,) length of the refined track up to each, through all frames."""
    motions_way_m: Array
    """(K,) the same of the motions alone."""
    mode: Mode | None
    """The first alignment that truth and both estimates determine; None without truth."""
    maps: tuple[Alignment, Alignment] | None
    """That alignment of the refined track and of the motions alone, fitted to all frames."""
    within_3_sigma: float | None
    """Share of the frames that truth covers, but the first, inside their claimed 3-sigma ellipsoid."""
    mean_gyro_bias_rad_s: Array
    """(3,) over all frames."""
    mean_accel_bias_m_s2: Array
    """(3,) over all frames."""

    def rows_of(self, frames: Index) -> Index:
        """Where frames are among the K; those that were not kept are left out."""
        at = np.minimum(np.searchsorted(self.frame, frames), len(self.frame) - 1)
        return np.asarray(at[self.frame[at] == frames], np.int64)


def keep_frames(source: FrameSource, rejected_frames: Index | None) -> Kept:
    """Go through all frames twice: once for the numbers, once to choose and keep.

    Args:
        source: M frames.
        rejected_frames: frames that rejected motions start from.

    Raises:
        FormatError: truth that covers no frame, or frames that cannot be read.
    """
    whole = _survey(source)
    chosen = _Choice(source, whole, rejected_frames)
    parts = [chosen.keep(block) for block in source.blocks(chosen.edges)]
    frame, way, motions_way = (np.concatenate([getattr(part, name) for part in parts])
                               for name in ("frame", "way_m", "motions_way_m"))
    return Kept(_refinement_of(source, [part.block for part in parts], frame), frame, len(source), way, motions_way,
                whole.mode, whole.maps, whole.within, whole.bias_sum[0] / len(source),
                whole.bias_sum[1] / len(source))


class _Whole:
    """Sums over all frames."""

    def __init__(self) -> None:
        self.way = _Way()
        self.bias_sum = np.zeros((2, 3))
        self.moments = PairMoments(), PairMoments()
        self.firsts: tuple[Trajectory, Trajectory, Trajectory] | None = None
        self.first_frame: int | None = None
        self.inside = self.judged = 0
        self.mode: Mode | None = None
        self.maps: tuple[Alignment, Alignment] | None = None

    @property
    def within(self) -> float | None:
        """Share inside the claim."""
        return self.inside / self.judged if self.judged else None

    def add(self, block: FrameBlock) -> None:
        """Count one block."""
        self.way.add(block.refined.positions_m)
        self.bias_sum += [block.gyro_bias_rad_s.sum(axis=0), block.accel_bias_m_s2.sum(axis=0)]
        if block.truth is None:
            return
        refined, only = block.refined.select(block.covered), block.motions_only.select(block.covered)
        start = 0
        if self.firsts is None:
            self.firsts, start = (refined.select([0]), only.select([0]), block.truth.select([0])), 1
            self.first_frame = block.first + int(block.covered[0])
        for moments, track in zip(self.moments, (refined, only), strict=True):
            moments.add(track.positions_m, block.truth.positions_m)
        if refined.cov is not None and len(refined) > start:
            off = first_pose_off_m(self.firsts, refined, block.truth)
            self.inside += _inside(off[start:], refined.select(np.arange(start, len(refined))))
            self.judged += len(refined) - start

    def determine(self) -> None:
        """The first alignment that truth and both estimates determine."""
        if self.firsts is None:
            return
        for mode in PREFERRED[:-1]:
            try:
                found = [align(*moments.as_tracks(), mode) for moments in self.moments]
            except DegenerateAlignmentError:
                continue
            self.mode, self.maps = mode, (found[0], found[1])
            return
        refined, only, truth = self.firsts
        self.mode, self.maps = "origin", (align(refined, _timed(truth, refined), "origin"),
                                          align(only, _timed(truth, only), "origin"))


def _survey(source: FrameSource) -> _Whole:
    whole = _Whole()
    for block in source.blocks(_edges(len(source), -(-len(source) // BLOCK))):
        whole.add(block)
    if source.has_truth and whole.firsts is None:
        raise FormatError(f"{source.header.name}: truth covers none of the frames; refine the recording again")
    whole.determine()
    return whole


def first_pose_off_m(firsts: tuple[Trajectory, Trajectory, Trajectory], refined: Trajectory, truth: Trajectory
                     ) -> Array:
    """(k, 3) truth less estimate when their FIRST poses agree in position and yaw, in the estimate's world."""
    first, _, true = firsts
    T = fix_gauge(first, _timed(true, first)).T_world_body[0] @ se3.inverse(true.T_world_body[0])
    return np.asarray(truth.positions_m @ T[:3, :3].T + T[:3, 3] - refined.positions_m)


def _timed(track: Trajectory, like: Trajectory) -> Trajectory:
    return Trajectory(like.t_s, track.T_world_body)


def _inside(off_m: Array, claimed: Trajectory) -> int:
    assert claimed.cov is not None
    body = np.swapaxes(claimed.rotations, 1, 2) @ off_m[..., None]
    cov = claimed.cov[:, 3:, 3:]
    distance = (np.swapaxes(body, 1, 2) @ np.linalg.pinv(cov, hermitian=True) @ body)[:, 0, 0]
    return int((distance <= CHI2_3_SIGMA).sum())


class _Way:
    """Length of a polyline whose points come block by block."""

    def __init__(self) -> None:
        self.length_m, self._last = 0.0, np.zeros((0, 3))

    def add(self, points_m: Array) -> Array:
        """(m,) length up to each of the next points."""
        steps = np.linalg.norm(np.diff(np.concatenate([self._last, points_m]), axis=0), axis=1)
        steps = steps if len(self._last) else np.concatenate([[0.0], steps])
        way = self.length_m + np.cumsum(steps)
        self.length_m, self._last = float(way[-1]), points_m[-1:]
        return np.asarray(way)


@dataclass(frozen=True)
class _Part:
    block: FrameBlock
    frame: Index
    way_m: Array
    motions_way_m: Array


class _Choice:
    """What is kept of every block."""

    def __init__(self, source: FrameSource, whole: _Whole, rejected_frames: Index | None) -> None:
        m, joint = len(source), source.header.joint
        self._all, self._whole = m <= WHOLE, whole
        self._way, self._motions_way = _Way(), _Way()
        self._stride_m = max(whole.way.length_m, 1e-12) / ALONG
        self._passed = -1
        rejected = np.zeros(0, np.int64) if rejected_frames is None else rejected_frames[
            even_frames(len(rejected_frames), REJECTED)]
        first = [] if whole.first_frame is None else [whole.first_frame]
        wanted = [even_frames(m, EVEN + 1), rejected, np.array(first, np.int64)]
        self._wanted = np.unique(np.concatenate([*wanted, *([] if joint is None else [joint.node])]))
        self.edges = _edges(m, -(-m // BLOCK)) if self._all else _edges(m, SPANS)

    def keep(self, block: FrameBlock) -> _Part:
        """The chosen frames of a block."""
        way, motions_way = self._way.add(block.refined.positions_m), self._motions_way.add(
            block.motions_only.positions_m)
        rows = np.arange(len(block)) if self._all else self._rows(block, way)
        return _Part(_select(block, rows), block.first + rows, way[rows], motions_way[rows])

    def _rows(self, block: FrameBlock, way: Array) -> Index:
        low, high = np.searchsorted(self._wanted, [block.first, block.first + len(block)])
        passed = (way / self._stride_m).astype(np.int64)
        moved = np.flatnonzero(np.diff(passed, prepend=self._passed) > 0)
        self._passed = int(passed[-1])
        extremes = [index[k] for index, values in self._series(block) for k in (np.argmin(values), np.argmax(values))]
        return np.unique(np.concatenate([self._wanted[low:high] - block.first, moved, np.array(extremes, np.int64)]))

    def _series(self, block: FrameBlock) -> Iterable[tuple[Index, Array]]:
        """Everything that is drawn along time: (rows of the block, values)."""
        every = np.arange(len(block))
        yield every, block.log_scale
        for bias in (block.gyro_bias_rad_s, block.accel_bias_m_s2):
            yield from ((every, column) for column in bias.T)
        if block.refined.cov is not None:
            yield every, worst_sd_m(block.refined)
        if block.truth is None or self._whole.maps is None or self._whole.firsts is None:
            return
        at, truth = block.covered, block.truth
        refined, only = block.refined.select(at), block.motions_only.select(at)
        yield at, np.linalg.norm(first_pose_off_m(self._whole.firsts, refined, truth), axis=1)
        for track, alignment in zip((refined, only), self._whole.maps, strict=True):
            laid = alignment.apply(track)
            yield at, np.linalg.norm(laid.positions_m - truth.positions_m, axis=1)
            yield at, angles_rad(laid, truth)


def worst_sd_m(trajectory: Trajectory) -> Array:
    """(N,) claimed standard deviation of position along its worst axis."""
    assert trajectory.cov is not None
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(trajectory.cov[:, 3:, 3:])[:, -1], 0)))


def angles_rad(estimate: Trajectory, truth: Trajectory) -> Array:
    """(N,) angles between the attitudes of two tracks."""
    relative = np.swapaxes(truth.rotations, 1, 2) @ estimate.rotations
    return np.asarray(np.linalg.norm(se3.so3_log(relative), axis=1))


def even_frames(n: int, most: int) -> Index:
    """At most `most` indices out of n, evenly spread, with both ends."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64)) if n else np.zeros(0, np.int64)


def _edges(m: int, blocks: int) -> list[int]:
    return sorted(set(np.linspace(0, m, blocks + 1).round().astype(int).tolist()))


def _select(block: FrameBlock, rows: Index) -> FrameBlock:
    """Some of a block's frames."""
    covered = np.flatnonzero(np.isin(block.covered, rows))
    truth = None if block.truth is None or not len(covered) else block.truth.select(covered)
    return replace(block, refined=block.refined.select(rows), motions_only=block.motions_only.select(rows),
                   gyro_bias_rad_s=block.gyro_bias_rad_s[rows], accel_bias_m_s2=block.accel_bias_m_s2[rows],
                   log_scale=block.log_scale[rows], log_scale_sd=block.log_scale_sd[rows],
                   covered=np.searchsorted(rows, block.covered[covered]), truth=truth)


def _refinement_of(source: FrameSource, blocks: list[FrameBlock], frame: Index) -> Refinement:
    """The source's refinement with the states of the kept frames alone."""
    header = source.header
    joint = None if header.joint is None else replace(header.joint, node=np.searchsorted(frame, header.joint.node))
    truth = [block.truth for block in blocks if block.truth is not None]
    return replace(header, trajectory=_joined([block.refined for block in blocks]), joint=joint,
                   motions_only=_joined([block.motions_only for block in blocks]),
                   truth=_joined(truth) if truth else None, velocity_m_s=np.zeros((len(frame), 3)),
                   gyro_bias_rad_s=np.concatenate([block.gyro_bias_rad_s for block in blocks]),
                   accel_bias_m_s2=np.concatenate([block.accel_bias_m_s2 for block in blocks]),
                   log_scale=np.concatenate([block.log_scale for block in blocks]),
                   log_scale_sd=np.concatenate([b.log_scale_sd for b in blocks]))


def _joined(parts: list[Trajectory]) -> Trajectory:
    cov = [part.cov for part in parts if part.cov is not None]
    return Trajectory(np.concatenate([part.t_s for part in parts]), np.concatenate([p.T_world_body for p in parts]),
                      np.concatenate(cov) if len(cov) == len(parts) else None)
