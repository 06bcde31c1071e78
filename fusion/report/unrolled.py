"""The gut unrolled: how far along it the capsule was at every time, with lesions and landmarks; and their table.

Labels come from people's files: they are escaped in the table and never enter a figure, where lesions have numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.lesions.course import Course
from fusion.lesions.measures import arc_interval, capsule_along
from fusion.report import figures
from fusion.report.figures import Figure
from fusion.report.sections import table
from fusion.report.words import NBSP
from fusion.result import Refinement

Array = NDArray[np.float64]
Row = Mapping[str, Any]

BAND_FRAMES = 400
CROWDED = 0.05
"""Marks nearer in time than this share of the figure have no room for a number between them."""
KINDS = (("finding", "lesions", "circle", "--lesion"), ("landmark", "landmarks", "diamond", "--landmark"))


def unrolled_figure(refinement: Refinement, rows: Sequence[Row]) -> Figure:
    """Arc length against time: the capsule's course with its 95 % band, lesions and landmarks with their intervals.

    Args:
        refinement: the frames that are drawn; of a long recording those that a picture needs (`kept.py`).
        rows: of `lesions.json`, measured on all frames.
    """
    course = Course(refinement)
    t, arc = course.t_s, course.centreline.frame_arc_m
    known = [row for row in rows if row["arc_length_mm"] is not None]
    unit, factor = figures.unit_of(arc, *([np.array([row["arc_length_mm"] for row in known]) * 1e-3] if known else []))
    data = _band(course, factor)
    data.append(figures.line(t, arc * factor, "capsule", "--refined", 2.2))
    numbers = {id(row): k for k, row in enumerate(rows, 1)}
    for kind, name, symbol, colour in KINDS:
        shown = [row for row in known if row["kind"] == kind]
        if shown:
            data.append(_marks(shown, [numbers[id(row)] for row in shown], name, symbol, colour, unit, factor,
                               float(t[-1] - t[0])))
    gaps = [(gap.start_s, gap.end_s) for gap in refinement.imu.gaps]
    layout = figures.time_layout(f"along the gut [{unit}]", t, gaps, height=420)
    layout["hovermode"] = "closest"
    landmark_lines = [{"type": "line", "xref": "paper", "x0": 0, "x1": 1, "yref": "y", "y0": y, "y1": y,
                       "line": {"color": "--landmark", "width": 1, "dash": "dot"}, "layer": "below"}
                      for y in (1e-3 * factor * row["arc_length_mm"] for row in known if row["kind"] == "landmark")]
    layout["shapes"] = [*layout["shapes"], *landmark_lines[:figures.LIMIT]]
    return {"data": data, "layout": layout}


def _band(course: Course, factor: float) -> list[Figure]:
    """The capsule's 95 % band, drawn at some of the frames; empty where it is unknown."""
    if course.joint is None:
        return []
    frames = np.unique(np.linspace(0, len(course.t_s) - 1, BAND_FRAMES).round().astype(np.int64))
    spread = [arc_interval(capsule_along(course, int(frame))) for frame in frames]
    _, low, high = (np.array(part, float) for part in zip(*spread, strict=True))
    t, low, high = course.t_s[frames], factor * low, factor * high
    return [{"x": figures.numbers(np.concatenate([t, t[::-1]])), "type": "scatter", "mode": "lines",
             "y": figures.numbers(np.concatenate([high, low[::-1]])), "fill": "toself",
             "fillcolor": "--refined-band", "name": "95 % of the capsule", "line": {"width": 0}, "hoverinfo": "skip"}]


def _marks(rows: Sequence[Row], number: Sequence[int], name: str, symbol: str, colour: str, unit: str,
           factor: float, span_s: float) -> Figure:
    value, low, high = (np.array([np.nan if row[key] is None else row[key] for row in rows], float) * 1e-3 * factor
                        for key in ("arc_length_mm", "arc_lo_mm", "arc_hi_mm"))
    hover = f"%{{customdata}}<br>%{{y:.4g}} {unit} at %{{x:.1f}} s<extra></extra>"
    side = _number_sides(np.array([row["timestamp_s"] for row in rows], float), span_s)
    return {"type": "scatter", "mode": "markers+text", "name": name, "customdata": [f"no. {n}" for n in number],
            "x": figures.numbers(np.array([row["timestamp_s"] for row in rows], float)), "y": figures.numbers(value),
            "text": [str(n) for n in number], "textposition": side, "textfont": {"color": "--ink"},
            "error_y": {"type": "data", "symmetric": False, "array": figures.numbers(high - value),
                        "arrayminus": figures.numbers(value - low), "color": colour, "thickness": 1.6, "width": 5},
            "hovertemplate": hover, "marker": {"symbol": symbol, "size": 10, "color": colour}}


