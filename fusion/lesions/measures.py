"""How far along the gut a place is: arc length, distance from landmarks, share of a span, each with a 95 % interval.

Two sources of error: the trajectory's, by its samples (all places of one sample share its errors, so that distances
between places are as certain as they really are), and what samples cannot know: the centreline's own, for a capsule
does not keep to the middle of the gut, and the estimator's scale bias. Their size was measured on simulated recordings
(docs/results/lesions.md).
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from fusion.lesions.course import Course
from fusion.lesions.merging import Place

Array = NDArray[np.float64]

LEVEL = 0.95
WANDER_SHARE = 0.01
"""Standard deviation of a length along the line, as a share of it: the capsule cuts corners and sways."""
WANDER_PER_SWAY = 1.0
"""Standard deviation of every place along the line, over how far the capsule sways from it: where it leans on the wall
of a bend, the place beside it is a matter of view."""
SCALE_SHARE = 0.01
"""By how much estimated scales are off beyond what they claim (docs/results/accuracy.md): it stretches every length."""
TILT_RAD = 0.12
"""Standard deviation of the line's direction: a place beside the line slides along it by this times its distance."""
VIEW_REACH_M = 25e-3
"""A lesion is looked for along the line as far as it is from the camera, and this much further."""
PYLORUS = ("pylorus",)
VALVE = ("ileocecal valve", "ileo-cecal valve", "ileocaecal valve", "ileo-caecal valve", "icv")
NO_SAMPLES = "interval unknown: the run holds no joint covariances; refine the recording again"


class Interval(NamedTuple):
    """An estimate with its central 95 % interval; `low` and `high` are None where that is unknown."""

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Along:
    """One place along the centreline."""

    arc_m: float
    sampled_m: Array
    """(S,) in every sampled trajectory."""
    own_m: float
    """Standard deviation that is this place's alone."""
    zero_m: float
    """Standard deviation of the first frame's place, from which arc length counts."""
    ambiguous_m: Array
    """(T,) by how much it moves when sampled trajectories find their own way."""


@dataclass(frozen=True)
class Span:
    """Two landmarks that percentages refer to."""

    start: int
    """Index into the list of places."""
    end: int


def along_line(course: Course, place: Place) -> tuple[Along | None, str]:
    """Where a place lies along the travelled centreline, or None and why it is unknown."""
    if not place.with_depth:
        return capsule_along(course, *(fix.index for fix in place.fixes)), ""
    wander = WANDER_PER_SWAY * course.centreline.sway_m
    frame = next(fix.index for fix in place.fixes if fix.with_depth)
    camera = course.refinement.trajectory.positions_m[frame]
    reach = float(np.linalg.norm(place.point_m - camera)) + VIEW_REACH_M
    errors = place.common_m + _own_draws(place, len(place.common_m))
    beside = course.arc_of(place.point_m, errors, frame, reach)
    if beside is None:
        return None, "the lesion lies beyond the path that was travelled: its arc length is not known"
    own = float(np.hypot(wander, TILT_RAD * beside.aside_m))
    return Along(beside.arc_m, beside.sampled_m, own, wander, course.ambiguity_m[:, frame]), ""


def capsule_along(course: Course, *frames: int) -> Along:
    """Where the capsule itself was, in the mean over some frames."""
    wander = WANDER_PER_SWAY * course.centreline.sway_m
    arc, sampled = course.arc_at(float(course.frame_places(np.array(frames)).mean()))
    return Along(arc, sampled, wander, wander, course.ambiguity_m[:, frames[(len(frames) - 1) // 2]])


def _own_draws(place: Place, count: int) -> Array:
    """(S, 3) draws of the error that is the place's own: the same at every call, and no other place's."""
    rng = np.random.default_rng([place.fixes[0].index, zlib.crc32(place.middle.sighting.label.encode())])
    return np.asarray(rng.standard_normal((count, 3)) @ np.linalg.cholesky(place.own_cov).T)


def arc_interval(a: Along) -> Interval:
    """Arc length from the first frame [m]."""
    own = np.array([a.zero_m, a.own_m, WANDER_SHARE * a.arc_m, SCALE_SHARE * a.arc_m])
    return _interval(a.arc_m, a.sampled_m, own, a.ambiguous_m)


def distance_interval(a: Along, landmark: Along) -> Interval:
    """How far `a` lies beyond a landmark [m]; negative before it."""
    length = a.arc_m - landmark.arc_m
    own = np.array([a.own_m, landmark.own_m, WANDER_SHARE * length, SCALE_SHARE * length])
    return _interval(length, a.sampled_m - landmark.sampled_m, own, a.ambiguous_m - landmark.ambiguous_m)


def percent_interval(a: Along, start: Along, end: Along) -> Interval:
    """Share of the way from one landmark to another [%]."""
    span = end.arc_m - start.arc_m
    share = (a.arc_m - start.arc_m) / span
    sampled = 100 * (a.sampled_m - start.sampled_m) / (end.sampled_m - start.sampled_m)
    own = np.array([0.0])
    if a is not start and a is not end:
        # A wobble of the line on either side is shared by the span: it moves the place like a Brownian bridge.
        bridge = WANDER_SHARE * abs(span) * np.sqrt(max(share * (1 - share), 0.0))
        own = np.array([a.own_m, (1 - share) * start.own_m, share * end.own_m, bridge]) * 100 / span
    moved = a.ambiguous_m - (1 - share) * start.ambiguous_m - share * end.ambiguous_m
    return _interval(100 * share, sampled, own, moved * 100 / span)


def _interval(value: float, sampled: Array, own: Array, ambiguous: Array) -> Interval:
    if len(sampled) < 2:
        return Interval(value, None, None)
    sd = float(np.sqrt(sampled.var(ddof=1) + (own**2).sum() + (ambiguous**2).mean()))
    half = float(student.ppf(0.5 + 0.5 * LEVEL, len(sampled) - 1)) * sd
    return Interval(value, value - half, value + half)


def choose_span(places: list[Place], between: tuple[str, str] | None) -> tuple[Span | None, str]:
    """The two landmarks that percentages refer to, or None and why there are none.

    Those asked for; else pylorus and ileocecal valve as soon as either was seen (so that a missing one is said and
    not replaced); else the first and the last landmark.
    """
    landmarks = [k for k, place in enumerate(places) if place.middle.sighting.kind == "landmark"]
    wanted = ((between[0].casefold(),), (between[1].casefold(),)) if between else (PYLORUS, VALVE)
    found = [next((k for k in landmarks if _label(places[k]) in names), None) for names in wanted]
    if found[0] is not None and found[1] is not None:
        return Span(found[0], found[1]), ""
    if between is None and found == [None, None]:
        if len(landmarks) >= 2:
            return Span(landmarks[0], landmarks[-1]), ""
        return None, f"percentages unavailable: they need two landmarks and {len(landmarks) or 'none'} was seen"
    names = between or ("pylorus", "ileocecal valve")
    missing = " and ".join(f"no {name}" for name, k in zip(names, found, strict=True) if k is None)
    return None, f"percentages unavailable: {missing} among the landmarks"


def _label(place: Place) -> str:
    return place.middle.sighting.label.casefold()


def nearest_landmark(number: int, places: list[Place], line: list[Along | None]) -> int | None:
    """The other landmark that is nearest along the line; None where there is none or the place itself is unknown."""
    here = line[number]
    if here is None:
        return None
    others = [(abs(there.arc_m - here.arc_m), k) for k, there in enumerate(line)
              if there is not None and k != number and places[k].middle.sighting.kind == "landmark"]
    return min(others)[1] if others else None
