"""The trajectory as one small SVG: from above, from the side, and the error along time.

Written by hand so that it needs no plotting library, follows the reader's light or dark scheme, and has the
same bytes for the same refinement.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.report.aligned import Scene, make_scene, thin
from fusion.report.figures import unit_of
from fusion.report.words import SHORT_MODES
from fusion.result import Refinement
from vio.atomic import atomic_write
from vio.motions import RelativeMotions

Array = NDArray[np.float64]

WIDTH, HEIGHT = 960, 640
POINTS = 1500
STYLE = """
.cv{--bg:#fff;--ink:#1c2024;--muted:#667079;--grid:#e7eaed;--refined:#0b68c8;--motions:#d07c1f;--truth:#3a4148;
--rejected:#c8323f;font:13px system-ui,-apple-system,'Segoe UI',Roboto,sans-serif}
@media screen and (prefers-color-scheme:dark){.cv{--bg:#15181c;--ink:#e6e9ec;--muted:#98a1aa;--grid:#2a3037;
--refined:#5caaff;--motions:#f2ac57;--truth:#cdd3d9;--rejected:#ff6f7b}}
.cv .bg{fill:var(--bg)}.cv text{fill:var(--muted)}.cv .head{fill:var(--ink);font-weight:600}
.cv path{fill:none;stroke-linejoin:round;stroke-linecap:round}.cv .grid{stroke:var(--grid);stroke-width:1}
.cv .refined{stroke:var(--refined);stroke-width:2}.cv .motions{stroke:var(--motions);stroke-width:1.5}
.cv .truth{stroke:var(--truth);stroke-width:1.5;stroke-dasharray:5 4}
.cv .rejected{stroke:var(--rejected);stroke-width:1.5}
.cv .claim{stroke:var(--refined);stroke-width:1;stroke-dasharray:2 3}.cv .dot{fill:var(--refined)}
"""


class Line(NamedTuple):
    """One curve of a panel."""

    kind: str
    """Class of the style above."""
    x: Array
    y: Array


@dataclass(frozen=True)
class Panel:
    """A rectangle of the picture and the span of values that it shows."""

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Pixels of values; y points up."""
        return (self.left + (x - self.x[0]) / (self.x[1] - self.x[0]) * self.width,
                self.top + self.height - (y - self.y[0]) / (self.y[1] - self.y[0]) * self.height)

    def path(self, line: Line) -> str:
        """The curve as an SVG path."""
        x, y = self.at(line.x, line.y)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True) if a == a and b == b)
        return f'<path class="{line.kind}" d="M{points}"/>' if points else ""


def write_trajectory_plot(refinement: Refinement, path: str | Path, motions: RelativeMotions | None = None) -> None:
    """Write the picture as an SVG file, atomically.

    Args:
        refinement: what to show.
        path: the file.
        motions: the motions it was made from; they place the rejected ones where pairs are not all neighbours.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_write(path) as file:
        file.write(trajectory_svg(refinement, make_scene(refinement, motions)).encode())


def trajectory_svg(refinement: Refinement, scene: Scene) -> str:
    """The picture as an SVG element that can also stand inside a page."""
    centre = scene.refined_m.mean(axis=0)
    tracks = [("motions", scene.motions_m), ("refined", scene.refined_m)]
    if scene.errors is not None:
        tracks.append(("truth", scene.errors.truth_m))
    unit, factor = unit_of(*(track - centre for _, track in tracks))
    shown = [(kind, track[thin(np.arange(len(track), dtype=float), POINTS)] * factor) for kind, track in tracks]
    body = [_legend([kind for kind, _ in shown])]
    for left, vertical, title in ((72, 1, "from above"), (552, 2, "from the side")):
        lines = [Line(kind, track[:, 0], track[:, vertical]) for kind, track in shown]
        panel = _equal_panel(lines, left, 92, 390, 290)
        body += _frame(panel, f"{title}: {'xyz'[vertical]} over x [{unit}]")
        body += [panel.path(line) for line in lines]
        x, y = panel.at(shown[1][1][[0, -1], 0], shown[1][1][[0, -1], vertical])
        body += [f'<circle class="dot" cx="{x[0]:.1f}" cy="{y[0]:.1f}" r="4"/>',
                 f'<rect class="dot" x="{x[1] - 3.5:.1f}" y="{y[1] - 3.5:.1f}" width="7" height="7"/>']
    body += _time_panel(scene)
    name = escape(refinement.name)
    return (f'<svg class="cv" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
            f'aria-label="Trajectory of {name}"><style>{STYLE}</style>'
            f'<rect class="bg" width="{WIDTH}" height="{HEIGHT}"/>'
            f'<text class="head" x="24" y="34" font-size="17">{name}</text>{"".join(body)}</svg>\n')


def _legend(kinds: Sequence[str]) -> str:
    names = {"refined": "refined", "motions": "motions alone", "truth": "truth"}
    parts, x = [], 24
    for kind in reversed(kinds):
        parts.append(f'<path class="{kind}" d="M{x},54 {x + 26},54"/><text x="{x + 33}" y="58">{names[kind]}</text>')
        x += 62 + 7 * len(names[kind])
    return "".join(parts) + (
        f'<circle class="dot" cx="{x + 4}" cy="54" r="4"/><text x="{x + 14}" y="58">start</text>'
        f'<rect class="dot" x="{x + 66}" y="50.5" width="7" height="7"/><text x="{x + 80}" y="58">end</text>'
    )


def _time_panel(scene: Scene) -> list[str]:
    """Errors where truth is known, else what the estimator claims."""
    lines, title = [], "claimed 3 sigma of position"
    if scene.errors is not None:
        keep = thin(scene.errors.refined_m, POINTS)
        t = scene.errors.t_s[keep]
        lines = [Line("motions", t, scene.errors.motions_m[keep]), Line("refined", t, scene.errors.refined_m[keep])]
        title = f"distance from truth, {SHORT_MODES[scene.errors.mode]}"
    elif scene.claimed_sd_m is not None:
        keep = thin(scene.claimed_sd_m, POINTS)
        lines = [Line("claim", scene.t_s[keep], 3 * scene.claimed_sd_m[keep])]
    if not lines:
        return []
    unit, factor = unit_of(*(line.y for line in lines))
    lines = [line._replace(y=line.y * factor) for line in lines]
    top = max(float(np.nanmax(line.y, initial=0.0)) for line in lines) * 1.06 or 1.0
    span = (float(scene.t_s[0]), max(float(scene.t_s[-1]), float(scene.t_s[0]) + 1e-9))
    panel = Panel(72, 452, 870, 150, span, (0.0, top))
    parts = [*_frame(panel, f"{title} [{unit}], over time [s]"), *(panel.path(line) for line in lines)]
    if scene.rejected_frames is not None and len(scene.rejected_frames):
        x, _ = panel.at(scene.t_s[scene.rejected_frames], np.zeros(1))
        marks = "".join(f"M{a:.1f},596v6" for a in np.unique(x.round(1)).tolist())
        count = len(scene.kept.refinement.rejected)
        note = f'<text x="942" y="442" text-anchor="end">{count:,} motions rejected, marked below</text>'
        parts += [f'<path class="rejected" d="{marks}"/>', note]
    return parts


def _equal_panel(lines: Sequence[Line], left: float, top: float, width: float, height: float) -> Panel:
    """A panel that holds all curves with one scale on both axes."""
    x, y = (np.concatenate([getattr(line, axis) for line in lines]) for axis in "xy")
    per_pixel = 1.08 * max(np.ptp(x) / width, np.ptp(y) / height, 1e-12)
    half_x, half_y = 0.5 * per_pixel * width, 0.5 * per_pixel * height
    x0, y0 = 0.5 * (x.min() + x.max()), 0.5 * (y.min() + y.max())
    return Panel(left, top, width, height, (x0 - half_x, x0 + half_x), (y0 - half_y, y0 + half_y))


def _frame(panel: Panel, title: str) -> list[str]:
    """Title, grid and tick labels."""
    parts = [f'<text class="head" x="{panel.left:g}" y="{panel.top - 10:g}">{escape(title)}</text>']
    bottom, right = panel.top + panel.height, panel.left + panel.width
    for value in ticks(*panel.x, 6):
        x = float(panel.at(np.array(value), np.array(panel.y[0]))[0])
        parts.append(f'<path class="grid" d="M{x:.1f},{panel.top:g}V{bottom:g}"/>'
                     f'<text x="{x:.1f}" y="{bottom + 18:g}" text-anchor="middle">{_label(value)}</text>')
    for value in ticks(*panel.y, 5):
        y = float(panel.at(np.array(panel.x[0]), np.array(value))[1])
        parts.append(f'<path class="grid" d="M{panel.left:g},{y:.1f}H{right:g}"/>'
                     f'<text x="{panel.left - 8:g}" y="{y + 4:.1f}" text-anchor="end">{_label(value)}</text>')
    return parts


def _label(value: float) -> str:
    return f"{value:g}".replace("-", "−")


def ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers from `low` to `high`, in steps of 1, 2 or 5 times a power of ten."""
    raw = max(high - low, 1e-12) / about
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * k for k in (1, 2, 5, 10) if power * k >= raw)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [float(f"{k * step:.10g}") for k in range(first, last + 1)]
