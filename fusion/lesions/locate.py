"""Lesions on a trajectory: read the list, place every sighting, merge, measure along the gut."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fusion.lesions import measures
from fusion.lesions.course import Course
from fusion.lesions.fixes import DepthSource, Fix, place_sighting
from fusion.lesions.measures import Along, Interval
from fusion.lesions.merging import Place, merge
from fusion.lesions.sightings import Sighting, read_sightings
from fusion.lesions.table import Lesion, LesionTable
from fusion.result import Refinement, check_same_recording
from fusion.run_states import read_refinement
from vio.depth_folder import read_depth_folder
from vio.errors import LesionError
from vio.recording import Recording

FARTHEST_FRAME_S = 0.5
"""A time further than this (and than half the usual frame spacing) from every frame shows nothing."""


def locate(refined: Refinement | str | Path, lesions: str | Path | Sequence[Sighting], *,
           depth: str | Path | None = None, recording: Recording | None = None, between: tuple[str, str] | None = None,
           video: str | None = None, depth_relative_sd: float | None = None) -> LesionTable:
    """Place lesions on a refined trajectory, each with 95 % intervals.

    Args:
        refined: a refinement, or the run folder it was written to.
        lesions: a file as `fusion.lesions.sightings` describes, or sightings.
        depth: folder of depth maps, as `predict --depth` writes it; wins over the recording's own.
        recording: the recording that was refined: its depth maps, and the times of its frames.
        between: labels of the two landmarks that percentages refer to; by default pylorus and ileocecal valve, and
            where neither was seen the first and the last landmark.
        video: which video of a Kvasir-Capsule file.
        depth_relative_sd: standard deviation of a depth, as a share of it; None = what the sd maps beside predicted
            depth say, 0.1 where there are none.

    Returns:
        One row per lesion or landmark, in order of time. What cannot be known is None, and the row's status says why.

    Raises:
        LesionError: the list, a frame, a time or a pixel that cannot be used, in one line.
        FormatError: no run folder, or no folder of depth maps.
    """
    if depth_relative_sd is not None and not 0 < depth_relative_sd < 1:
        raise LesionError(f"locate: the sd of depth is {depth_relative_sd}; give a share between 0 and 1, such as 0.1")
    refinement = refined if isinstance(refined, Refinement) else read_refinement(refined)
    sightings = read_sightings(lesions, video) if isinstance(lesions, (str, Path)) else list(lesions)
    if recording is not None:
        check_same_recording(refinement, recording)
    source = DepthSource(None if depth is None else read_depth_folder(depth, recording), recording, depth_relative_sd)
    fixes = [_place(refinement, sighting, source) for sighting in sightings]
    places = merge(fixes, refinement.trajectory.t_s)
    return _measure(Course(refinement), places, between)


def _place(refinement: Refinement, sighting: Sighting, source: DepthSource) -> Fix:
    return place_sighting(refinement, sighting, _frame_index(refinement, sighting), refinement.view, source)


def _frame_index(refinement: Refinement, sighting: Sighting) -> int:
    """Frame of the trajectory that a sighting names by number or by time."""
    t = refinement.trajectory.t_s
    if sighting.frame is None:
        return _nearest_frame(t, sighting)
    if refinement.view is None and t[0] > 1e-6:
        raise LesionError(f"{sighting.where}: the run does not say which frame its first is; give timestamp_s instead")
    first = 0 if refinement.view is None else refinement.view.first_frame
    if not first <= sighting.frame < first + len(t):
        raise LesionError(f"{sighting.where}: frame {sighting.frame} is outside the trajectory, frames {first} to "
                          f"{first + len(t) - 1}; nothing is extrapolated")
    return sighting.frame - first


def _nearest_frame(t: np.ndarray[tuple[int], np.dtype[np.float64]], sighting: Sighting) -> int:
    time = float(sighting.timestamp_s or 0.0)
    spacing = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    index = int(np.argmin(np.abs(t - time)))
    if not t[0] - 0.5 * spacing <= time <= t[-1] + 0.5 * spacing:
        raise LesionError(f"{sighting.where}: {time:g} s is outside the trajectory, {t[0]:g} to {t[-1]:g} s after the "
                          "recording's first frame; nothing is extrapolated")
    limit = max(FARTHEST_FRAME_S, 0.51 * spacing)
    if abs(t[index] - time) > limit:
        raise LesionError(f"{sighting.where}: no frame within {limit:g} s of {time:g} s (nearest {t[index]:.3f} s); "
                          "name the frame that shows it")
    return index


def _measure(course: Course, places: list[Place], between: tuple[str, str] | None) -> LesionTable:
    found = [measures.along_line(course, place) for place in places]
    line = [along for along, _ in found]
    span, no_span = measures.choose_span(places, between)
    names = _ids(places)
    rows = []
    for number, (place, (_, note)) in enumerate(zip(places, found, strict=True)):
        notes = [place.fixes[0].note if not place.with_depth else "", note]
        nearest = measures.nearest_landmark(number, places, line)
        away = _between(line[number], None if nearest is None else line[nearest])
        if nearest is None and line[number] is not None:
            notes.append("distance unavailable: no other landmark was seen")
        path, time, why = _shares(course, number, places, line, span)
        arc = None if line[number] is None else measures.arc_interval(line[number])  # type: ignore[arg-type]
        notes += [no_span, why, measures.NO_SAMPLES if course.joint is None and arc is not None else ""]
        rows.append(_row(course, names[number], place, arc, away,
                         None if nearest is None else places[nearest].middle.sighting.label, path, time, notes))
    ends = None if span is None else tuple(places[k].middle.sighting.label for k in (span.start, span.end))
    return LesionTable(course.refinement.name, tuple(rows), ends)  # type: ignore[arg-type]


def _between(a: Along | None, b: Along | None) -> Interval | None:
    return None if a is None or b is None else measures.distance_interval(a, b)


def _shares(course: Course, number: int, places: list[Place], line: list[Along | None],
            span: measures.Span | None) -> tuple[Interval | None, float | None, str]:
    """Percent of path and of time between the landmarks of the span, and why one of them is missing."""
    if span is None:
        return None, None, ""
    index, start_index, end_index = (places[k].middle.index for k in (number, span.start, span.end))
    t, start_t, end_t = (float(course.t_s[k]) for k in (index, start_index, end_index))
    time = 100 * (t - start_t) / (end_t - start_t) if start_t <= t <= end_t and end_t > start_t else None
    here, start, end = line[number], line[span.start], line[span.end]
    if start is None or end is None:
        return None, time, "percent of path unavailable: the arc length of a landmark is not known"
    if here is None:
        return None, time, ""
    labels = [places[k].middle.sighting.label for k in (span.start, span.end)]
    if end.arc_m <= start.arc_m:
        return None, time, f"percent of path unavailable: {labels[1]} does not lie beyond {labels[0]}"
    if not start.arc_m <= here.arc_m <= end.arc_m:
        side = f"before {labels[0]}" if here.arc_m < start.arc_m else f"beyond {labels[1]}"
        return None, time, f"percent of path unavailable: it lies {side}"
    return measures.percent_interval(here, start, end), time, ""


def _ids(places: list[Place]) -> list[str]:
    """The ids given in the list (of the first sighting), and running numbers for the others."""
    given = [next((fix.sighting.id for fix in place.fixes if fix.sighting.id is not None), None) for place in places]
    taken, names, number = set(given), [], 0
    for name in given:
        while name is None:
            number += 1
            name = None if str(number) in taken else str(number)
        names.append(name)
    return names


def _row(course: Course, name: str, place: Place, arc: Interval | None, away: Interval | None, landmark: str | None,
         path: Interval | None, time: float | None, notes: list[str]) -> Lesion:
    refinement, fix = course.refinement, place.middle
    first = 0 if refinement.view is None else refinement.view.first_frame
    axes = np.sqrt(np.maximum(np.linalg.eigvalsh(place.cov_m2)[::-1], 0.0))
    said = list(dict.fromkeys(note for note in notes if note))
    return Lesion(
        id=name, label=fix.sighting.label, kind=fix.sighting.kind, frame=first + fix.index,
        timestamp_s=float(course.t_s[fix.index]), point_m=place.point_m, sd_axes_m=axes, cov_m2=place.cov_m2,
        arc_m=arc, nearest_landmark=landmark, from_landmark_m=away, percent_path=path, percent_time=time,
        status="; ".join(said) or "ok",
        sightings=tuple((first + f.index, float(course.t_s[f.index])) for f in place.fixes),
    )
