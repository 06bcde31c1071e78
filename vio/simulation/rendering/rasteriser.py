"""Which wall point every pixel sees: a z-buffer over the wall's grid with exact ray-triangle tests.

Vertices are projected with the camera's own model only to bound the pixels of a triangle; inside the bound the exact
ray of each pixel is intersected with it (Möller and Trumbore 1997). So depth is exact for any camera that has rays, and
nothing has to be rebuilt when the wall moves. The material address (row, column) comes out of the same test.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vio.simulation.rendering.lens import project_point

Array = NDArray[np.float64]

MISS = 1e9
CELL_COLUMNS = 8
"""Columns of the wall that are switched on and off together."""
_SLACK_PIXELS = 0.05
_CURVED = 0.06  # share of a triangle's extent by which a lens may bend its edges outward
_LARGE_PIXELS, _LARGE_CURVED = 24.0, 0.5  # the same for one so near that it reaches around the lens


@njit(cache=True, nogil=True)
def wall_vertices(centre: Array, across: Array, radius: Array, R: Array, p: Array, out: Array) -> None:
    """Vertices (k, m, 3) in camera axes of a wall stretch, into `out`.

    Args:
        centre: (k, 3) world positions of the rows' centres.
        across: (k, 2, 3) directions across the lumen.
        radius: (k, m).
        R, p: (3, 3), (3,) pose of the camera in the world.
    """
    k, m = radius.shape
    cos, sin = np.cos(2 * math.pi / m * np.arange(m)), np.sin(2 * math.pi / m * np.arange(m))
    for i in range(k):
        base = np.zeros(3)
        u = np.zeros(3)
        v = np.zeros(3)
        for c in range(3):
            for w in range(3):
                base[c] += (centre[i, w] - p[w]) * R[w, c]
                u[c] += across[i, 0, w] * R[w, c]
                v[c] += across[i, 1, w] * R[w, c]
        for j in range(m):
            a, b = cos[j] * radius[i, j], sin[j] * radius[i, j]
            for c in range(3):
                out[i, j, c] = base[c] + a * u[c] + b * v[c]


@njit(cache=True, nogil=True, error_model="numpy")
def project_vertices(V: Array, lens: Array, pixel: NDArray[np.float32], seen: NDArray[np.bool_]) -> None:
    """Pixels (k, m, 2) of vertices (k, m, 3) in camera axes, and which (k, m) the lens can see; both filled in."""
    k, m, _ = V.shape
    for i in range(k):
        for j in range(m):
            u, v, ok = project_point(V[i, j, 0], V[i, j, 1], V[i, j, 2], lens)
            pixel[i, j, 0], pixel[i, j, 1] = u, v
            seen[i, j] = ok


@njit(cache=True, inline="always")
def _slack(extent: float) -> float:
    """Pixels by which a triangle of some extent may bulge out of the box around its vertices."""
    return _SLACK_PIXELS + extent * (_LARGE_CURVED if extent > _LARGE_PIXELS else _CURVED)


@njit(cache=True, inline="always")
def _cell_matters(pixel: NDArray[np.float32], i: int, j: int, j1: int, fine: int, shift: float,
                  wanted: NDArray[np.bool_]) -> bool:
    """Whether a wanted pixel may lie on the cell of four vertices; most far cells are smaller than a pixel."""
    ua, ub, uc, ud = pixel[i, j, 0], pixel[i + 1, j, 0], pixel[i, j1, 0], pixel[i + 1, j1, 0]
    va, vb, vc, vd = pixel[i, j, 1], pixel[i + 1, j, 1], pixel[i, j1, 1], pixel[i + 1, j1, 1]
    left, right = min(ua, ub, uc, ud) * fine + shift, max(ua, ub, uc, ud) * fine + shift
    top, bottom = min(va, vb, vc, vd) * fine + shift, max(va, vb, vc, vd) * fine + shift
    slack = _slack(max(right - left, bottom - top))
    x0, x1 = max(0, math.ceil(left - slack)), min(wanted.shape[1] - 1, math.floor(right + slack))
    y0, y1 = max(0, math.ceil(top - slack)), min(wanted.shape[0] - 1, math.floor(bottom + slack))
    if x1 - x0 > 8 or y1 - y0 > 8:
        return True
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            if wanted[y, x]:
                return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def rasterise(V: Array, pixel: NDArray[np.float32], seen: NDArray[np.bool_], cells: NDArray[np.bool_], fine: int,
              rays: Array, wanted: NDArray[np.bool_], distance: Array, row: Array, column: Array) -> None:
    """Nearest hit of every wanted pixel's ray with the triangles of a grid that closes in its second direction.

    Triangles are seen from inside only: the back of a fold is hidden by its front.

    Args:
        V: (k, m, 3) vertices in camera axes [m].
        pixel, seen: of `project_vertices`.
        cells: (k, m / `CELL_COLUMNS`) which stretches of every row of cells to draw.
        fine: 1, or 2 where the rays are those of the image at twice the size.
        rays: (H, W, 3) unit rays.
        wanted: (H, W) pixels to fill; the others are left as they are.
        distance: (H, W) distance along the ray [m], `MISS` where nothing is hit.
        row, column: (H, W) fractional vertex indices of the hit.
    """
    k, m, _ = V.shape
    H, W, _ = rays.shape
    for y in range(H):
        for x in range(W):
            if wanted[y, x]:
                distance[y, x], row[y, x], column[y, x] = MISS, 0.0, 0.0
    shift = 0.5 * (fine - 1)
    for i in range(k - 1):
        for j in range(m):
            if not cells[i, j // CELL_COLUMNS]:
                continue
            j1 = j + 1 if j + 1 < m else 0
            if not _cell_matters(pixel, i, j, j1, fine, shift, wanted):
                continue
            for half in range(2):
                if half == 0:
                    ia, ja, ib, jb, ic, jc = i, j, i + 1, j, i, j1
                else:
                    ia, ja, ib, jb, ic, jc = i + 1, j1, i, j1, i + 1, j
                if not (seen[ia, ja] and seen[ib, jb] and seen[ic, jc]):
                    continue
                ua, ub, uc = pixel[ia, ja, 0], pixel[ib, jb, 0], pixel[ic, jc, 0]
                va, vb, vc = pixel[ia, ja, 1], pixel[ib, jb, 1], pixel[ic, jc, 1]
                left, right = min(ua, ub, uc) * fine + shift, max(ua, ub, uc) * fine + shift
                top, bottom = min(va, vb, vc) * fine + shift, max(va, vb, vc) * fine + shift
                slack = _slack(max(right - left, bottom - top))
                x0, x1 = max(0, math.ceil(left - slack)), min(W - 1, math.floor(right + slack))
                y0, y1 = max(0, math.ceil(top - slack)), min(H - 1, math.floor(bottom + slack))
                if x1 < x0 or y1 < y0:
                    continue
                ax, ay, az = V[ia, ja, 0], V[ia, ja, 1], V[ia, ja, 2]
                ex, ey, ez = V[ib, jb, 0] - ax, V[ib, jb, 1] - ay, V[ib, jb, 2] - az
                fx, fy, fz = V[ic, jc, 0] - ax, V[ic, jc, 1] - ay, V[ic, jc, 2] - az
                qx, qy, qz = -ay * ez + az * ey, -az * ex + ax * ez, -ax * ey + ay * ex
                tq = fx * qx + fy * qy + fz * qz
                if tq <= 0.0:
                    continue
                for y in range(y0, y1 + 1):
                    for x in range(x0, x1 + 1):
                        if not wanted[y, x]:
                            continue
                        dx, dy, dz = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
                        px, py, pz = dy * fz - dz * fy, dz * fx - dx * fz, dx * fy - dy * fx
                        det = ex * px + ey * py + ez * pz
                        if det <= 0.0:
                            continue
                        inverse = 1.0 / det
                        a = -(ax * px + ay * py + az * pz) * inverse
                        if a < -1e-9 or a > 1 + 1e-9:
                            continue
                        b = (dx * qx + dy * qy + dz * qz) * inverse
                        if b < -1e-9 or a + b > 1 + 2e-9:
                            continue
                        t = tq * inverse
                        if 1e-9 < t < distance[y, x]:
                            distance[y, x] = t
                            if half == 0:
                                row[y, x], column[y, x] = i + a, j + b
                            else:
                                row[y, x], column[y, x] = i + 1 - a, j + 1 - b
