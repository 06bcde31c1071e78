"""What lies on the wall at known places: lesions, landmarks and residue, with their shape and colour.

A mark is a round patch of wall. It raises or sinks the wall and adds optical density to its colour; both are functions
of the distance to its centre in the unrolled wall, in units of its radius.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vio.simulation.organs import Organ

Array = NDArray[np.float64]

TAU = 2 * np.pi

_SIZES_M = {"polyp": (2.5e-3, 6e-3), "ulcer": (2.5e-3, 6e-3), "bleeding": (3e-3, 8e-3),
            "angioectasia": (1.5e-3, 3.5e-3), "residue": (0.8e-3, 3.0e-3), "ileocecal valve": (11e-3, 14e-3)}
_LESION_GAP_M = 12e-3  # lesions keep this distance along the wall


@dataclass(frozen=True)
class Mark:
    """One patch of wall."""

    label: str
    kind: str
    """"finding", "landmark" or "distractor"."""
    row_m: float
    """Material coordinate of its centre along the unrolled wall."""
    theta_rad: float
    """Angle of its centre around the lumen."""
    radius_m: float
    height_m: float
    """How far its middle reaches into the lumen; negative for a crater."""
    tone: float
    """In [0, 1]: how strong its colour is, and the seed of its pattern."""


def draw_lesions(organ: Organ, span_m: tuple[float, float], rng: np.random.Generator) -> list[Mark]:
    """Lesions within a span of the unrolled wall, sorted along it, none upon another."""
    count = int(rng.poisson(organ.lesions_per_m * (span_m[1] - span_m[0])))
    places = np.sort(rng.uniform(*span_m, max(count, 1)))
    marks: list[Mark] = []
    for place in places:
        label = str(rng.choice(organ.lesion_kinds))
        radius = float(rng.uniform(*_SIZES_M[label]))
        share = {"polyp": rng.uniform(0.6, 1.0), "ulcer": -rng.uniform(0.10, 0.22)}.get(label, 0.0)
        theta, tone = float(rng.uniform(0, TAU)), float(rng.uniform(0.5, 1.0))
        if not marks or place - marks[-1].row_m > _LESION_GAP_M:
            marks.append(Mark(label, "finding", float(place), theta, radius, float(share * radius), tone))
    return marks


def draw_residue(organ: Organ, span_m: tuple[float, float], rng: np.random.Generator) -> list[Mark]:
    """Lumps of food residue on the wall, what a capsule collides with and what hides mucosa."""
    count = int(rng.poisson(organ.look.debris * (span_m[1] - span_m[0])))
    radius = rng.uniform(*_SIZES_M["residue"], count) * rng.uniform(0.4, 1.0, count)
    place, theta = rng.uniform(*span_m, count), rng.uniform(0, TAU, count)
    height, tone = radius * rng.uniform(0.15, 0.45, count), rng.uniform(0.3, 1.0, count)
    rows = np.column_stack([place, theta, radius, height, tone])
    return [Mark("residue", "distractor", *(float(v) for v in row)) for row in rows]


def draw_landmarks(organ: Organ, wall_length_m: float, rng: np.random.Generator) -> list[Mark]:
    """The openings of an organ: at its poles, but the ileocecal valve of the colon on its side wall near the cecum."""
    marks = []
    for end, label in enumerate(organ.landmarks):
        if label is None:
            continue
        if label == "ileocecal valve" and end == 0:
            radius = float(rng.uniform(*_SIZES_M[label]))
            marks.append(Mark(label, "landmark", 0.075, float(rng.uniform(0, TAU)), radius, 0.42 * radius, 0.8))
        else:
            radius = 0.30 * organ.radius_m
            marks.append(Mark(label, "landmark", end * wall_length_m, 0.0, radius, -0.25 * radius, 0.9))
    return marks


def relief(mark: Mark, along: Array, around: Array) -> Array:
    """How far the wall reaches into the lumen (...) [m] at places (...) [m] along and around from its centre."""
    d = np.hypot(along, around) / mark.radius_m
    inside = np.clip(1 - d * d, 0, None)
    shape = inside
    if mark.label == "ileocecal valve" and mark.height_m > 0:  # two lips with a slit across the lumen's axis
        shape = inside**0.75 * np.exp(-(((np.abs(along) / mark.radius_m - 0.28) / 0.22) ** 2))
    elif mark.label == "polyp":
        shape = inside**0.6
    elif mark.label == "ulcer":  # a crater with a raised rim
        shape = np.clip(1 - d * d / 0.75, 0, None) - 0.45 * np.exp(-(((d - 0.95) / 0.22) ** 2))
    out: Array = mark.height_m * shape
    return out


_BLOOD = np.array([0.35, 2.3, 2.1])
_FIBRIN = np.array([-0.25, -0.85, -0.75])  # lighter than mucosa
_BROWN = np.array([0.75, 0.95, 1.7])


def stain(mark: Mark, along: Array, around: Array) -> Array:
    """Optical density (..., 3) that the mark adds, R, G, B, at places as in `relief`."""
    d, angle = np.hypot(along, around) / mark.radius_m, np.arctan2(around, along)
    return _opening(mark, d, along) if mark.kind == "landmark" else _STAINS[mark.label](mark, d, angle)


def _opening(mark: Mark, d: Array, along: Array) -> Array:
    """A slit between two pale lips, or a dark hole with a red ring."""
    if mark.height_m > 0:
        slit = np.exp(-((along / (0.06 * mark.radius_m)) ** 2))[..., None]
        return np.asarray(_edge(d, 1.0, 0.12)[..., None] * (np.array([-0.10, -0.05, 0.30]) + 0.8 * slit * _BLOOD))
    ring = np.exp(-(((d - 1.1) / 0.25) ** 2))[..., None]
    return np.asarray(2.6 * _edge(d, 0.75, 0.2)[..., None] * np.ones(3) + ring * np.array([0.05, 0.35, 0.3]))


def _polyp(mark: Mark, d: Array, angle: Array) -> Array:
    """Redder than the mucosa around, in patches."""
    spin = _spin(mark)
    patches = 0.5 + 0.5 * np.sin(5 * angle + spin) * np.sin(7 * d + spin)
    colour = np.array([0.02, 0.30, 0.22]) + patches[..., None] * np.array([0.02, 0.22, 0.18])
    return np.asarray(_edge(d, 1.0, 0.12)[..., None] * mark.tone * colour)


def _ulcer(mark: Mark, d: Array, angle: Array) -> Array:
    """A pale bed of fibrin in a red halo."""
    halo = np.exp(-(((d - 1.05) / 0.28) ** 2))[..., None]
    return np.asarray(0.9 * _edge(d, 0.72, 0.12)[..., None] * _FIBRIN + 0.30 * mark.tone * halo * _BLOOD)


def _angioectasia(mark: Mark, d: Array, angle: Array) -> Array:
    """A flat red spot of radiating vessels."""
    rays = (0.55 + 0.45 * np.cos(7 * angle + _spin(mark) + 2.5 * d)) * (d > 0.25)
    return np.asarray(_edge(d, 0.95, 0.35)[..., None] * mark.tone * (0.35 + 0.65 * rays)[..., None] * 0.62 * _BLOOD)


def _bleeding(mark: Mark, d: Array, angle: Array) -> Array:
    """A pool of blood with a ragged edge."""
    spin = _spin(mark)
    ragged = 1 + 0.25 * np.sin(3 * angle + spin) + 0.15 * np.sin(7 * angle + 2 * spin)
    return np.asarray(0.95 * mark.tone * _edge(d * ragged, 0.85, 0.18)[..., None] * _BLOOD)


def _residue(mark: Mark, d: Array, angle: Array) -> Array:
    """Brown."""
    return np.asarray(_edge(d, 1.0, 0.12)[..., None] * mark.tone * _BROWN)


_STAINS = {"polyp": _polyp, "ulcer": _ulcer, "angioectasia": _angioectasia, "bleeding": _bleeding, "residue": _residue}


def _spin(mark: Mark) -> float:
    """An angle of the mark's own, so that patterns differ."""
    return TAU * 7.3 * mark.tone


def _edge(d: Array, at: float, width: float) -> Array:
    """1 inside `at`, 0 outside, smooth over about `width`."""
    out: Array = 1 / (1 + np.exp(np.clip((d - at) / (0.25 * width), -40, 40)))
    return out
