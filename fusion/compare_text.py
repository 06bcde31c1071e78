"""Comparisons in words and as a table for a terminal: who won, by how much, and whether that could be chance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fusion.paired import FEWEST_RECORDINGS, PairedDifference, RatioOverRecordings
from vio.alignment import MODES

TITLES = {"none": "none", "origin": "origin", "yaw4": "yaw4", "se3": "SE3", "sim3": "Sim3"}
TIE = 1e-3
"""Errors that differ by less than this share are equal: a run that fell back to its motions neither wins nor loses."""


def verdict(only: dict[str, Any], refined: dict[str, Any], only_name: str = "motions only",
            refined_name: str = "refined", difference: PairedDifference | None = None) -> str:
    """One sentence: which of the two is more accurate, and by how much, under the same SE3 alignment.

    Args:
        only: `accuracy` block of the one.
        refined: `accuracy` block of the other, whom the sentence is about.
        only_name: its name.
        refined_name: its name.
        difference: how sure the difference is; without it, the sentence speaks of the numbers alone.
    """
    a, b = only["se3"], refined["se3"]
    if "unavailable" in a or "unavailable" in b:
        return f"{refined_name} against {only_name}: no verdict, {a.get('unavailable') or b.get('unavailable')}"
    left, right = b["ate_rmse_m"], a["ate_rmse_m"]
    numbers = f"ATE {1e3 * left:.2f} mm against {1e3 * right:.2f} mm, SE3-aligned"
    if abs(left - right) <= TIE * max(left, right):
        return f"{refined_name} ties with {only_name}: {numbers}"
    sure = "" if difference is None else f"; difference {interval_text(difference)}"
    if difference is not None and not difference.significant:
        return f"{refined_name} does not differ significantly from {only_name}: {numbers}{sure}"
    if left < right:
        return f"{refined_name} beats {only_name}: {numbers} ({left / right:.2f} of the error is left){sure}"
    return f"{refined_name} LOSES to {only_name}: {numbers} ({left / max(right, 1e-300):.2f} times the error){sure}"


def best_of(count: int, best: str, following: str, rows: Mapping[str, Any], difference: PairedDifference) -> str:
    """One sentence: who is best of all, and whether that is more than chance."""
    left, right = (1e3 * rows[name]["se3"]["ate_rmse_m"] for name in (best, following))
    numbers = f"{left:.2f} mm against {right:.2f} mm, SE3-aligned; difference {interval_text(difference)}"
    if abs(left - right) <= TIE * max(left, right):
        return f"of {count}: {best} and {following} tie for the first place, {numbers}"
    if not difference.significant:
        return f"of {count}: no clear winner, {best} does not differ significantly from {following}: ATE {numbers}"
    return f"of {count}: {best} wins, next is {following}: ATE {numbers}"


def over_recordings(over: RatioOverRecordings) -> str:
    """One sentence on what several recordings say together."""
    text = (f"over {over.recordings} recordings: refined leaves {over.ratio:.2f} of the motions' error in the "
            f"geometric mean, SE3-aligned, and is better in {over.better} of {over.recordings}")
    if over.low is None or over.high is None:
        return f"{text}; {FEWEST_RECORDINGS} recordings are needed for an interval"
    sure = "" if over.high < 1 or over.low > 1 else ", not significant"
    return f"{text} (95 % interval {over.low:.2f} to {over.high:.2f}{sure})"


def interval_text(difference: PairedDifference) -> str:
    """A difference in mm with its interval."""
    low, high = 1e3 * difference.low_m, 1e3 * difference.high_m
    return f"{1e3 * difference.difference_m:+.2f} mm, 95 % interval {low:+.2f} to {high:+.2f} mm"


def format_table(comparison: Any) -> str:
    """A `Comparison` for a terminal: ATE in mm per alignment, rotation in degrees, scale error, then the sentences."""
    header = ["", *(f"ATE {TITLES[m]}" for m in MODES), "rotation SE3", "scale error"]
    body = [[name, *(_ate_text(row[m]) for m in MODES), _rotation_text(row["se3"]), _scale_text(row["scale_error"])]
            for name, row in comparison.rows.items()]
    matched = (f"{comparison.frames} of {comparison.truth_frames} frames matched; ATE is the rmse of position, "
               "intervals are over blocks of frames")
    return "\n".join([*columns([header, *body]), matched, *comparison.verdicts])


def columns(lines: Sequence[Sequence[str]]) -> list[str]:
    """Cells as aligned lines, the first column to the left and the others to the right."""
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    return ["  ".join(cell.ljust(w) if k == 0 else cell.rjust(w) for k, (cell, w) in
                      enumerate(zip(line, widths, strict=True))).rstrip() for line in lines]


def _ate_text(cell: dict[str, Any]) -> str:
    return "unavailable" if "unavailable" in cell else f"{1e3 * cell['ate_rmse_m']:.2f} mm"


def _rotation_text(cell: dict[str, Any]) -> str:
    return "unavailable" if "unavailable" in cell else f"{np.rad2deg(cell['rotation_rmse_rad']):.2f} deg"


def _scale_text(value: Any) -> str:
    return "unavailable" if isinstance(value, dict) else f"{100 * value:+.1f} %"
