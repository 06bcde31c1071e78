"""Blood vessels of the mucosa: branching random walks on the unrolled wall."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vio.simulation.noise_fields import Field

_STEP_TEXELS = 5.0
_GENERATIONS = 6

Branch = tuple[NDArray[np.float64], float]
"""Points (k, 2) [texels]: around, along; and the width in texels."""


def grow(rng: np.random.Generator, trees: int, rows: int, columns: int, texel_m: float) -> list[Branch]:
    """Trees rooted at random in `rows` x `columns` texels; they reach less than 70 mm beyond."""
    texels_per_mm = 1e-3 / texel_m
    branches: list[Branch] = []
    live = [(rng.uniform(0, columns), rng.uniform(0, rows), rng.uniform(0, 2 * np.pi),
             rng.uniform(0.25, 0.55) * texels_per_mm, 0) for _ in range(trees)]
    while live:
        x, y, heading, width, generation = live.pop()
        steps = int(rng.uniform(5, 14) * texels_per_mm * 0.8**generation * 1.3 / _STEP_TEXELS) + 2
        headings = heading + np.cumsum(rng.normal(0, 0.16, steps))
        walk = _STEP_TEXELS * np.cumsum(np.column_stack([np.cos(headings), np.sin(headings)]), axis=0)
        points = np.vstack([[x, y], walk + np.array([x, y])])
        branches.append((points, width))
        if generation < _GENERATIONS - 1 and width > 0.7:
            for sign in (-1, 1):
                if rng.random() < 0.88:
                    turn = headings[-1] + sign * rng.uniform(0.25, 0.75)
                    live.append((*points[-1], turn, width * rng.uniform(0.6, 0.8), generation + 1))
    return branches


def paint(branches: list[Branch], first_row: float, rows: int, columns: int) -> Field:
    """Vessel density in [0, 1] on rows from `first_row` on; trees wrap around the lumen."""
    canvas = np.zeros((rows, columns), np.float32)
    for points, width in branches:
        along = points[:, 1] - first_row
        if along.max() < -8 or along.min() > rows + 8:
            continue
        shade, thickness = float(min(1.0, 0.35 + 0.16 * width)), max(1, round(width))
        around = points[:, 0]
        for turn in range(int(np.floor(around.min() / columns)), int(np.floor(around.max() / columns)) + 1):
            line = np.column_stack([around - turn * columns, along])
            fixed = np.round(line * 16).astype(np.int32)[:, None]  # 4 fractional bits
            cv2.polylines(canvas, [fixed], False, shade, thickness, cv2.LINE_AA, 4)
    smooth: Field = cv2.GaussianBlur(canvas, (0, 0), 0.8)
    return smooth
