"""Truth about lesions and landmarks: where they are, and which frames see them."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio.simulation.anatomy import Anatomy
from vio.simulation.marks import Mark
from vio.simulation.wall import COLUMNS, ROW_M, TAU

Array = NDArray[np.float64]
Field = NDArray[np.float32]

FEWEST_PIXELS = 12
"""A mark is seen when at least this many pixels show it."""

_TRUTH_COLUMNS = ("id", "label", "kind", "x_mm", "y_mm", "z_mm", "arc_length_mm", "radius_mm", "frames_seen",
                  "first_frame", "last_frame", "best_frame", "best_timestamp_s", "best_u", "best_v")
_SIGHTING_COLUMNS = ("mark", "label", "kind", "frame", "u", "v", "pixels", "x_mm", "y_mm", "z_mm")


@dataclass(frozen=True)
class Sighting:
    """One mark in one frame."""

    mark: int
    """Its index in `known_marks`."""
    frame: int
    timestamp_s: float
    u: float
    v: float
    """Pixel that shows the mark nearest to its centre."""
    pixels: int
    """How many pixels show it."""
    position_m: tuple[float, float, float]
    """World position of the wall at that pixel, at that time."""


def known_marks(anatomy: Anatomy) -> tuple[Mark, ...]:
    """Lesions and landmarks in their order along the organ; the index is the mark's number."""
    return tuple(sorted((*anatomy.wall.lesions, *anatomy.wall.landmarks), key=lambda mark: mark.row_m))


def find_sightings(marks: Sequence[Mark], frame: int, timestamp_s: float, row: Field, column: Field, distance_m: Field,
                   rays: Array, T_world_camera: Array, radius_m: float, wall_length_m: float) -> list[Sighting]:
    """Marks that a frame shows.

    Args:
        marks: of `known_marks`.
        frame, timestamp_s: which frame it is.
        row, column, distance_m: (H, W) material address and distance of what each pixel sees; distance 0 = nothing.
        rays: (H, W, 3) unit rays in camera axes.
        T_world_camera: (4, 4).
        radius_m: of the lumen, which turns angles into distances on the wall.
        wall_length_m: of the wall's meridian: marks at its ends are seen from all around.
    """
    seen = distance_m > 0
    if not seen.any():
        return []
    low, high = float(row[seen].min()) * ROW_M, float(row[seen].max()) * ROW_M
    found = []
    for k, mark in enumerate(marks):
        if not low - mark.radius_m < mark.row_m < high + mark.radius_m:
            continue
        along = row * np.float32(ROW_M) - np.float32(mark.row_m)
        turn = column * np.float32(TAU / COLUMNS) - np.float32(mark.theta_rad)
        around = (turn - TAU * np.round(turn / TAU)) * radius_m
        if mark.row_m <= 0 or mark.row_m >= wall_length_m:
            around = np.zeros_like(around)
        apart = np.where(seen, np.hypot(along, around), np.inf)
        pixels = int((apart < mark.radius_m).sum())
        if pixels < FEWEST_PIXELS:
            continue
        v, u = np.unravel_index(int(np.argmin(apart)), apart.shape)
        point = T_world_camera[:3, :3] @ (rays[v, u] * float(distance_m[v, u])) + T_world_camera[:3, 3]
        found.append(Sighting(k, frame, timestamp_s, float(u), float(v), pixels,
                              (float(point[0]), float(point[1]), float(point[2]))))
    return found


def write_marks(folder: Path, anatomy: Anatomy, sightings: Iterable[Sighting]) -> None:
    """Write `lesions.csv`, the truth about every mark that was seen, and `lesion_sightings.csv`, one row per frame.

    The second is what `capsule-vio locate` takes; its `mark` is the `id` of the first.
    """
    marks = known_marks(anatomy)
    by_mark: dict[int, list[Sighting]] = {}
    for sighting in sorted(sightings, key=lambda s: (s.mark, s.frame)):
        by_mark.setdefault(sighting.mark, []).append(sighting)
    truth, rows = [], []
    for k, seen in by_mark.items():
        mark, best = marks[k], max(seen, key=lambda s: (s.pixels, -s.frame))
        arc, position = _at_rest(anatomy, mark)
        truth.append([k, mark.label, mark.kind, *(_mm(x) for x in position), _mm(arc), _mm(mark.radius_m), len(seen),
                      seen[0].frame, seen[-1].frame, best.frame, f"{best.timestamp_s:.6f}", int(best.u), int(best.v)])
        rows += [[k, mark.label, mark.kind, s.frame, int(s.u), int(s.v), s.pixels, *(_mm(x) for x in s.position_m)]
                 for s in seen]
    _write_table(folder / "lesions.csv", _TRUTH_COLUMNS, truth)
    _write_table(folder / "lesion_sightings.csv", _SIGHTING_COLUMNS, sorted(rows, key=lambda r: (r[3], r[0])))


def _at_rest(anatomy: Anatomy, mark: Mark) -> tuple[float, Array]:
    """Arc length along the centreline [m] and world position (3,) [m] of a mark's centre on the wall at rest."""
    row = np.clip(np.array([mark.row_m / ROW_M]), 0, anatomy.wall.rows - 1)
    arc = anatomy.wall.arc_at(row)
    first = int(min(row[0], anatomy.wall.rows - 2))
    radius = anatomy.wall.radius_m(first, first + 1)[0, round(mark.theta_rad / TAU * COLUMNS) % COLUMNS]
    across = anatomy.centreline.frame(arc).as_matrix()[0, :, 1:]
    outward = across @ [np.cos(mark.theta_rad), np.sin(mark.theta_rad)]
    return float(arc[0]), anatomy.centreline.position_m(arc)[0] + float(radius) * outward


def _mm(value: float) -> str:
    return f"{1e3 * value:.3f}"


def _write_table(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
