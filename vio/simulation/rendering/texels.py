"""Texels in memory: eight 16-bit numbers each, in sections with mip levels, in a fixed number of slots.

A texel holds optical density R, G, B; slopes of the tissue's relief along and around; slopes of the wet film along and
around; foam; all as counts of `UNIT`. Sections stay where they were written: looking further along the wall copies
nothing, and memory never grows.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vio.simulation.noise_fields import Field

LEVELS = 4
CHANNELS = 8
SECTION_BITS = 10
SECTION = 1 << SECTION_BITS
"""Texels of a section along the wall."""
UNIT = 1 / 4096
"""One count; the largest value is 8."""

Texels = NDArray[np.int16]


class TexelStore:
    """Slots that hold the most recent sections.

    Args:
        slots: how many sections are kept.
        columns: texels around the wall, a multiple of `2**LEVELS`.
    """

    def __init__(self, slots: int, columns: int) -> None:
        self._slots = slots
        self._slot_of: OrderedDict[int, int] = OrderedDict()
        self.levels: tuple[Texels, ...] = tuple(
            np.zeros((slots * (SECTION >> level), columns >> level, CHANNELS), np.int16) for level in range(LEVELS))
        """Per mip level all slots, one below the other."""

    def slots(self, sections: range, make: Callable[[int], Texels]) -> NDArray[np.int64]:
        """Slot of every wanted section, which are fewer than the slots.

        `make(k)` gives the texels (SECTION, columns, 8) of a section that is not kept.
        """
        for k in sections:
            if k not in self._slot_of:
                texels = make(k)
                slot = self._free_slot(sections)
                self._write(slot, texels)
                self._slot_of[k] = slot
            self._slot_of.move_to_end(k)
        return np.array([self._slot_of[k] for k in sections])

    def _free_slot(self, wanted: range) -> int:
        if len(self._slot_of) < self._slots:
            return len(self._slot_of)
        return self._slot_of.pop(next(k for k in self._slot_of if k not in wanted))

    def _write(self, slot: int, texels: Texels) -> None:
        """Level 0 as given, every further level the mean of four texels of the one before."""
        self.levels[0][slot * SECTION: (slot + 1) * SECTION] = texels
        for level in range(1, LEVELS):
            rows = SECTION >> level
            _halve(self.levels[level - 1], 2 * rows * slot, self.levels[level], rows * slot, rows)


@njit(cache=True, nogil=True)
def _halve(finer: Texels, finer_row: int, coarser: Texels, coarser_row: int, rows: int) -> None:
    for i in range(rows):
        y = finer_row + 2 * i
        for j in range(coarser.shape[1]):
            for c in range(8):
                total = (np.int32(finer[y, 2 * j, c]) + np.int32(finer[y, 2 * j + 1, c])
                         + np.int32(finer[y + 1, 2 * j, c]) + np.int32(finer[y + 1, 2 * j + 1, c]))
                coarser[coarser_row + i, j, c] = (total + 2) >> 2


@njit(cache=True, nogil=True)
def pack(tissue: Field, blood: Field, relief_mm: Field, film_mm: Field, foam: Field, tints: Field, texel_mm: float,
         halo: int, out: Texels) -> None:
    """Fields (rows, columns) as texels (rows - 2 halo, columns, 8), filled in; heights become slopes.

    Args:
        tissue, blood: optical densities, coloured by the rows of `tints` (2, 3).
        relief_mm, film_mm: heights; their columns close on themselves.
        foam: 0 to 1.
        texel_mm: distance of two texels.
        halo: rows that are cut off at both ends.
        out: at least as many rows less.
    """
    rows, columns = tissue.shape
    per_mm = 0.5 / texel_mm
    for i in range(halo, rows - halo):
        for j in range(columns):
            before, after = (j - 1 if j else columns - 1), (j + 1 if j + 1 < columns else 0)
            texel = out[i - halo, j]
            for c in range(3):
                texel[c] = _counts(tissue[i, j] * tints[0, c] + blood[i, j] * tints[1, c])
            texel[3] = _counts((relief_mm[i + 1, j] - relief_mm[i - 1, j]) * per_mm)
            texel[4] = _counts((relief_mm[i, after] - relief_mm[i, before]) * per_mm)
            texel[5] = _counts((film_mm[i + 1, j] - film_mm[i - 1, j]) * per_mm)
            texel[6] = _counts((film_mm[i, after] - film_mm[i, before]) * per_mm)
            texel[7] = _counts(foam[i, j])


@njit(cache=True, inline="always")
def _counts(value: float) -> int:
    return math.floor(min(max(value / UNIT, -32768.0), 32767.0) + 0.5)
