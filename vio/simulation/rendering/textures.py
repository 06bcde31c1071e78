"""Fine texture of the mucosa on the unrolled wall: vessels, relief, the wet film with its bubbles.

Textures are made in sections from the seed (`texels.py` keeps them, with mip levels, so that far walls neither flicker
nor alias). Everything coarser than a few millimetres lives on the wall's own grid (`vio.simulation.wall`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vio.simulation.anatomy import Anatomy
from vio.simulation.noise_fields import BandNoise, Field, Recent
from vio.simulation.rendering.texels import CHANNELS, LEVELS, SECTION, Texels, TexelStore, pack
from vio.simulation.rendering.vessels import Branch, grow, paint
from vio.simulation.wall import ROW_M, TAU

TEXEL_M = ROW_M / 4
MARGIN_M = 0.03
"""By how much textures may be shifted along the wall."""
_SPARE_SECTIONS = 2  # a capsule that tumbles or goes to and fro needs its neighbours again
_DEEP_VESSELS_PER_M2 = 1400.0
_HALO = 64
_TINTS = np.array([[0.25, 0.8, 1.0], [0.30, 1.0, 0.75]], np.float32)
"""Optical density R, G, B of tissue and of blood."""
_FILM_MM = 0.09


@dataclass(frozen=True)
class TextureWindow:
    """Textures of a stretch of wall."""

    first_m: float
    """Where along the wall its first texel row begins."""
    slots: NDArray[np.int64]
    """Where each of its sections lies in the levels, in sections."""
    levels: tuple[Texels, ...]
    """Of `TexelStore`."""


class Textures:
    """Textures of one anatomy, made where they are looked at.

    Args:
        anatomy: whose wall.
    """

    def __init__(self, anatomy: Anatomy) -> None:
        organ, seed = anatomy.organ, anatomy.seed
        self._organ, self._seed = organ, seed
        step = 2**LEVELS
        self.columns = round(TAU * organ.radius_m / TEXEL_M / step) * step
        fine = (TEXEL_M, TAU * organ.radius_m / self.columns)
        coarse = (4 * fine[0], 4 * fine[1])
        self._mid = BandNoise((*seed, 21), self.columns // 4, coarse, 2.5e-3, 14e-3, 1.0)
        self._film = BandNoise((*seed, 22), self.columns // 4, coarse, 1.5e-3, 9e-3)
        self._fine = BandNoise((*seed, 23), self.columns, fine, 0.35e-3, 1.6e-3, blocks_kept=2)
        grain = {"circular": (0.45e-3, 1.1e-3), "haustral": (0.9e-3, 2.2e-3), "rugae": (1.5e-3, 4e-3)}[organ.folds]
        self._grain = BandNoise((*seed, 24), self.columns, fine, *grain, blocks_kept=2)
        self._trees: tuple[Recent[list[Branch]], Recent[list[Branch]]] = (Recent(4), Recent(4))
        longest_m = 2 * organ.view_m + 2 * organ.radius_m + 2 * MARGIN_M
        self._store = TexelStore(int(np.ceil(longest_m / (SECTION * TEXEL_M))) + 1 + _SPARE_SECTIONS, self.columns)

    def window(self, low_m: float, high_m: float) -> TextureWindow:
        """Textures between two places along the wall [m], at most the organ's view and twice `MARGIN_M` apart."""
        length_m = SECTION * TEXEL_M
        wanted = range(int(np.floor(low_m / length_m)), int(np.floor(high_m / length_m)) + 1)
        slots = self._store.slots(wanted, self._make)
        return TextureWindow(wanted.start * length_m, slots, self._store.levels)

    def _make(self, k: int) -> Texels:
        """Texels (SECTION, columns, 8) of section k."""
        first, rows = k * SECTION - _HALO, SECTION + 2 * _HALO
        look = self._organ.look
        mid, film = (self._coarse(noise, first, rows) for noise in (self._mid, self._film))
        fine, grain = self._fine.rows(first, first + rows), self._grain.rows(first, first + rows)
        surface, deep = self._vessels(k, first, rows)
        tissue, blood = 0.13 * mid + 0.045 * fine, look.vessel_density * (surface + deep)
        if look.villi:
            tissue += 0.10 * np.tanh(-grain)
            relief_mm = look.relief_mm[0] * np.tanh(1.5 * grain) + look.relief_mm[1] * mid
        else:
            share = 0.02 if self._organ.folds == "haustral" else 0.05
            relief_mm = look.relief_mm[0] * fine + look.relief_mm[1] * mid + share * grain
        film_mm, foam = self._bubbles(k, first, _FILM_MM * film)
        texels = np.empty((SECTION, self.columns, CHANNELS), np.int16)
        pack(tissue, blood, relief_mm, film_mm, foam, _TINTS, 1e3 * TEXEL_M, _HALO, texels)
        return texels

    def _coarse(self, noise: BandNoise, first: int, rows: int) -> Field:
        """A field of a quarter of the resolution, interpolated."""
        values = noise.rows(first // 4 - 2, (first + rows) // 4 + 2)
        wrapped = np.concatenate([values[:, -2:], values, values[:, :2]], axis=1)
        large = cv2.resize(wrapped, (4 * wrapped.shape[1], 4 * wrapped.shape[0]), interpolation=cv2.INTER_LINEAR)
        out: Field = large[8: 8 + rows, 8: 8 + self.columns]
        return out

    def _vessels(self, k: int, first: int, rows: int) -> tuple[Field, Field]:
        """Sharp vessels at the surface and blurred ones below it; trees of the neighbouring sections reach in."""
        near = (k - 1, k, k + 1)
        surface = paint([branch for n in near for branch in self._trees[0].get(n, self._surface_trees)], first, rows,
                        self.columns)
        if self._organ.look.villi:
            return cv2.GaussianBlur(surface, (0, 0), 1.5), np.zeros_like(surface)
        halved = [(0.5 * points, 0.5 * width)
                  for n in near for points, width in self._trees[1].get(n, self._deep_trees)]
        deep = cv2.GaussianBlur(paint(halved, first / 2, rows // 2, self.columns // 2), (0, 0), 2.5)
        return surface, 0.8 * cv2.resize(deep, (self.columns, rows), interpolation=cv2.INTER_LINEAR)

    def _surface_trees(self, section: int) -> list[Branch]:
        return self._grown(25, section, self._organ.look.vessels_per_m2)

    def _deep_trees(self, section: int) -> list[Branch]:
        return self._grown(26, section, _DEEP_VESSELS_PER_M2)

    def _grown(self, stream: int, section: int, per_m2: float) -> list[Branch]:
        """Trees that root in a section, in texels from the wall's beginning."""
        rng = np.random.default_rng([*self._seed, stream, section + 1_000_000])
        area_m2 = SECTION * TEXEL_M * TAU * self._organ.radius_m
        grown = grow(rng, int(rng.poisson(per_m2 * area_m2)), SECTION, self.columns, TEXEL_M)
        return [(points + np.array([0.0, section * SECTION]), width) for points, width in grown]

    def _bubbles(self, k: int, first: int, film_mm: Field) -> tuple[Field, Field]:
        """The film with patches of bubbles on it, and where they are."""
        film_mm, foam = film_mm.copy(), np.zeros_like(film_mm)
        around_texel_m = TAU * self._organ.radius_m / self.columns
        for section in (k - 1, k, k + 1):
            rng = np.random.default_rng([*self._seed, 27, section + 1_000_000])
            for _ in range(int(rng.poisson(self._organ.look.foam * SECTION * TEXEL_M))):
                middle = rng.uniform(0, [SECTION * TEXEL_M, TAU * self._organ.radius_m])
                count, spread = int(rng.integers(8, 60)), rng.uniform(1.5e-3, 5e-3)
                places = middle + spread * rng.standard_normal((count, 2))
                for place, radius in zip(places, 1e-3 * rng.uniform(0.25, 1.1, count) ** 1.5, strict=True):
                    texel = (place[0] / TEXEL_M + section * SECTION - first, place[1] / around_texel_m)
                    _stamp_bubble(film_mm, foam, texel, radius / TEXEL_M)
        return film_mm, foam


def _stamp_bubble(film_mm: Field, foam: Field, texel: tuple[float, float], radius_texels: float) -> None:
    """Raise the film to a dome, in place; wraps around the lumen."""
    low, high = int(np.floor(texel[0] - radius_texels)), int(np.ceil(texel[0] + radius_texels)) + 1
    if low < 0 or high > len(film_mm):
        low, high = max(low, 0), min(high, len(film_mm))
        if low >= high:
            return
    columns = np.arange(int(np.floor(texel[1] - radius_texels)), int(np.ceil(texel[1] + radius_texels)) + 1)
    along, around = np.arange(low, high)[:, None] - texel[0], columns[None] - texel[1]
    inside = 1 - (along**2 + around**2) / radius_texels**2
    dome = 0.7e3 * TEXEL_M * radius_texels * np.sqrt(np.clip(inside, 0, None)).astype(np.float32)
    place = (slice(low, high), columns % film_mm.shape[1])
    film_mm[place] = np.maximum(film_mm[place], np.where(inside > 0, dome + 0.1, film_mm[place]))
    foam[place] = np.maximum(foam[place], np.where(inside > 0, np.float32(1.0), np.float32(0.0)))
