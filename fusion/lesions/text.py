"""Located lesions as a table for a terminal."""

from __future__ import annotations

from fusion.lesions.measures import Interval
from fusion.lesions.table import Lesion, LesionTable

HEADER = ("id", "label", "frame", "time", "along the gut [95 %]", "from nearest landmark", "% of path", "% of time")
LONGEST = 40


def format_lesions(table: LesionTable) -> str:
    """One line per lesion or landmark, then the remarks that their statuses make."""
    body = [_line(lesion) for lesion in table.lesions]
    widths = [max(len(row[k]) for row in [HEADER, *body]) for k in range(len(HEADER))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
             for row in [HEADER, *body]]
    remarks: dict[str, list[str]] = {}
    for lesion in table.lesions:
        for remark in lesion.status.split("; ") if lesion.status != "ok" else []:
            remarks.setdefault(remark, []).append(lesion.id)
    return "\n".join(lines + [f"{', '.join(ids)}: {remark}" for remark, ids in remarks.items()])


def _line(lesion: Lesion) -> tuple[str, ...]:
    away = _interval(lesion.from_landmark_m, 1e3, " mm")
    landmark = f" from {lesion.nearest_landmark[:LONGEST]}" if lesion.nearest_landmark else ""
    times = len(lesion.sightings)
    return (lesion.id, lesion.label[:LONGEST] + (f" ({times} sightings)" if times > 1 else ""), str(lesion.frame),
            f"{lesion.timestamp_s:.1f} s", _interval(lesion.arc_m, 1e3, " mm"), away + landmark,
            _interval(lesion.percent_path, 1.0, " %"),
            "unavailable" if lesion.percent_time is None else f"{lesion.percent_time:.1f} %")


def _interval(interval: Interval | None, factor: float, unit: str) -> str:
    if interval is None:
        return "unavailable"
    bounds = ("" if interval.low is None or interval.high is None
              else f" [{factor * interval.low:.1f}, {factor * interval.high:.1f}]")
    return f"{factor * interval.value:.1f}{bounds}{unit}"
