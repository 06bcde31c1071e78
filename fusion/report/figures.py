"""The interactive figures as plain Plotly dictionaries.

Colours are names of style sheet variables (`"--refined"`); the page's script puts in what the reader's
light or dark scheme says. No text in a figure comes from the recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.report.aligned import Scene, TruthErrors, thin
from fusion.report.kept import even_frames
from fusion.result import Refinement

Array = NDArray[np.float64]
Figure = dict[str, Any]

LIMIT = 3000
"""More points than this a screen cannot show."""
MOST_GAPS = 200
"""The longest ones are shaded."""
AXIS_COLOURS = (("x", "--x"), ("y", "--y"), ("z", "--z"))


def unit_of(*metres: Array) -> tuple[str, float]:
    """Name and factor of the unit that suits these lengths: mm, or m above two metres."""
    largest = max((float(np.nanmax(np.abs(values), initial=0.0)) for values in metres), default=0.0)
    return ("m", 1.0) if largest > 2 else ("mm", 1e3)


def space_unit(scene: Scene) -> tuple[str, float]:
    """Name and factor of the unit of the picture in space."""
    centre = scene.refined_m.mean(axis=0)
    return unit_of(scene.refined_m - centre, scene.motions_m - centre)


def trajectory_figure(scene: Scene) -> Figure:
    """Refined, motions alone and truth in space, equal scale on all axes."""
    truth = None if scene.errors is None else scene.errors.truth_m
    unit, factor = space_unit(scene)
    data = []
    if truth is not None and scene.errors is not None:
        data.append(_line3(truth, scene.errors.t_s, "truth", "--truth", 3, unit, factor))
    data.append(_line3(scene.motions_m, scene.t_s, "motions alone", "--motions", 3, unit, factor))
    data.append(_line3(scene.refined_m, scene.t_s, "refined", "--refined", 5, unit, factor))
    data.append(points3(scene.refined_m[:1], "start", "circle", "--refined", 6, factor) | {"showlegend": False})
    data.append(points3(scene.refined_m[-1:], "end", "diamond", "--refined", 6, factor) | {"showlegend": False})
    if scene.rejected_frames is not None and len(scene.rejected_frames):
        at = scene.rejected_frames[even_frames(len(scene.rejected_frames), LIMIT)]
        data.append(points3(scene.refined_m[at], "motion rejected", "square", "--rejected", 3, factor))
    axes = {f"{axis}axis": {"title": {"text": f"{axis} [{unit}]"}, "backgroundcolor": "--panel", "gridcolor": "--grid",
                            "zerolinecolor": "--grid", "color": "--muted", "showspikes": False}
            for axis in "xyz"}
    layout = _layout(height=600) | {"scene": {"aspectmode": "data", "uirevision": "keep", "dragmode": "turntable",
                                              "camera": {"eye": {"x": 1.3, "y": -1.3, "z": 0.85},
                                                         "center": {"x": 0, "y": 0, "z": -0.14}}, **axes}}
    layout["margin"] = {"l": 0, "r": 0, "t": 8, "b": 0}
    return {"data": data, "layout": layout}


def error_figure(errors: TruthErrors, rejected_t_s: Array | None, gaps: Sequence[tuple[float, float]]) -> Figure:
    """Distance from truth along time, both estimates under the same alignment."""
    unit, factor = unit_of(errors.refined_m, errors.motions_m)
    data = [line(errors.t_s, errors.motions_m * factor, "motions alone", "--motions", 1.6),
            line(errors.t_s, errors.refined_m * factor, "refined", "--refined", 2.2)]
    if rejected_t_s is not None and len(rejected_t_s):
        data.append(rejected_ticks(rejected_t_s))
    return {"data": data, "layout": time_layout(f"error [{unit}]", errors.t_s, gaps, zero=True)}


def rotation_figure(errors: TruthErrors, gaps: Sequence[tuple[float, float]]) -> Figure:
    """Angle from the true attitude along time, both estimates under the same alignment."""
    data = [line(errors.t_s, np.rad2deg(errors.motions_rad), "motions alone", "--motions", 1.6),
            line(errors.t_s, np.rad2deg(errors.refined_rad), "refined", "--refined", 2.2)]
    return {"data": data, "layout": time_layout("rotation error [°]", errors.t_s, gaps, zero=True)}


def claim_figure(scene: Scene, gaps: Sequence[tuple[float, float]]) -> Figure | None:
    """The claimed 3 sigma of position, and what it claims to hold: the error with the first poses laid together."""
    if scene.claimed_sd_m is None:
        return None
    claim = 3 * scene.claimed_sd_m
    against = [] if scene.errors is None else [scene.errors.first_pose_m]
    unit, factor = unit_of(claim, *against)
    data = [line(scene.t_s, claim * factor, "claimed 3 sigma", "--refined", 1) | {
        "fill": "tozeroy", "fillcolor": "--refined-band", "line": {"color": "--refined", "width": 1, "dash": "dot"}}]
    if scene.errors is not None:
        data.append(line(scene.errors.t_s, scene.errors.first_pose_m * factor, "refined", "--refined", 2.2))
    return {"data": data, "layout": time_layout(f"position [{unit}]", scene.t_s, gaps, zero=True)}


def scale_figure(refinement: Refinement, gaps: Sequence[tuple[float, float]]) -> Figure:
    """Metres per motion unit along time, with two standard deviations."""
    s, sd, t = refinement.log_scale, refinement.log_scale_sd, refinement.trajectory.t_s
    unit, factor = unit_of(np.exp(s))
    keep = thin(s, LIMIT)
    t, low, middle, high = t[keep], *(factor * np.exp(s[keep] + k * sd[keep]) for k in (-2, 0, 2))
    band = {"x": numbers(np.concatenate([t, t[::-1]])), "y": numbers(np.concatenate([high, low[::-1]])),
            "type": "scatter", "mode": "lines", "fill": "toself", "fillcolor": "--refined-band", "name": "± 2 sd",
            "line": {"width": 0}, "hoverinfo": "skip"}
    data = [band, line(t, middle, "scale", "--refined", 2.2)]
    return {"data": data, "layout": time_layout(f"{unit} per motion unit", t, gaps)}


def bias_figure(t_s: Array, bias: Array, label: str, gaps: Sequence[tuple[float, float]]) -> Figure:
    """Three components of a bias along time."""
    data = [line(t_s, bias[:, k], name, colour, 1.8) for k, (name, colour) in enumerate(AXIS_COLOURS)]
    return {"data": data, "layout": time_layout(label, t_s, gaps, height=240)}


def _layout(height: int) -> Figure:
    return {
        "height": height, "autosize": True, "uirevision": "keep", "paper_bgcolor": "--clear", "plot_bgcolor": "--clear",
        "font": {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 13, "color": "--muted"},
        "margin": {"l": 64, "r": 12, "t": 30, "b": 44},
        # At the figure's top edge, not above the curves: there it would stay in them when the page grows wider.
        "legend": {"orientation": "h", "x": 0, "y": 1, "yref": "container", "xanchor": "left", "yanchor": "top",
                   "bgcolor": "--clear", "font": {"color": "--ink"}},
        "modebar": {"bgcolor": "--clear", "color": "--muted", "activecolor": "--ink"},
        "hoverlabel": {"bgcolor": "--card", "bordercolor": "--grid", "font": {"color": "--ink"}},
    }


def time_layout(
    label: str, t_s: Array, gaps: Sequence[tuple[float, float]], zero: bool = False, height: int = 290
) -> Figure:
    """Layout of a figure over time, with holes in the inertial data shaded."""
    axis = {"gridcolor": "--grid", "zeroline": False, "linecolor": "--grid", "ticks": "outside", "tickcolor": "--grid",
            "automargin": True}
    shapes = [{"type": "rect", "xref": "x", "yref": "paper", "x0": start, "x1": end, "y0": 0, "y1": 1,
               "fillcolor": "--gap", "line": {"width": 0}, "layer": "below"} for start, end in _longest(gaps)]
    return _layout(height) | {
        "hovermode": "x unified", "shapes": shapes, "showlegend": True,
        "xaxis": axis | {"title": {"text": "time [s]", "standoff": 6}, "showgrid": False,
                         "range": [float(t_s[0]), float(t_s[-1])]},
        "yaxis": axis | {"title": {"text": label, "standoff": 8}, "rangemode": "tozero" if zero else "normal",
                         "hoverformat": ".4g"},
    }


def _longest(gaps: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    return sorted(sorted(gaps, key=lambda gap: gap[0] - gap[1])[:MOST_GAPS])


def line(t_s: Array, values: Array, name: str, colour: str, width: float) -> Figure:
    """A curve over time, thinned for the eye."""
    keep = thin(values, LIMIT)
    return {"type": "scatter", "mode": "lines", "name": name, "x": numbers(t_s[keep]), "y": numbers(values[keep]),
            "line": {"color": colour, "width": width}}


def rejected_ticks(t_s: Array) -> Figure:
    """Marks on the time axis where motions were rejected."""
    at = t_s[even_frames(len(t_s), LIMIT)]
    return {"type": "scatter", "mode": "markers", "name": "motion rejected", "x": numbers(at), "y": [0] * len(at),
            "hoverinfo": "skip", "cliponaxis": False,
            "marker": {"symbol": "line-ns-open", "size": 9, "color": "--rejected", "line": {"width": 1.5}}}


def _line3(points_m: Array, t_s: Array, name: str, colour: str, width: float, unit: str, factor: float) -> Figure:
    keep = even_frames(len(points_m), LIMIT)
    hover = f"{name}<br>%{{customdata:.2f}} s<br>%{{x:.4g}}, %{{y:.4g}}, %{{z:.4g}} {unit}<extra></extra>"
    return _xyz(points_m[keep], factor) | {
        "mode": "lines", "name": name, "customdata": numbers(t_s[keep]), "hovertemplate": hover,
        "line": {"color": colour, "width": width}}


def points3(points_m: Array, name: str, symbol: str, colour: str, size: float, factor: float) -> Figure:
    """Marks in space."""
    return _xyz(points_m, factor) | {"mode": "markers", "name": name, "hoverinfo": "name",
                                     "marker": {"symbol": symbol, "size": size, "color": colour}}


def _xyz(points_m: Array, factor: float) -> Figure:
    return {"type": "scatter3d"} | {axis: numbers(points_m[:, k] * factor) for k, axis in enumerate("xyz")}


def numbers(values: Array) -> list[float | None]:
    """JSON numbers with six significant digits; null where not finite."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values.tolist()]