def _number_sides(t_s: Array, span_s: float) -> list[str]:
    """On which side of its mark a number stands: away from a neighbour that it would cover."""
    crowded = np.diff(t_s, append=np.inf) < CROWDED * span_s
    return ["middle left" if near else "middle right" for near in crowded.tolist()]


def space_marks(rows: Sequence[Row], T_scene_world: Array, factor: float) -> list[Figure]:
    """Lesions and landmarks for the picture in space."""
    out = []
    for kind, name, symbol, colour in KINDS:
        shown = [(k, row) for k, row in enumerate(rows, 1) if row["kind"] == kind]
        if shown:
            world = np.array([[row["x_mm"], row["y_mm"], row["z_mm"]] for _, row in shown], float) * 1e-3
            points = world @ T_scene_world[:3, :3].T + T_scene_world[:3, 3]
            mark = figures.points3(points, name, symbol, colour, 5, factor)
            out.append(mark | {"mode": "markers+text", "text": [str(k) for k, _ in shown], "hoverinfo": "text",
                               "hovertext": [f"no. {k}" for k, _ in shown], "textfont": {"color": "--ink"}})
    return out


def lesion_table(rows: Sequence[Row]) -> str:
    """All lesions and landmarks as an HTML table; every text in it is escaped."""
    shared = _shared_remarks(rows)
    body = [_table_row(number, row, shared) for number, row in enumerate(rows, 1)]
    for_all = f" Of all of them: {escape('; '.join(shared))}." if shared else ""
    head = ("No.", "What", "% of path", "% of time", "From the nearest landmark [mm]", "Along the gut [mm]", "Frame",
            "Time", "sd in space [mm]")
    return ('<section class="lesions"><h2>Lesions and landmarks</h2><p class="caption">Along the travelled centreline '
            "from the first frame; in brackets 95 % intervals. A negative distance lies before the landmark. "
            f"Numbers as in the figures.{for_all}</p>{table(head, body)}</section>")


def _remarks(row: Row) -> list[str]:
    return [] if row["status"] == "ok" else str(row["status"]).split("; ")


def _shared_remarks(rows: Sequence[Row]) -> list[str]:
    """What is said of every one of several rows: it is said once."""
    if len(rows) < 2:
        return []
    return [remark for remark in _remarks(rows[0]) if all(remark in _remarks(row) for row in rows)]


def _table_row(number: int, row: Row, shared: Sequence[str]) -> str:
    what = f"{row['label']} ({row['kind']})" if row["kind"] == "landmark" else row["label"]
    named = row["id"] if row["id"] != str(number) else ""
    away = _interval(row, "from_landmark_mm", "from_landmark_lo_mm", "from_landmark_hi_mm")
    if row["nearest_landmark"] is not None:
        away += f" {row['nearest_landmark']}"
    sd = f"{NBSP}×{NBSP}".join(_figure(row[f"sd_{axis}_mm"]) for axis in ("major", "mid", "minor"))
    cells = [_interval(row, "percent_path", "percent_path_lo", "percent_path_hi"), _figure(row["percent_time"]), away,
             _interval(row, "arc_length_mm", "arc_lo_mm", "arc_hi_mm"), str(row["frame"]),
             _clock(float(row["timestamp_s"])), sd]
    label = escape(what) + (f" <small>{escape(named)}</small>" if named else "")
    own = "; ".join(remark for remark in _remarks(row) if remark not in shared)
    remark = f'<div class="remark">{escape(own)}</div>' if own else ""
    return (f'<tr><th>{number}</th><td class="label">{label}{remark}</td>'
            + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")


def _clock(seconds: float) -> str:
    """Hours, minutes and seconds after the first frame."""
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def _interval(row: Row, value: str, low: str, high: str) -> str:
    if row[value] is None:
        return "–"
    bounds = "" if row[low] is None else f" [{_figure(row[low])}{NBSP}to{NBSP}{_figure(row[high])}]"
    return _figure(row[value]) + bounds


def _figure(value: float | None) -> str:
    return "–" if value is None else f"{value:,.{0 if abs(value) >= 99.95 else 1}f}".replace("-", "−")
