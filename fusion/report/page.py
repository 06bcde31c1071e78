"""`report.html`: one self-contained page. Everything it needs is inside, and it may fetch nothing."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from fusion.frame_blocks import FrameSource
from fusion.report import figures, sections, words
from fusion.report.aligned import Scene, make_scene
from fusion.report.levels import rate_figure, speed_figure, vibration_figure
from fusion.report.pictures import picture_gallery
from fusion.report.plot import trajectory_svg
from fusion.report.tube import tube_figure
from fusion.report.unrolled import lesion_table, space_marks, unrolled_figure
from fusion.result import SAME_FRAME_S, Refinement, another_recording
from vio.atomic import atomic_write
from vio.motions import RelativeMotions
from vio.recording import Recording

UNROLLED = ("Distance along the travelled centreline from the first frame; back-and-forth and dwell do not count. "
            "Bars are 95 % intervals, dotted lines are landmarks. A lesion stands off the course by as far as the "
            "camera saw ahead.")
KEYS = "Keys, once a figure has the focus: arrows move or turn, + and − zoom, Home goes back."
TUBE = " The tube holds the body with 95 %, as claimed relative to the first pose."


def write_report(
    refinement: Refinement | FrameSource, summary: Mapping[str, Any], path: str | Path,
    motions: RelativeMotions | None = None, lesions: Sequence[Mapping[str, Any]] | None = None,
    recording: Recording | None = None,
) -> None:
    """Write the page, atomically.

    Args:
        refinement: what was concluded; a run folder as `fusion.run_stream.RunFrames` is read in constant memory.
        summary: as in `summary.json` (docs/conventions.md); figures of accuracy are taken from here.
        path: the file.
        motions: the motions it was made from; they place the rejected ones where pairs are not all neighbours.
        lesions: rows of `lesions.json` (`fusion.read_lesions`).
        recording: the recording that was refined; lesions then come with pictures of the frames that show them.

    Raises:
        FormatError: frames of a run folder that cannot be read.
        OutputError: the file cannot be written.
        RecordingError: the recording is not the one that was refined, or one of its images is cut off or undecodable.
    """
    from plotly.offline import get_plotlyjs  # heavy, and needed only once a page is written

    scene = make_scene(refinement, motions)
    if recording is not None:
        _check_same(scene, recording)
    page = Template(_asset("page.html")).substitute(
        _content(scene, summary, lesions or (), recording),
        style=_asset("page.css"), script=_asset("page.js"), plotly=get_plotlyjs(),
    )
    with atomic_write(path) as file:
        file.write(page.encode())


def _asset(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _check_same(scene: Scene, recording: Recording) -> None:
    """`check_same_recording`, by the frames that were kept."""
    refinement, frame, count = scene.kept.refinement, scene.kept.frame, scene.kept.count
    first = 0 if refinement.view is None else refinement.view.first_frame
    t_s = recording.frame_t_s[first:first + count]
    if len(t_s) != count or np.abs(t_s[frame] - scene.t_s).max() > SAME_FRAME_S:
        raise another_recording(refinement, recording)


def _content(scene: Scene, summary: Mapping[str, Any], lesions: Sequence[Mapping[str, Any]],
             recording: Recording | None) -> dict[str, str]:
    refinement, kept = scene.kept.refinement, scene.kept
    verdict = words.verdict(refinement, summary)
    within = None if scene.errors is None else scene.errors.within_3_sigma
    facts = words.sentences(refinement, summary, within, (kept.mean_gyro_bias_rad_s, kept.mean_accel_bias_m_s2))
    drawn = _figures(refinement, scene, lesions)
    return {
        "name": escape(refinement.name),
        "facts_line": escape(_facts_line(scene, summary)),
        "tone": verdict.tone,
        "verdict": escape(verdict.text),
        "tiles": sections.tiles(refinement, summary, scene),
        "sentences": "".join(f"<dt>{escape(head)}</dt><dd>{escape(text)}</dd>" for head, text in facts),
        "lesions": lesion_table(lesions) if lesions else "",
        "pictures": picture_gallery(lesions, recording) if lesions and recording is not None else "",
        "keys": escape(KEYS),
        "still": trajectory_svg(refinement, scene),
        "sections": "".join(_section(key, title, caption) for key, title, caption, _ in drawn),
        "accuracy": sections.accuracy_table(summary.get("accuracy") or {}),
        "paper": sections.paper_table(summary.get("paper_metrics") or {}),
        "colophon": escape(sections.colophon(summary)),
        "figures": _script_json({key: figure for key, _, _, figure in drawn}),
    }


def _figures(refinement: Refinement, scene: Scene,
             lesions: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str, figures.Figure]]:
    """(key, title, caption, figure) in reading order."""
    gaps = [(gap.start_s, gap.end_s) for gap in refinement.imu.gaps]
    t = refinement.trajectory.t_s
    rejected = None if scene.rejected_frames is None else t[scene.rejected_frames]
    space = figures.trajectory_figure(scene)
    out = [("trajectory", "Trajectory", _trajectory_caption(scene), space)]
    space["data"] += tube_figure(scene, figures.space_unit(scene)[1])
    if lesions:
        space["data"] += space_marks(lesions, scene.T_scene_world, figures.space_unit(scene)[1])
        out.append(("unrolled", "The gut unrolled", UNROLLED, unrolled_figure(refinement, lesions)))
    if scene.errors is not None:
        caption = f"Both estimates {words.SHORT_MODES[scene.errors.mode]}. {_marks(refinement, rejected is not None)}"
        out.append(("error", "Distance from truth", caption, figures.error_figure(scene.errors, rejected, gaps)))
        caption = f"Both estimates {words.SHORT_MODES[scene.errors.mode]}."
        out.append(("rotation", "Attitude error", caption, figures.rotation_figure(scene.errors, gaps)))
    if (claim := figures.claim_figure(scene, gaps)) is not None:
        caption = "What the estimator claims for the worst direction of every position, relative to the first pose."
        if scene.errors is not None:
            caption += " The line is the true error when the first poses are laid together; it should stay inside."
        out.append(("claim", "Claimed uncertainty", caption, claim))
    caption = f"Length of the track per second, in spans. {_marks(refinement, rejected is not None)}"
    out.append(("speed", "Speed and rejected motions", caption, speed_figure(scene, gaps)))
    out.append(("scale", "Scale", "Length of one motion unit, with two standard deviations.",
                figures.scale_figure(refinement, gaps)))
    if refinement.inertial is not None:
        out.append(("rate", "Turning", "What the gyro felt.", rate_figure(refinement.inertial, gaps)))
        caption = "Specific force less its slow part: tremor, bumps, steps of the patient."
        out.append(("vibration", "Vibration", caption, vibration_figure(refinement.inertial, gaps)))
    for key, title, values, label in (
        ("gyro", "Gyro bias", refinement.gyro_bias_rad_s * 57.29577951308232, "bias [°/s]"),
        ("accel", "Accelerometer bias", refinement.accel_bias_m_s2, "bias [m/s²]"),
    ):
        out.append((key, title, "Body axes.", figures.bias_figure(t, values, label, gaps)))
    return out


def _trajectory_caption(scene: Scene) -> str:
    where = "in the estimator's world: z up, position and yaw counted from the first pose"
    if scene.errors is not None:
        where = f"both estimates laid over truth {words.SHORT_MODES[scene.errors.mode]}"
    text = f"Position of the body, {where}; from the ball to the diamond. Drag to turn, scroll to zoom."
    if scene.claimed_cov_m2 is not None:
        text += TUBE
    if len(scene.t_s) > figures.LIMIT:
        text += f" {figures.LIMIT:,} of {scene.kept.count:,} poses are drawn."
    return text


def _marks(refinement: Refinement, placed: bool) -> str:
    parts = []
    if len(refinement.rejected):
        parts.append("Red marks: motions rejected as outliers." if placed else
                     "Rejected motions are not marked: not all motions join neighbouring frames.")
    if refinement.imu.gaps:
        parts.append("Shaded: no inertial samples.")
    return " ".join(parts)


def _facts_line(scene: Scene, summary: Mapping[str, Any]) -> str:
    estimator = words.ESTIMATORS[scene.kept.refinement.estimator]
    return (f"{scene.kept.count:,} frames · {words.duration(float(summary['duration_s']))} · "
            f"path {words.length(float(summary['path_length_m']))} · {estimator}")


def _section(key: str, title: str, caption: str) -> str:
    return (f'<figure class="{key}"><h2>{escape(title)}</h2><figcaption>{escape(caption)}</figcaption>'
            f'<div class="plot" id="{key}" role="img" tabindex="0" aria-label="{escape(title)}" '
            'aria-describedby="keys"></div></figure>')


def _script_json(value: object) -> str:
    """JSON that can stand inside a script element."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c").replace("&", "\\u0026")
