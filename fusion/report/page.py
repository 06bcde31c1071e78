"""`report.html`: one self-contained page. Everything it needs is inside, and it may fetch nothing."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from fusion.report import figures, words
from fusion.report.aligned import Scene, make_scene
from fusion.report.plot import trajectory_svg
from fusion.report.unrolled import lesion_table, space_marks, unrolled_figure
from fusion.result import Refinement
from vio.alignment import MODES
from vio.atomic import atomic_write
from vio.motions import RelativeMotions

SOURCES = (("refined", "Refined"), ("motions", "Motions alone"))
PAPER_METRICS = {
    "ate_paper": "mean step error [mm]", "abs_diff_t": "AbsDiff translation [mm]", "abs_rel_t": "AbsRel translation",
    "are_paper": "mean step rotation error [°]", "abs_diff_r": "AbsDiff rotation [°]", "abs_rel_r": "AbsRel rotation",
}
UNROLLED = ("Distance along the travelled centreline from the first frame; back-and-forth and dwell do not count. "
            "Bars are 95 % intervals, dotted lines are landmarks. A lesion stands off the course by as far as the "
            "camera saw ahead.")
PAPER_FACTORS = {"ate_paper": 1e3, "abs_diff_t": 1e3, "are_paper": 57.29577951308232, "abs_diff_r": 57.29577951308232}


def write_report(
    refinement: Refinement, summary: Mapping[str, Any], path: str | Path, motions: RelativeMotions | None = None,
    lesions: Sequence[Mapping[str, Any]] | None = None,
) -> None:
    """Write the page, atomically.

    Args:
        refinement: what was concluded.
        summary: as in `summary.json` (docs/conventions.md); figures of accuracy are taken from here.
        path: the file.
        motions: the motions it was made from; they place the rejected ones where pairs are not all neighbours.
        lesions: rows of `lesions.json` (`fusion.read_lesions`).

    Raises:
        OutputError: the file cannot be written.
    """
    from plotly.offline import get_plotlyjs  # heavy, and needed only once a page is written

    page = Template(_asset("page.html")).substitute(
        _content(refinement, summary, make_scene(refinement, motions), lesions or ()),
        style=_asset("page.css"), script=_asset("page.js"), plotly=get_plotlyjs(),
    )
    with atomic_write(path) as file:
        file.write(page.encode())


def _asset(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _content(refinement: Refinement, summary: Mapping[str, Any], scene: Scene,
             lesions: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    verdict = words.verdict(refinement, summary)
    within = None if scene.errors is None else scene.errors.within_3_sigma
    facts = words.sentences(refinement, summary, within)
    drawn = _figures(refinement, scene, lesions)
    return {
        "name": escape(refinement.name),
        "facts_line": escape(_facts_line(refinement, summary)),
        "tone": verdict.tone,
        "verdict": escape(verdict.text),
        "tiles": _tiles(refinement, summary, scene),
        "sentences": "".join(f"<dt>{escape(head)}</dt><dd>{escape(text)}</dd>" for head, text in facts),
        "lesions": lesion_table(lesions) if lesions else "",
        "still": trajectory_svg(refinement, scene),
        "sections": "".join(_section(key, title, caption) for key, title, caption, _ in drawn),
        "accuracy": _accuracy(summary.get("accuracy") or {}),
        "paper": _paper(summary.get("paper_metrics") or {}),
        "colophon": escape(_colophon(summary)),
        "figures": _script_json({key: figure for key, _, _, figure in drawn}),
    }


def _figures(refinement: Refinement, scene: Scene,
             lesions: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str, figures.Figure]]:
    """(key, title, caption, figure) in reading order."""
    gaps = [(gap.start_s, gap.end_s) for gap in refinement.imu.gaps]
    t = refinement.trajectory.t_s
    rejected = None if scene.rejected_frames is None else t[scene.rejected_frames]
    space = figures.trajectory_figure(scene)
    out = [("trajectory", "Trajectory", _trajectory_caption(refinement, scene), space)]
    if lesions:
        space["data"] += space_marks(lesions, scene.T_scene_world, figures.space_unit(scene)[1])
        out.append(("unrolled", "The gut unrolled", UNROLLED, unrolled_figure(refinement, lesions)))
    if scene.errors is not None:
        caption = f"Both estimates {words.SHORT_MODES[scene.errors.mode]}. {_marks(refinement, rejected is not None)}"
        out.append(("error", "Distance from truth", caption, figures.error_figure(scene.errors, rejected, gaps)))
    if (claim := figures.claim_figure(scene, gaps)) is not None:
        caption = "What the estimator claims for the worst direction of every position, relative to the first pose."
        if scene.errors is not None:
            caption += " The line is the true error when the first poses are laid together; it should stay inside."
        out.append(("claim", "Claimed uncertainty", caption, claim))
    out.append(("scale", "Scale", "Length of one motion unit, with two standard deviations.",
                figures.scale_figure(refinement, gaps)))
    for key, title, values, label in (
        ("gyro", "Gyro bias", refinement.gyro_bias_rad_s * 57.29577951308232, "bias [°/s]"),
        ("accel", "Accelerometer bias", refinement.accel_bias_m_s2, "bias [m/s²]"),
    ):
        out.append((key, title, "Body axes.", figures.bias_figure(t, values, label, gaps)))
    return out


def _trajectory_caption(refinement: Refinement, scene: Scene) -> str:
    where = "in the estimator's world: z up, position and yaw counted from the first pose"
    if scene.errors is not None:
        where = f"both estimates laid over truth {words.SHORT_MODES[scene.errors.mode]}"
    text = f"Position of the body, {where}. Drag to turn, scroll to zoom."
    if len(scene.t_s) > figures.LIMIT:
        text += f" {figures.LIMIT:,} of {len(scene.t_s):,} poses are drawn."
    return text


def _marks(refinement: Refinement, placed: bool) -> str:
    parts = []
    if len(refinement.rejected):
        parts.append("Red marks: motions rejected as outliers." if placed else
                     "Rejected motions are not marked: not all motions join neighbouring frames.")
    if refinement.imu.gaps:
        parts.append("Shaded: no inertial samples.")
    return " ".join(parts)


def _facts_line(refinement: Refinement, summary: Mapping[str, Any]) -> str:
    return (f"{len(refinement.trajectory):,} frames · {words.duration(float(summary['duration_s']))} · "
            f"path {words.length(float(summary['path_length_m']))} · {words.ESTIMATORS[refinement.estimator]}")


def _tiles(refinement: Refinement, summary: Mapping[str, Any], scene: Scene) -> str:
    accuracy = summary.get("accuracy") or {}
    mode = words.headline_mode(accuracy) or ""
    tiles = []
    for source, label in SOURCES:
        if (figures_of := words.row(accuracy, source, mode)) is not None:
            tiles.append((label, words.length(figures_of["ate_rmse_m"]), f"RMS {words.SHORT_MODES[mode]}"))
    error = (accuracy.get("refined") or {}).get("scale_error")
    if isinstance(error, (int, float)):
        tiles.append(("Scale error", words.percent(error), "refined path against truth"))
    tiles.append(("Scale", refinement.scale.policy, f"{words.spread(refinement.scale.log_sd)} claimed"))
    if scene.claimed_sd_m is not None:
        tiles.append(("Claimed 3 sigma", words.length(3 * scene.claimed_sd_m[-1]), "position of the last frame"))
    rejected, total = len(refinement.rejected), len(refinement.rejected) + refinement.motions_used
    tiles.append(("Motions rejected", f"{rejected:,}", f"of {total:,}"))
    return "".join(f'<div class="tile"><span>{escape(label)}</span><b>{escape(value)}</b>'
                   f"<small>{escape(note)}</small></div>" for label, value, note in tiles)


def _section(key: str, title: str, caption: str) -> str:
    return (f'<figure class="{key}"><h2>{escape(title)}</h2><figcaption>{escape(caption)}</figcaption>'
            f'<div class="plot" id="{key}" role="img" aria-label="{escape(title)}"></div></figure>')


def _accuracy(accuracy: Mapping[str, Any]) -> str:
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
    return ('<section><h2>Accuracy under every alignment</h2>'
            '<p class="caption">Root mean square over all matched frames. '
            "The same alignment is used on both sides of every row.</p><table><thead><tr><th>Alignment</th>"
            "<th>Refined</th><th>Motions alone</th><th>Change</th><th>Rotation, refined</th><th>Rotation, motions</th>"
            f"<th>Frames</th></tr></thead><tbody>{''.join(rows)}</tbody></table></section>")


def _paper(metrics: Mapping[str, Any]) -> str:
    if not metrics:
        return ""
    rows = []
    for key, label in PAPER_METRICS.items():
        values = [(metrics.get(source) or {}).get(key) for source, _ in SOURCES]
        shown = [words.number(None if v is None else v * PAPER_FACTORS.get(key, 1.0)) for v in values]
        cells = "".join(f"<td>{escape(text)}</td>" for text in shown)
        rows.append(f"<tr><th>{escape(label)}</th>{cells}</tr>")
    return ('<section><h2>Step by step, as in the V²-SfMLearner paper</h2>'
            '<p class="caption">Errors of the motion between '
            "neighbouring frames, without any alignment.</p><table><thead><tr><th>Metric</th><th>Refined</th>"
            f"<th>Motions alone</th></tr></thead><tbody>{''.join(rows)}</tbody></table></section>")


def _colophon(summary: Mapping[str, Any]) -> str:
    parts = [f"{stage.replace('_', ' ')} {seconds:.2g} s" for stage, seconds in (summary.get("timing_s") or {}).items()]
    if summary.get("peak_rss_bytes"):
        parts.append(f"{summary['peak_rss_bytes'] / 2**20:,.0f} MiB at most")
    return "Computed in: " + ", ".join(parts) + "." if parts else ""


def _script_json(value: object) -> str:
    """JSON that can stand inside a script element."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c").replace("&", "\\u0026")
