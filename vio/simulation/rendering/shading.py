"""How bright the wall looks: near-field LEDs on a wet, translucent mucosa, one point per pixel.

Light model: LEDs with cosine emission and inverse-square fall-off; wrapped diffuse reflection, which stands for light
that scatters below the surface, gated by the geometric cosine so that nothing shines through folds; a highlight of
the GGX form (Walter et al. 2007) on the smoother normal of the wet film; a tinted second bounce. Normals are analytic:
those of the smoothly interpolated wall, tilted by the slopes of the textures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vio.simulation.rendering.rasteriser import MISS
from vio.simulation.rendering.texels import LEVELS, SECTION_BITS, UNIT, Texels
from vio.simulation.rendering.textures import TEXEL_M
from vio.simulation.wall import ROW_M

Array = NDArray[np.float64]
Field = NDArray[np.float32]
F = np.float32

_LED_SIZE_MM2 = 4.0
_WRAP = 0.35
_ROUGHNESS = 0.14
_FOAM_WHITE = 0.10
_DEEPEST_LEVEL = LEVELS - 1

_DISTANCE, _RAY, _NORMAL, _TISSUE, _FILM, _DENSITY, _DULL, _FOAM, _QUANTITIES = 0, 1, 4, 7, 10, 13, 16, 17, 18
"""Rows of what is known of a point; the normals are those of the smooth wall, of the tissue and of the wet film."""


@dataclass(frozen=True)
class Switches:
    """Scales of the effects; 1 is how tissue looks, 0 is without."""

    specular: float
    subsurface: float
    relief: float
    second_bounce: float


@njit(cache=True, inline="always")
def _mix(v00: float, v01: float, v10: float, v11: float, a: float, b: float) -> float:
    """Bilinear: a along rows, b along columns."""
    return (v00 * (1 - b) + v01 * b) * (1 - a) + (v10 * (1 - b) + v11 * b) * a


@njit(cache=True, inline="always")
def _stored(slots: NDArray[np.int64], row: int, bits: int) -> int:
    """Where a row of a window lies in a level whose sections have 2**bits rows."""
    return int((slots[row >> bits] << bits) + (row & ((1 << bits) - 1)))


def shade(distance: Array, row: Array, column: Array, rays: Array, pixel_rad: float, first_row: int,
          centre_step: Array, across: Array, across_step: Array, radius: Array, maps: Field, texels: tuple[Texels, ...],
          slots: NDArray[np.int64], texel_first_m: float, base_radius_m: float, albedo: Array, leds: Array,
          switches: Switches) -> tuple[Field, Field, Field]:
    """Radiance, normal and albedo (n, 3) of wall points; zero where nothing was hit; normals in camera axes, inward.

    Args:
        distance, row, column: (n,) hits of `rasterise`; rows count from the stretch's first row.
        rays: (n, 3) unit rays in camera axes.
        pixel_rad: angle that one pixel spans.
        first_row: of the stretch, in rows of the wall.
        centre_step, across, across_step: (k, 3), (k, 2, 3), (k, 2, 3) centre change per row, directions across the
            lumen and their change per row, in camera axes.
        radius: (k, m) [m] as it is now.
        maps: (k, m, 5) of `Wall.maps`.
        texels, slots: levels and slots of `TextureWindow`.
        texel_first_m: where along the wall they begin.
        base_radius_m: radius at which a texel is as wide as it is long.
        albedo: (3,) of bare mucosa.
        leds: (n, 3) positions in camera axes [m].
        switches: scales of the effects.
    """
    points = np.empty((_QUANTITIES, len(distance)), np.float32)
    _points(distance, row, column, rays, pixel_rad, first_row, centre_step, across, across_step, radius, maps, texels,
            slots, texel_first_m, base_radius_m, switches.relief, points)
    light = np.zeros((2, len(distance)), np.float32)
    _light(points, np.ascontiguousarray(leds.T, np.float32), np.float32(_WRAP * switches.subsurface), light)
    gloss = light[1] * np.exp(np.float32(-1.5) * np.maximum(points[_DULL] - np.float32(0.3), 0))  # residue is rough
    radiance, normal, reflectance = (np.empty((len(distance), 3), np.float32) for _ in range(3))
    _colour(points, np.exp(-points[_DENSITY: _DENSITY + 3]), albedo.astype(np.float32), light[0],
            np.float32(switches.specular) * gloss, np.float32(switches.second_bounce), radiance, normal, reflectance)
    return radiance, normal, reflectance


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _points(distance: Array, row: Array, column: Array, rays: Array, pixel_rad: float, first_row: int,
            centre_step: Array, across: Array, across_step: Array, radius: Array, maps: Field,
            texels: tuple[Texels, ...], slots: NDArray[np.int64], texel_first_m: float, base_radius_m: float,
            relief: float, out: Field) -> None:
    """What lies at every hit, into `out` (`_QUANTITIES`, n); arguments as in `shade`."""
    k, m = radius.shape
    texture_columns = texels[0].shape[1]
    turn = 2 * math.pi / m
    t8 = np.empty(8)
    cosines, sines = np.cos(turn * np.arange(m)), np.sin(turn * np.arange(m))
    for h in range(len(distance)):
        t = distance[h]
        if t >= MISS:
            for c in range(_QUANTITIES):
                out[c, h] = 0.0
            continue
        fr, fc = row[h], column[h]
        i = int(fr)
        a = fr - i
        if i < 1:
            i, a = 1, 0.0
        if i > k - 3:
            i, a = k - 3, 1.0
        j = int(fc)
        b = fc - j
        j = j % m
        j1, jm, j2 = (j + 1) % m, (j - 1) % m, (j + 2) % m
        # smooth radius and its slopes: central differences, blended
        r = _mix(radius[i, j], radius[i, j1], radius[i + 1, j], radius[i + 1, j1], a, b)
        rs = 0.5 * _mix(radius[i + 1, j] - radius[i - 1, j], radius[i + 1, j1] - radius[i - 1, j1],
                        radius[i + 2, j] - radius[i, j], radius[i + 2, j1] - radius[i, j1], a, b)
        rt = _mix(radius[i, j1] - radius[i, jm], radius[i, j2] - radius[i, j],
                  radius[i + 1, j1] - radius[i + 1, jm], radius[i + 1, j2] - radius[i + 1, j], a, b) / (2 * turn)
        x = b * turn  # less than 0.02: three terms are exact to 1e-13
        cos_x, sin_x = 1 - x * x / 2 + x**4 / 24, x - x**3 / 6 + x**5 / 120
        cos, sin = cosines[j] * cos_x - sines[j] * sin_x, sines[j] * cos_x + cosines[j] * sin_x
        # tangents along (per row) and around (per radian)
        sx = sy = sz = tx = ty = tz = ox = oy = oz = 0.0
        for c in range(3):
            u = across[i, 0, c] * (1 - a) + across[i + 1, 0, c] * a
            v = across[i, 1, c] * (1 - a) + across[i + 1, 1, c] * a
            du = across_step[i, 0, c] * (1 - a) + across_step[i + 1, 0, c] * a
            dv = across_step[i, 1, c] * (1 - a) + across_step[i + 1, 1, c] * a
            outward = cos * u + sin * v
            along = centre_step[i, c] * (1 - a) + centre_step[i + 1, c] * a + rs * outward + r * (cos * du + sin * dv)
            around = rt * outward + r * (cos * v - sin * u)
            if c == 0:
                sx, tx, ox = along, around, outward
            elif c == 1:
                sy, ty, oy = along, around, outward
            else:
                sz, tz, oz = along, around, outward
        nx, ny, nz = ty * sz - tz * sy, tz * sx - tx * sz, tx * sy - ty * sx
        q = math.sqrt(nx * nx + ny * ny + nz * nz)
        if nx * ox + ny * oy + nz * oz > 0:
            q = -q
        nx, ny, nz = nx / q, ny / q, nz / q
        ls, lt = math.sqrt(sx * sx + sy * sy + sz * sz), math.sqrt(tx * tx + ty * ty + tz * tz)
        ls, lt = max(ls, 1e-9), max(lt, 1e-9)
        sx, sy, sz, tx, ty, tz = sx / ls, sy / ls, sz / ls, tx / lt, ty / lt, tz / lt
        dx, dy, dz = rays[h, 0], rays[h, 1], rays[h, 2]
        # textures: the level whose texel is as large as the pixel's footprint
        facing = max(-(dx * nx + dy * ny + dz * nz), 0.15)
        foot = t * pixel_rad / (TEXEL_M * math.sqrt(facing))
        level = 0
        while level < _DEEPEST_LEVEL and foot > 1.5:
            level += 1
            foot *= 0.5
        texture = texels[level]
        size = float(1 << level)
        shift = _mix(maps[i, j, 1], maps[i, j1, 1], maps[i + 1, j, 1], maps[i + 1, j1, 1], a, b)
        ty_ = (((first_row + i + a) * ROW_M + shift - texel_first_m) / TEXEL_M + 0.5) / size - 0.5
        tx_ = (fc / m * texture_columns + 0.5) / size - 0.5
        wide = texture_columns >> level
        bits = SECTION_BITS - level
        iy = min(max(math.floor(ty_), 0), (len(slots) << bits) - 2)
        fy = min(max(ty_ - iy, 0.0), 1.0)
        ix = math.floor(tx_)
        fx = tx_ - ix
        ix, ix1 = ix % wide, (ix + 1) % wide
        here, below = _stored(slots, iy, bits), _stored(slots, iy + 1, bits)
        w00, w01, w10, w11 = UNIT * (1 - fy) * (1 - fx), UNIT * (1 - fy) * fx, UNIT * fy * (1 - fx), UNIT * fy * fx
        for c in range(8):
            t8[c] = (w00 * texture[here, ix, c] + w01 * texture[here, ix1, c]
                     + w10 * texture[below, ix, c] + w11 * texture[below, ix1, c])
        # slopes per metre of texture become slopes per metre of the stretched wall
        pinch = relief * min(1.0, (2 * r / base_radius_m) ** 2)  # textures run together at the poles
        gs, gt = pinch * ROW_M / ls, pinch * min(base_radius_m / lt, 1.6)
        hs, ht = t8[3] * gs, t8[4] * gt
        smooth = min(1.0, ROW_M / ls)  # a film that is stretched along is smoothed around too: no streaks
        ws, wt = 0.3 * hs + t8[5] * gs, (0.3 * ht + t8[6] * gt) * smooth
        bx, by, bz = nx - hs * sx - ht * tx, ny - hs * sy - ht * ty, nz - hs * sz - ht * tz
        q = math.sqrt(bx * bx + by * by + bz * bz)
        bx, by, bz = bx / q, by / q, bz / q
        wx, wy, wz = nx - ws * sx - wt * tx, ny - ws * sy - wt * ty, nz - ws * sz - wt * tz
        q = math.sqrt(wx * wx + wy * wy + wz * wz)
        wx, wy, wz = wx / q, wy / q, wz / q
        out[_DISTANCE, h] = t
        out[_RAY, h], out[_RAY + 1, h], out[_RAY + 2, h] = dx, dy, dz
        out[_NORMAL, h], out[_NORMAL + 1, h], out[_NORMAL + 2, h] = nx, ny, nz
        out[_TISSUE, h], out[_TISSUE + 1, h], out[_TISSUE + 2, h] = bx, by, bz
        out[_FILM, h], out[_FILM + 1, h], out[_FILM + 2, h] = wx, wy, wz
        for c in range(3):
            out[_DENSITY + c, h] = t8[c] + _mix(maps[i, j, 2 + c], maps[i, j1, 2 + c], maps[i + 1, j, 2 + c],
                                                maps[i + 1, j1, 2 + c], a, b)
        out[_DULL, h] = out[_DENSITY, h] - t8[0]
        out[_FOAM, h] = t8[7]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _light(points: Field, leds: Field, wrap: F, light: Field) -> None:
    """Adds diffuse and glossy light (2, n) of LEDs (3, n); all in 32 bits without branches: many points at once."""
    rough2 = F(_ROUGHNESS * _ROUGHNESS)
    share, inverse = F(1 / leds.shape[1]), F(1) / (F(1) + wrap)
    peak = F(0.06 / math.pi) * rough2 * share
    for n in range(leds.shape[1]):
        px, py, pz = leds[0, n], leds[1, n], leds[2, n]
        for h in range(points.shape[1]):
            t, dx, dy, dz = points[_DISTANCE, h], points[_RAY, h], points[_RAY + 1, h], points[_RAY + 2, h]
            lx, ly, lz = px - t * dx, py - t * dy, pz - t * dz
            d2 = lx * lx + ly * ly + lz * lz
            d = F(1) / math.sqrt(d2)
            lx, ly, lz = lx * d, ly * d, lz * d
            emission = max(-lz, F(0))  # LEDs look along the optical axis
            flat = max(lx * points[_NORMAL, h] + ly * points[_NORMAL + 1, h] + lz * points[_NORMAL + 2, h], F(0))
            bumped = lx * points[_TISSUE, h] + ly * points[_TISSUE + 1, h] + lz * points[_TISSUE + 2, h]
            bumped = max(bumped + wrap, F(0)) * inverse
            arriving = emission / (F(1e6) * d2 + F(_LED_SIZE_MM2))
            light[0, h] += share * arriving * bumped * min(F(1), F(4) * flat + wrap)
            hx, hy, hz = lx - dx, ly - dy, lz - dz
            nh = hx * points[_FILM, h] + hy * points[_FILM + 1, h] + hz * points[_FILM + 2, h]
            q = nh * nh / (hx * hx + hy * hy + hz * hz) * (rough2 - F(1)) + F(1)
            light[1, h] += arriving * flat * (peak if nh > F(0) else F(0)) / (q * q)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _colour(points: Field, transmitted: Field, albedo: Field, diffuse: Field, gloss: Field, bounce: F, radiance: Field,
            normal: Field, reflectance: Field) -> None:
    """Radiance, normal and reflectance (n, 3), filled in."""
    for h in range(len(diffuse)):
        seen = F(1) if points[_DISTANCE, h] > F(0) else F(0)
        for c in range(3):
            v = min(max(albedo[c] * transmitted[c, h], F(0.01)), F(0.95))
            v = seen * (v + F(_FOAM_WHITE) * points[_FOAM, h] * (F(0.9) - v))
            reflectance[h, c] = v
            radiance[h, c] = v * (F(1) + bounce * (F(0.62) * v - F(0.28))) * diffuse[h] + seen * gloss[h]
            normal[h, c] = points[_NORMAL + c, h]
