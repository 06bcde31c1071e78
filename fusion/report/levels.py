"""Along time, with or without truth: how fast the capsule went, which motions were rejected, what the IMU felt."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusion.report import figures
from fusion.report.aligned import Scene
from fusion.report.figures import Figure
from fusion.report.kept import even_frames
from vio.inertial_levels import InertialLevels

Array = NDArray[np.float64]

SPANS = 1000


def speed_figure(scene: Scene, gaps: Sequence[tuple[float, float]]) -> Figure:
    """Length of the track per second, refined and of the motions alone, with the motions that were rejected."""
    kept = scene.kept
    rows = kept.rows_of(even_frames(kept.count, SPANS + 1))
    t, refined = spans_speed(scene.t_s[rows], kept.way_m[rows])
    _, motions = spans_speed(scene.t_s[rows], kept.motions_way_m[rows])
    data = [figures.line(t, 1e3 * motions, "motions alone", "--motions", 1.4),
            figures.line(t, 1e3 * refined, "refined", "--refined", 1.8)]
    if scene.rejected_frames is not None and len(scene.rejected_frames):
        data.append(figures.rejected_ticks(scene.t_s[scene.rejected_frames]))
    return {"data": data, "layout": figures.time_layout("speed [mm/s]", scene.t_s, gaps, zero=True)}


def spans_speed(t_s: Array, way_m: Array) -> tuple[Array, Array]:
    """Centres (B,) of the spans between B + 1 times [s], and the mean speed (B,) in each [m/s], from the way up to
    those times."""
    if len(t_s) < 2:
        return t_s, np.zeros(len(t_s))
    return 0.5 * (t_s[1:] + t_s[:-1]), np.diff(way_m) / np.diff(t_s)


def rate_figure(levels: InertialLevels, gaps: Sequence[tuple[float, float]]) -> Figure:
    """How fast the body turned."""
    data = [figures.line(levels.t_s, np.rad2deg(levels.rate_rad_s), "angular rate", "--refined", 1.5)]
    return {"data": data, "layout": figures.time_layout("rms rate [°/s]", levels.t_s, gaps, zero=True, height=240)}


def vibration_figure(levels: InertialLevels, gaps: Sequence[tuple[float, float]]) -> Figure:
    """How much it was shaken."""
    data = [figures.line(levels.t_s, levels.vibration_m_s2, "vibration", "--rejected", 1.5)]
    layout = figures.time_layout("rms vibration [m/s²]", levels.t_s, gaps, zero=True, height=240)
    return {"data": data, "layout": layout}
