"""Runs and trajectories side by side: the same frames, the same alignment, and how sure the difference is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.compare_text import best_of, over_recordings, verdict
from fusion.paired import PairedDifference, RatioOverRecordings, paired_difference, ratio_over_recordings
from vio.alignment import MODES, Mode, align, associate
from vio.errors import DegenerateAlignmentError, TrajectoryError
from vio.metrics import accuracy_table
from vio.trajectory import Trajectory

Array = NDArray[np.float64]

VERDICT_ALIGNMENT: Mode = "se3"


@dataclass(frozen=True)
class Difference:
    """Two estimates of one recording against each other."""

    first: str
    second: str
    under: dict[str, PairedDifference]
    """By alignment; those that a track does not determine are absent."""

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {"first": self.first, "second": self.second,
                "under": {mode: difference.to_dict() for mode, difference in self.under.items()}}


@dataclass(frozen=True)
class Comparison:
    """Accuracy of several estimates of one recording on the frames they all share; or of several recordings."""

    frames: int
    """How many frames all estimates and the truth share, added over the recordings."""
    truth_frames: int
    rows: dict[str, dict[str, Any]]
    """Per estimate the `accuracy` block of `summary.json`."""
    verdicts: tuple[str, ...]
    """One sentence per pair, then who is best of all, then what holds over several recordings."""
    differences: tuple[Difference, ...] = ()
    """One per pair, and the best estimate against the next best where there are more than two."""
    over: RatioOverRecordings | None = None
    """Refined against motions alone over several recordings."""
    matched: dict[str, tuple[Trajectory, Trajectory]] = field(default_factory=dict, repr=False)
    """Per estimate its poses and those of truth at the shared frames, not aligned."""

    def to_dict(self) -> dict[str, Any]:
        """Plain values for `--json`."""
        return {"frames": self.frames, "truth_frames": self.truth_frames, "accuracy": self.rows,
                "verdicts": list(self.verdicts), "differences": [d.to_dict() for d in self.differences],
                "over_recordings": None if self.over is None else self.over.to_dict()}


def compare(estimates: dict[str, Trajectory], truth: Trajectory, pairs: list[tuple[str, str]],
            seed: int = 0) -> Comparison:
    """Compare estimates of one recording with truth on the frames that all of them share.

    Args:
        estimates: trajectories by name.
        truth: the reference.
        pairs: (motions-only, refined) names to pass a verdict on.
        seed: of the bootstrap.

    Raises:
        TrajectoryError: no frame is shared by all.
    """
    # Truth first: all matches then carry the truth's times, which identify the frames.
    matched = {name: associate(truth, estimate)[1] for name, estimate in estimates.items()}
    shared = truth.t_s[np.all([np.isin(truth.t_s, estimate.t_s) for estimate in matched.values()], axis=0)]
    if not matched or len(shared) == 0:
        raise TrajectoryError("compare: no frame is shared by all trajectories and the truth; check their clocks")
    reference = truth.select(np.isin(truth.t_s, shared))
    judged = {name: estimate.select(np.isin(estimate.t_s, shared)) for name, estimate in matched.items()}
    rows = {name: accuracy_table(estimate, reference) for name, estimate in judged.items()}
    errors = {name: _errors(estimate, reference) for name, estimate in judged.items()}
    differences = [_difference(errors, *pair, seed) for pair in pairs]
    sentences = [verdict(rows[d.first], rows[d.second], d.first, d.second, d.under.get(VERDICT_ALIGNMENT))
                 for d in differences]
    if (leaders := _leaders(rows, pairs)) is not None:
        best, following = leaders
        differences.append(_difference(errors, following, best, seed))
        sentences.append(best_of(len(rows), best, following, rows, differences[-1].under[VERDICT_ALIGNMENT]))
    return Comparison(len(shared), len(truth), rows, tuple(sentences), tuple(differences), None,
                      {name: (estimate, reference) for name, estimate in judged.items()})


def join(parts: Sequence[Comparison], pairs: Sequence[list[tuple[str, str]]], seed: int = 0) -> Comparison:
    """Several recordings in one table, with what their pairs say together.

    Args:
        parts: one comparison per recording; no name is in two of them.
        pairs: the (motions-only, refined) names of each.
        seed: of the bootstrap.
    """
    rows = {name: row for part in parts for name, row in part.rows.items()}
    ratios = [[_log_ratio(rows[only], rows[refined]) for only, refined in some] for some in pairs]
    known = [finite for some in ratios if (finite := [value for value in some if np.isfinite(value)])]
    over = ratio_over_recordings(known, seed) if len(known) >= 2 else None
    sentences = [sentence for part in parts for sentence in part.verdicts]
    if over is not None:
        sentences.append(over_recordings(over))
    return Comparison(sum(part.frames for part in parts), sum(part.truth_frames for part in parts), rows,
                      tuple(sentences), tuple(d for part in parts for d in part.differences), over,
                      {name: pair for part in parts for name, pair in part.matched.items()})


def _errors(estimate: Trajectory, reference: Trajectory) -> dict[str, Array]:
    """(N,) distances from truth under every alignment that is determined."""
    errors: dict[str, Array] = {}
    for mode in MODES:
        try:
            aligned = align(estimate, reference, mode).apply(estimate)
        except DegenerateAlignmentError:
            continue
        errors[mode] = np.linalg.norm(aligned.positions_m - reference.positions_m, axis=1)
    return errors


def _difference(errors: dict[str, dict[str, Array]], first: str, second: str, seed: int) -> Difference:
    under: dict[str, PairedDifference] = {
        mode: paired_difference(errors[first][mode], errors[second][mode], seed)
        for mode in MODES if mode in errors[first] and mode in errors[second]}
    return Difference(first, second, under)


def _leaders(rows: dict[str, dict[str, Any]], pairs: list[tuple[str, str]]) -> tuple[str, str] | None:
    """The best and the next best estimate, where the verdicts on pairs do not say so already."""
    ates = sorted((row[VERDICT_ALIGNMENT]["ate_rmse_m"], k, name) for k, (name, row) in enumerate(rows.items())
                  if "unavailable" not in row[VERDICT_ALIGNMENT])
    if len(ates) < 2 or (len(rows) == 2 and pairs):
        return None
    return ates[0][2], ates[1][2]


def _log_ratio(only: dict[str, Any], refined: dict[str, Any]) -> float:
    a, b = (row[VERDICT_ALIGNMENT].get("ate_rmse_m", np.nan) for row in (only, refined))
    return float(np.log(b / a)) if a > 0 and b > 0 else float("nan")
