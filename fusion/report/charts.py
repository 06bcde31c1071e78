"""Small charts as SVG, written by hand: no script, light and dark by style sheet, the same bytes for the same data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from fusion.report.aligned import thin
from fusion.report.plot import Line, Panel, ticks

Array = NDArray[np.float64]

WIDTH, NARROW, HEIGHT = 960, 380, 250
"""A page that is too narrow for the one width shows the other: letters keep their size."""
LEFT, TOP, RIGHT, BOTTOM = 66.0, 26.0, 16.0, 44.0
POINTS_PER_PX = 2
LETTER_PX = 7.2
"""Of the legend, about."""


@dataclass(frozen=True)
class Curve:
    """One curve."""

    kind: str
    """Class of the style sheet, which says its colour."""
    x: Array
    y: Array
    name: str = ""
    """For the legend; empty = not in it."""


@dataclass(frozen=True)
class Chart:
    """Curves over one pair of axes."""

    curves: Sequence[Curve]
    x_label: str
    y_label: str
    zero: bool = False
    """Whether the vertical axis starts at zero."""
    log: bool = False
    """Whether both axes are logarithmic; what is not positive is left out."""


def chart_svgs(chart: Chart, title: str) -> str:
    """The chart for wide and for narrow pages; the style sheet shows one of them."""
    return chart_svg(chart, title, WIDTH, "chart on-wide") + chart_svg(chart, title, NARROW, "chart on-narrow")


def chart_svg(chart: Chart, title: str, width: int = WIDTH, kind: str = "chart") -> str:
    """The chart as an SVG element of class `kind`; values that are not finite leave gaps."""
    curves = [_prepared(curve, chart.log, POINTS_PER_PX * width) for curve in chart.curves]
    panel = Panel(LEFT, TOP, width - LEFT - RIGHT, HEIGHT - TOP - BOTTOM, _span([c.x for c in curves], False),
                  _span([c.y for c in curves], chart.zero))
    body = [*_axes(panel, chart), *(_path(panel, curve) for curve in curves), *_legend(chart.curves, width)]
    return (f'<svg class="{kind}" viewBox="0 0 {width} {HEIGHT}" role="img" aria-label="{escape(title)}">'
            f"{''.join(body)}</svg>")


def _prepared(curve: Curve, log: bool, points: int) -> Curve:
    """Logarithms where asked for, and thinned for the eye without losing peaks."""
    x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
    if log:
        good = (x > 0) & (y > 0)
        x, y = np.log10(x[good]), np.log10(y[good])
    keep = thin(np.where(np.isfinite(y), y, -np.inf), points) if len(y) else np.zeros(0, np.int64)
    return Curve(curve.kind, x[keep], y[keep], curve.name)


def _span(values: Sequence[Array], zero: bool) -> tuple[float, float]:
    """From the smallest to the largest finite value, a little wider, never empty."""
    everything = np.concatenate([v[np.isfinite(v)] for v in values] or [np.zeros(0)])
    low, high = (float(everything.min()), float(everything.max())) if len(everything) else (0.0, 1.0)
    low = min(low, 0.0) if zero else low
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return (low if zero else low - margin), high + margin


def _path(panel: Panel, curve: Curve) -> str:
    """The curve, broken where it is not finite."""
    finite = np.isfinite(curve.y)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], finite, [False]]).astype(int)))
    pieces = []
    for start, end in edges.reshape(-1, 2).tolist():
        points = [start, start] if end - start == 1 else list(range(start, end))  # round caps make a dot of one point
        pieces.append(panel.path(Line(curve.kind, curve.x[points], curve.y[points])))
    return "".join(pieces)


def _axes(panel: Panel, chart: Chart) -> list[str]:
    bottom, right = panel.top + panel.height, panel.left + panel.width
    parts = []
    for value, label in _marks(panel.x, 8 if panel.width > 500 else 6, chart.log):
        x = float(panel.at(np.array(value), np.array(panel.y[0]))[0])
        parts.append(f'<path class="grid" d="M{x:.1f},{panel.top:g}V{bottom:g}"/>'
                     f'<text x="{x:.1f}" y="{bottom + 18:g}" text-anchor="middle">{label}</text>')
    for value, label in _marks(panel.y, 5, chart.log):
        y = float(panel.at(np.array(panel.x[0]), np.array(value))[1])
        parts.append(f'<path class="grid" d="M{panel.left:g},{y:.1f}H{right:g}"/>'
                     f'<text x="{panel.left - 8:g}" y="{y + 4:.1f}" text-anchor="end">{label}</text>')
    return [*parts, f'<text x="{right:g}" y="{bottom + 36:g}" text-anchor="end">{escape(chart.x_label)}</text>',
            f'<text x="4" y="{panel.top - 10:g}">{escape(chart.y_label)}</text>']


def _marks(span: tuple[float, float], about: int, log: bool) -> list[tuple[float, str]]:
    """Where ticks stand, and what they say; on a logarithmic axis at 1, 2 and 5 times powers of ten."""
    if not log:
        return [(value, f"{value:g}".replace("-", "−")) for value in ticks(*span, about)]
    decades = range(int(np.floor(span[0])), int(np.ceil(span[1])) + 1)
    steps = (1, 2, 5) if span[1] - span[0] < 2.5 else (1,)
    at = [(float(np.log10(step)) + decade, f"{step * 10.0**decade:.3g}") for decade in decades for step in steps]
    return [(value, label) for value, label in at if span[0] <= value <= span[1]]


def _legend(curves: Sequence[Curve], width: float) -> list[str]:
    named = [curve for curve in curves if curve.name]
    parts, x = [], width - RIGHT - sum(LETTER_PX * len(curve.name) + 46 for curve in named) + 16
    for curve in named:
        parts += [f'<path class="{curve.kind}" d="M{x:g},{TOP - 14:g} {x + 24:g},{TOP - 14:g}"/>',
                  f'<text x="{x + 30:g}" y="{TOP - 10:g}">{escape(curve.name)}</text>']
        x += LETTER_PX * len(curve.name) + 46
    return parts
