"""Runs and trajectories side by side: the same frames, the same alignment, and a plain verdict."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusion.run_folder import Run, read_run
from vio.alignment import MODES, associate
from vio.errors import TrajectoryError
from vio.formats.tum import read_tum
from vio.metrics import accuracy_table
from vio.trajectory import Trajectory

TITLES = {"none": "none", "origin": "origin", "yaw4": "yaw4", "se3": "SE3", "sim3": "Sim3"}
VERDICT_ALIGNMENT = "se3"
TIE = 1e-3
"""Errors that differ by less than this share are equal: a run that fell back to its motions neither wins nor loses."""
MOTIONS_ONLY, REFINED = ": motions only", ": refined"


@dataclass(frozen=True)
class Comparison:
    """Accuracy of several estimates on the frames they all share."""

    frames: int
    """How many frames all estimates and the truth share."""
    truth_frames: int
    rows: dict[str, dict[str, Any]]
    """Per estimate the `accuracy` block of `summary.json`."""
    verdicts: tuple[str, ...]
    """One sentence per run that holds both a learned-only and a refined trajectory."""

    def to_dict(self) -> dict[str, Any]:
        """Plain values for `--json`."""
        return {"frames": self.frames, "truth_frames": self.truth_frames, "accuracy": self.rows,
                "verdicts": list(self.verdicts)}


def compare(estimates: dict[str, Trajectory], truth: Trajectory, pairs: list[tuple[str, str]]) -> Comparison:
    """Compare estimates with truth on the frames that all of them share.

    Args:
        estimates: trajectories by name.
        truth: the reference.
        pairs: (motions-only, refined) names to pass a verdict on.

    Raises:
        TrajectoryError: no frame is shared by all.
    """
    # Truth first: all matches then carry the truth's times, which identify the frames.
    matched = {name: associate(truth, estimate)[1] for name, estimate in estimates.items()}
    shared = truth.t_s[np.all([np.isin(truth.t_s, estimate.t_s) for estimate in matched.values()], axis=0)]
    if not matched or len(shared) == 0:
        raise TrajectoryError("compare: no frame is shared by all trajectories and the truth; check their clocks")
    reference = truth.select(np.isin(truth.t_s, shared))
    rows = {}
    for name, estimate in matched.items():
        rows[name] = accuracy_table(estimate.select(np.isin(estimate.t_s, shared)), reference)
    verdicts = tuple(verdict(rows[only], rows[refined], only, refined) for only, refined in pairs)
    return Comparison(len(shared), len(truth), rows, verdicts)


def verdict(only: dict[str, Any], refined: dict[str, Any], only_name: str = "motions only",
            refined_name: str = "refined") -> str:
    """One sentence: which of the two is more accurate, and by how much, under the same SE3 alignment."""
    a, b = only[VERDICT_ALIGNMENT], refined[VERDICT_ALIGNMENT]
    if "unavailable" in a or "unavailable" in b:
        return f"{refined_name} against {only_name}: no verdict, {a.get('unavailable') or b.get('unavailable')}"
    left, right = b["ate_rmse_m"], a["ate_rmse_m"]
    numbers = f"ATE {1e3 * left:.2f} mm against {1e3 * right:.2f} mm, SE3-aligned"
    if abs(left - right) <= TIE * max(left, right):
        return f"{refined_name} ties with {only_name}: {numbers}"
    if left < right:
        return f"{refined_name} beats {only_name}: {numbers} ({left / right:.2f} of the error is left)"
    return f"{refined_name} LOSES to {only_name}: {numbers} ({left / max(right, 1e-300):.2f} times the error)"


def compare_paths(paths: list[Path], truth_path: Path | None) -> Comparison:
    """Compare run folders and TUM files.

    A run folder stands for two rows, its motions alone and its refined trajectory.

    Raises:
        TrajectoryError: no truth was given and no run folder holds one.
        FormatError: a file is not what it should be.
    """
    estimates: dict[str, Trajectory] = {}
    pairs: list[tuple[str, str]] = []
    truth = None if truth_path is None else read_tum(truth_path)
    for path in paths:
        if not path.is_dir():
            estimates[_free_name(path.stem, estimates)] = read_tum(path)
            continue
        run = read_run(path)
        truth = _truth_of(path) if truth is None else truth
        names = _run_names(run, estimates)
        estimates |= dict(zip(names, (run.motions_only, run.refined), strict=True))
        pairs.append(names)
    if truth is None:
        raise TrajectoryError("compare: no truth; give --truth traj.tum (runs of recordings with truth bring it)")
    return compare(estimates, truth, pairs)


def _truth_of(folder: Path) -> Trajectory | None:
    path = folder / "truth.tum"
    return read_tum(path) if path.is_file() else None


def _run_names(run: Run, taken: dict[str, Trajectory]) -> tuple[str, str]:
    base = _free_name(run.name, {name.removesuffix(REFINED): t for name, t in taken.items()})
    return base + MOTIONS_ONLY, base + REFINED


def _free_name(name: str, taken: dict[str, Trajectory]) -> str:
    candidate, n = name, 2
    while candidate in taken:
        candidate, n = f"{name} ({n})", n + 1
    return candidate


def format_table(comparison: Comparison) -> str:
    """The comparison as a table for a terminal: ATE in mm per alignment, rotation in degrees, scale error."""
    header = ["", *(f"ATE {TITLES[m]}" for m in MODES), "rotation SE3", "scale error"]
    body = [[name, *(_ate_text(row[m]) for m in MODES), _rotation_text(row["se3"]), _scale_text(row["scale_error"])]
            for name, row in comparison.rows.items()]
    widths = [max(len(line[k]) for line in [header, *body]) for k in range(len(header))]
    lines = ["  ".join(cell.ljust(w) if k == 0 else cell.rjust(w) for k, (cell, w) in
                       enumerate(zip(line, widths, strict=True))).rstrip() for line in [header, *body]]
    matched = f"{comparison.frames} of {comparison.truth_frames} frames matched; ATE is the rmse of position"
    return "\n".join([*lines, matched, *comparison.verdicts])


def _ate_text(cell: dict[str, Any]) -> str:
    return "unavailable" if "unavailable" in cell else f"{1e3 * cell['ate_rmse_m']:.2f} mm"


def _rotation_text(cell: dict[str, Any]) -> str:
    return "unavailable" if "unavailable" in cell else f"{np.rad2deg(cell['rotation_rmse_rad']):.2f} deg"


def _scale_text(value: Any) -> str:
    return "unavailable" if isinstance(value, dict) else f"{100 * value:+.1f} %"
