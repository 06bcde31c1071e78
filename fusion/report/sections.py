"""Parts of the page that are HTML and no figures: tiles with the headline's numbers, and the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from fusion.report import words
from fusion.report.aligned import Scene
from fusion.result import Refinement
from vio.alignment import MODES

SOURCES = (("refined", "Refined"), ("motions", "Motions alone"))
PAPER_METRICS = {
    "ate_paper": "mean step error [mm]", "abs_diff_t": "AbsDiff translation [mm]", "abs_rel_t": "AbsRel translation",
    "are_paper": "mean step rotation error [°]", "abs_diff_r": "AbsDiff rotation [°]", "abs_rel_r": "AbsRel rotation",
}
PAPER_FACTORS = {"ate_paper": 1e3, "abs_diff_t": 1e3, "are_paper": 57.29577951308232, "abs_diff_r": 57.29577951308232}


def tiles(refinement: Refinement, summary: Mapping[str, Any], scene: Scene) -> str:
    """The numbers a reader looks for first."""
    accuracy = summary.get("accuracy") or {}
    mode = words.headline_mode(accuracy) or ""
    shown = []
    for source, label in SOURCES:
        if (figures_of := words.row(accuracy, source, mode)) is not None:
            shown.append((label, words.length(figures_of["ate_rmse_m"]), f"RMS {words.SHORT_MODES[mode]}"))
    error = (accuracy.get("refined") or {}).get("scale_error")
    if isinstance(error, (int, float)):
        shown.append(("Scale error", words.percent(error), "refined path against truth"))
    shown.append(("Scale", refinement.scale.policy, f"{words.spread(refinement.scale.log_sd)} claimed"))
    if scene.claimed_sd_m is not None:
        shown.append(("Claimed 3 sigma", words.length(3 * scene.claimed_sd_m[-1]), "position of the last frame"))
    rejected, total = len(refinement.rejected), len(refinement.rejected) + refinement.motions_used
    shown.append(("Motions rejected", f"{rejected:,}", f"of {total:,}"))
    return "".join(f'<div class="tile"><span>{escape(label)}</span><b>{escape(value)}</b>'
                   f"<small>{escape(note)}</small></div>" for label, value, note in shown)


def table(head: Sequence[str], rows: Sequence[str]) -> str:
    """A table that scrolls sideways in a narrow window, by keys too; cells of `rows` are HTML already."""
    names = "".join(f"<th>{escape(name)}</th>" for name in head)
    return (f'<div class="wide" tabindex="0"><table><thead><tr>{names}</tr></thead>'
            f"<tbody>{''.join(rows)}</tbody></table></div>")


def accuracy_table(accuracy: Mapping[str, Any]) -> str:
    """Accuracy of both estimates under every alignment; empty without truth."""
    if not accuracy:
        return ""
    rows = []
    for mode in MODES:
        refined, only = (words.row(accuracy, source, mode) for source, _ in SOURCES)
        if refined is None or only is None:
            reasons = [(accuracy.get(source) or {}).get(mode) for source, _ in SOURCES]
            reason = next((r["unavailable"] for r in reasons if isinstance(r, Mapping) and "unavailable" in r), "")
            rows.append(f'<tr><th>{escape(words.MODES[mode])}</th><td colspan="6" class="none">'
                        f'not determined: {escape(str(reason))}</td></tr>')
            continue
        before, after = only["ate_rmse_m"], refined["ate_rmse_m"]
        change = after / before - 1 if before > 0 else 0.0
        tone = "" if abs(change) < words.TIE else (' class="good"' if change < 0 else ' class="bad"')
        rows.append(
            f"<tr><th>{escape(words.MODES[mode])}</th><td>{words.length(after)}</td><td>{words.length(before)}</td>"
            f"<td{tone}>{words.percent(change)}</td><td>{words.angle(refined['rotation_rmse_rad'])}</td>"
            f"<td>{words.angle(only['rotation_rmse_rad'])}</td><td>{refined['matched']:,}</td></tr>")
    head = ("Alignment", "Refined", "Motions alone", "Change", "Rotation, refined", "Rotation, motions", "Frames")
    return ('<section><h2>Accuracy under every alignment</h2><p class="caption">Root mean square over all matched '
            f"frames. The same alignment is used on both sides of every row.</p>{table(head, rows)}</section>")


def paper_table(metrics: Mapping[str, Any]) -> str:
    """The metrics of the V²-SfMLearner paper; empty without truth."""
    if not metrics:
        return ""
    rows = []
    for key, label in PAPER_METRICS.items():
        values = [(metrics.get(source) or {}).get(key) for source, _ in SOURCES]
        shown = [words.number(None if v is None else v * PAPER_FACTORS.get(key, 1.0)) for v in values]
        cells = "".join(f"<td>{escape(text)}</td>" for text in shown)
        rows.append(f"<tr><th>{escape(label)}</th>{cells}</tr>")
    return ('<section><h2>Step by step, as in the V²-SfMLearner paper</h2><p class="caption">Errors of the motion '
            "between neighbouring frames, without any alignment.</p>"
            f"{table(('Metric', 'Refined', 'Motions alone'), rows)}</section>")


def colophon(summary: Mapping[str, Any]) -> str:
    """How long the stages took."""
    parts = [f"{stage.replace('_', ' ')} {seconds:.2g} s" for stage, seconds in (summary.get("timing_s") or {}).items()]
    if summary.get("peak_rss_bytes"):
        parts.append(f"{summary['peak_rss_bytes'] / 2**20:,.0f} MiB at most")
    return "Computed in: " + ", ".join(parts) + "." if parts else ""
