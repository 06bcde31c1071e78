"""The folds of an organ's wall: how far each point of the unrolled wall reaches into the lumen.

Three kinds: haustral (colon: crescents between three taeniae), circular (small bowel: plicae), rugae (stomach:
wandering ridges along it). Folds are laid out once for the whole organ; any stretch of wall can then be made alone.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from vio.simulation.noise_fields import BandNoise, Field
from vio.simulation.organs import Organ

Array = NDArray[np.float64]

TAU = 2 * np.pi


class Folds(Protocol):
    """Turns a smooth radius into a folded one."""

    def apply(self, radius_m: Field, first_row: int, row_m: float) -> Field:
        """Radius (k, m) [m] of rows from `first_row` on, folded; rows near the cut are affected by the cut."""
        ...


class HaustralFolds:
    """A triangular lumen (taeniae), and staggered crescents between them with bulges (haustra) behind."""

    def __init__(self, organ: Organ, wall_length_m: float, columns: int, seed: tuple[int, ...]) -> None:
        rng = np.random.default_rng([*seed, 1])
        self._mm = 1e3 * organ.radius_m
        self._theta = np.arange(columns) / columns * TAU
        self._phase, self._turn = rng.uniform(0, TAU, 2)
        rows = []
        for k in range(3):
            at = rng.uniform(0, 20)
            while at < 1e3 * wall_length_m:
                rows.append([at, rng.uniform(2.1, 3.0), self._mm * rng.uniform(0.24, 0.46),
                             self._phase + k * TAU / 3 + rng.normal(0, 0.18), rng.uniform(1.25, 1.9),
                             rng.normal(0, 1.6), rng.normal(0, 0.9)])
                at += rng.uniform(17, 32)
        self._folds = np.array(rows)

    def apply(self, radius_m: Field, first_row: int, row_m: float) -> Field:
        """See `Folds`."""
        at_mm = 1e3 * row_m * (first_row + np.arange(len(radius_m)))
        triangle = 0.5 + 0.5 * np.cos(3 * (self._theta[None] - self._turn + 6e-4 * at_mm[:, None]))
        depth = np.zeros_like(radius_m)
        reach = 14.0
        near = (self._folds[:, 0] > at_mm[0] - reach) & (self._folds[:, 0] < at_mm[-1] + reach)
        for x, width, height, theta0, span, tilt, skew in self._folds[near]:
            part = slice(*np.searchsorted(at_mm, [x - reach, x + reach]))
            d = np.angle(np.exp(1j * (self._theta - theta0)))[None]
            profile = np.exp(-(((at_mm[part, None] - x - tilt * d - skew * d * d) / width) ** 2))
            np.maximum(depth[part], height * profile * _window(d, span, 0.6), out=depth[part])
        bulge = gaussian_filter(depth, (9e-3 / row_m, 8), mode=("nearest", "wrap"))
        out: Field = (radius_m * (1 - 0.11 * (1 - triangle)) - 1e-3 * (depth - 0.9 * bulge)).astype(np.float32)
        return out


class CircularFolds:
    """Wobbling circular folds a few millimetres apart, and fine relief."""

    def __init__(self, organ: Organ, wall_length_m: float, columns: int, row_m: float, seed: tuple[int, ...]) -> None:
        rng = np.random.default_rng([*seed, 1])
        self._theta = np.arange(columns) / columns * TAU
        count = int(np.ceil(1e3 * wall_length_m / 3.5))
        at = np.cumsum(rng.uniform(3.5, 6.5, count))
        self._folds = np.column_stack([at, rng.uniform(0, TAU, count), rng.uniform(1.4, 3.3, count),
                                       rng.normal(0, 0.9, count), rng.uniform(0.9, 1.3, count),
                                       rng.uniform(1.3, 3.0, count)])[at < 1e3 * wall_length_m]
        pixel = (row_m, TAU * organ.radius_m / columns)
        self._wobble = BandNoise((*seed, 2), columns, pixel, 8e-3, 60e-3)
        self._relief = BandNoise((*seed, 3), columns, pixel, 3.5e-3, 12e-3)

    def apply(self, radius_m: Field, first_row: int, row_m: float) -> Field:
        """See `Folds`."""
        last_row = first_row + len(radius_m)
        at_mm = 1e3 * row_m * np.arange(first_row, last_row)
        wobble = 1.1 * self._wobble.rows(first_row, last_row)
        depth = np.zeros_like(radius_m)
        reach = 9.0
        near = (self._folds[:, 0] > at_mm[0] - reach) & (self._folds[:, 0] < at_mm[-1] + reach)
        for x, theta0, span, tilt, width, height in self._folds[near]:
            part = slice(*np.searchsorted(at_mm, [x - reach, x + reach]))
            d = np.angle(np.exp(1j * (self._theta - theta0)))[None]
            profile = np.exp(-(((at_mm[part, None] - x - wobble[part] - tilt * d) / width) ** 2))
            np.maximum(depth[part], height * profile * _window(d, span, 0.5), out=depth[part])
        out: Field = (radius_m + 1e-3 * (0.35 * self._relief.rows(first_row, last_row) - depth)).astype(np.float32)
        return out


class Rugae:
    """Seven ridges along the organ that wander and fade."""

    def __init__(self, organ: Organ, columns: int, row_m: float, seed: tuple[int, ...]) -> None:
        self._theta = np.arange(columns) / columns * TAU
        pixel = (row_m, TAU * organ.radius_m / columns)
        self._wander = BandNoise((*seed, 2), columns, pixel, 25e-3, 120e-3)
        self._fade = BandNoise((*seed, 3), columns, pixel, 40e-3, 160e-3)
        self._relief = BandNoise((*seed, 4), columns, pixel, 10e-3, 50e-3)

    def apply(self, radius_m: Field, first_row: int, row_m: float) -> Field:
        """See `Folds`."""
        rows = (first_row, first_row + len(radius_m))
        phase = 0.5 * (7 * self._theta[None] + 2.2 * self._wander.rows(*rows))
        fade = np.clip(0.5 + 0.6 * self._fade.rows(*rows), 0, 1)
        ridge = 4.6 * fade * np.exp(-((np.sin(phase) / 0.42) ** 2))
        out: Field = (radius_m + 1e-3 * (1.2 * self._relief.rows(*rows) - ridge)).astype(np.float32)
        return out


def make_folds(organ: Organ, wall_length_m: float, columns: int, row_m: float, seed: tuple[int, ...]) -> Folds:
    """The folds of an organ whose unrolled wall is `wall_length_m` long."""
    if organ.folds == "haustral":
        return HaustralFolds(organ, wall_length_m, columns, seed)
    if organ.folds == "circular":
        return CircularFolds(organ, wall_length_m, columns, row_m, seed)
    return Rugae(organ, columns, row_m, seed)


def _window(d: Array, span: float, power: float) -> Array:
    """Smooth window (1, m) of a fold that covers part of the circumference; a full ring when span ≥ 3."""
    if span >= 3:
        return np.ones_like(d)
    out: Array = np.clip(0.5 + 0.5 * np.cos(np.clip(d / span, -1, 1) * np.pi), 0, 1) ** power
    return out
