"""The wall of an organ at rest, unrolled: rows along it, columns around it, closed at both ends.

A wall point has a material address (row, column) for good. At rest it lies at
    X = C(s(row)) + r(row, column) (cos θ U(s) + sin θ V(s)),   θ = 2π column / columns,
with the centreline's position C and frame (U, V across the lumen). Rows are equally spaced along the wall's meridian;
near the poles, where the lumen closes, the meridian turns inward and s(row) slows down.
Everything is made in sections when it is asked for, from the seed alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from vio.simulation.folds import make_folds
from vio.simulation.marks import Mark, draw_landmarks, draw_lesions, draw_residue, relief, stain
from vio.simulation.noise_fields import BandNoise, Field, Recent, block_rows
from vio.simulation.organs import Organ

Array = NDArray[np.float64]

TAU = 2 * np.pi
ROW_M = 0.5e-3
COLUMNS = 320
NARROWEST_M = 6.3e-3  # a lumen at rest is never narrower than the capsule
_SECTION = 256
_HALO = 112  # rows made beyond a section and cut off, more than any filter reaches
_SECTIONS_KEPT = 32
_SOFTNESS = {"haustral": 1.2, "circular": 1.1, "rugae": 1.1}  # rows and columns; crests stay round on the grid
_BLOOD_TINT = np.array([0.25, 0.8, 1.0], np.float32)
_BILE_TINT = np.array([0.05, 0.15, 1.1], np.float32)


class Wall:
    """Radius, colour and texture shift of every wall point at rest.

    Args:
        organ: which organ.
        seed: the same seed gives the same wall.
    """

    def __init__(self, organ: Organ, seed: tuple[int, ...]) -> None:
        self.organ = organ
        self.arc_m, self.closing = _meridian(organ)
        self.rows = len(self.arc_m)
        self.length_m = (self.rows - 1) * ROW_M
        rng = np.random.default_rng([*seed, 5])
        self._base = self._slow_variation(rng)
        pixel = (ROW_M, TAU * organ.radius_m / COLUMNS)
        self._shape = BandNoise((*seed, 6), COLUMNS, pixel, 18e-3, 90e-3)
        self._hue = BandNoise((*seed, 7), COLUMNS, pixel, 12e-3, 80e-3, 1.0)
        self._bile = BandNoise((*seed, 8), COLUMNS, pixel, 8e-3, 50e-3, 1.0)
        self._folds = make_folds(organ, self.length_m, COLUMNS, ROW_M, (*seed, 9))
        inner = (0.06 * self.length_m, 0.94 * self.length_m)
        self.landmarks = tuple(draw_landmarks(organ, self.length_m, rng))
        self.lesions = tuple(self._clear_of_landmarks(draw_lesions(organ, inner, rng)))
        self.residue = tuple(draw_residue(organ, inner, rng))
        self._marks = (*self.residue, *self.lesions, *self.landmarks)
        self._sections: Recent[Field] = Recent(_SECTIONS_KEPT)

    def radius_m(self, first: int, last: int) -> Field:
        """Radius (last - first, columns) [m] at rest."""
        return np.ascontiguousarray(self.maps(first, last)[..., 0])

    def maps(self, first: int, last: int) -> Field:
        """Radius [m], texture shift along the wall [m], and optical density R, G, B: (last - first, columns, 5)."""
        return block_rows(self._sections, _SECTION, first, last, self._section)

    def row_at(self, arc_m: Array) -> Array:
        """Fractional row of the wall (n,) whose centre lies at arc length (n,) [m] of the centreline."""
        return np.asarray(np.interp(arc_m, self.arc_m, np.arange(self.rows)))

    def arc_at(self, row: Array) -> Array:
        """Arc length of the centreline (n,) [m] at fractional rows (n,)."""
        return np.asarray(np.interp(row, np.arange(self.rows), self.arc_m))

    def _slow_variation(self, rng: np.random.Generator) -> Field:
        """Mean radius (rows,) [m] before the ends close."""
        smooth = gaussian_filter1d(rng.standard_normal(self.rows), 40e-3 / ROW_M)
        smooth *= np.sqrt(2 * 40e-3 / ROW_M) * 0.9 * self.organ.radius_variation
        out: Field = (self.organ.radius_m * (1 + smooth)).astype(np.float32)
        return out

    def _clear_of_landmarks(self, lesions: list[Mark]) -> list[Mark]:
        return [mark for mark in lesions if all(abs(mark.row_m - other.row_m) > other.radius_m + 10e-3
                                                for other in self.landmarks)]

    def _section(self, k: int) -> Field:
        """Rows of section k as in `maps`; rows beyond the poles repeat the pole."""
        first, last = k * _SECTION - _HALO, (k + 1) * _SECTION + _HALO
        rows = np.arange(first, last)
        inside = np.clip(rows, 0, self.rows - 1)
        radius = self._base[inside][:, None] * (1 + 0.05 * self._shape.rows(first, last))
        radius = np.maximum(self._folds.apply(radius.astype(np.float32), first, ROW_M), np.float32(NARROWEST_M))
        density = self._density(first, last)
        self._apply_marks(rows, radius, density)
        soft = gaussian_filter(radius, _SOFTNESS[self.organ.folds], mode=("nearest", "wrap"))
        radius = soft * self.closing[inside][:, None]
        shift = self._texture_shift(radius)
        maps = np.concatenate([radius[..., None], shift[..., None], density], axis=-1).astype(np.float32)
        return maps[_HALO:-_HALO]

    def _texture_shift(self, radius: Field) -> Field:
        """How far textures are shifted along the wall, so that they do not smear on steep faces of folds [m].

        High-passed length of the meridian; none where folds are so close that the shift would fold back.
        """
        share = {"haustral": 0.8, "circular": 0.0, "rugae": 0.5}[self.organ.folds]
        if share == 0.0:
            return np.zeros_like(radius)
        slope = np.gradient(radius, ROW_M, axis=0)
        extra = np.cumsum(np.sqrt(1 + slope * slope) - 1, axis=0) * ROW_M
        high = extra - gaussian_filter1d(extra, 20, axis=0, mode="nearest")
        out: Field = np.float32(share) * gaussian_filter(high, (2, 3), mode=("nearest", "wrap"))
        return out

    def _density(self, first: int, last: int) -> Field:
        """Slow colour variation and bile: optical density (k, columns, 3)."""
        density = 0.22 * self._hue.rows(first, last)[..., None] * _BLOOD_TINT
        if self.organ.look.bile:
            film = np.clip(2 * self.organ.look.bile * self._bile.rows(first, last) - 0.35, 0, 1)
            density = density + film[..., None] * _BILE_TINT
        return density.astype(np.float32)

    def _apply_marks(self, rows: NDArray[np.intp], radius: Field, density: Field) -> None:
        """Raise and stain the wall in place where marks lie."""
        along_m = rows * ROW_M
        for mark in self._marks:
            at_pole = mark.row_m <= 0 or mark.row_m >= self.length_m
            reach = 1.8 * mark.radius_m
            part = slice(*np.searchsorted(along_m, [mark.row_m - reach, mark.row_m + reach]))
            if part.start == part.stop:
                continue
            theta = np.arange(COLUMNS) / COLUMNS * TAU - mark.theta_rad
            around_m = np.angle(np.exp(1j * theta))[None] * radius[part].astype(float)
            if at_pole:
                around_m = np.zeros_like(around_m)
            offset_m = np.broadcast_to((along_m[part] - mark.row_m)[:, None], around_m.shape)
            if not at_pole:
                lift = relief(mark, offset_m, around_m)
                radius[part] = np.where(lift > 0, np.maximum(radius[part] - lift, np.minimum(
                    radius[part], NARROWEST_M)), radius[part] - lift)
            density[part] += stain(mark, offset_m, around_m).astype(np.float32)


def _meridian(organ: Organ) -> tuple[Array, Field]:
    """Arc length of the centreline [m] and share of the full radius, per row: an ellipsoid's cap at both ends."""
    depth = 0.9 * organ.radius_m
    phi = np.linspace(0, np.pi / 2, 4001)
    speed = np.hypot(depth * np.sin(phi), organ.radius_m * np.cos(phi))
    sigma = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(phi))])
    tube = organ.length_m - 2 * depth
    rows = round((2 * sigma[-1] + tube) / ROW_M) + 1
    at = np.linspace(0, 2 * sigma[-1] + tube, rows)
    mirrored = np.minimum(at, at[-1] - at)
    angle = np.interp(mirrored, sigma, phi)
    arc = np.where(mirrored < sigma[-1], depth * (1 - np.cos(angle)), depth + mirrored - sigma[-1])
    arc = np.where(at > 0.5 * at[-1], organ.length_m - arc, arc)
    closing = np.where(mirrored < sigma[-1], np.sin(angle), 1.0)
    return arc, np.maximum(closing, 1e-3).astype(np.float32)
