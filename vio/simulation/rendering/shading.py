"""How bright the wall looks: near-field LEDs on a wet, translucent mucosa, one point per pixel.

Light model: LEDs with cosine emission and inverse-square fall-off; wrapped diffuse reflection, which stands for light
that scatters below the surface, gated by the geometric cosine so that nothing shines through folds; a highlight of
the GGX form (Walter et al. 2007) on the smoother normal of the wet film; a tinted second bounce. Normals are analytic:
those of the smoothly interpolated wall, tilted by the slopes of the textures.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vio.simulation.rendering.rasteriser import MISS
from vio.simulation.rendering.textures import LEVELS, TEXEL_M
from vio.simulation.wall import ROW_M

Array = NDArray[np.float64]
Field = NDArray[np.float32]

_LED_SIZE_MM2 = 4.0
_WRAP = 0.35
_ROUGHNESS = 0.14
_FOAM_WHITE = 0.10
_DEEPEST_LEVEL = LEVELS - 1


@njit(cache=True, inline="always")
def _mix(v00: float, v01: float, v10: float, v11: float, a: float, b: float) -> float:
    """Bilinear: a along rows, b along columns."""
    return (v00 * (1 - b) + v01 * b) * (1 - a) + (v10 * (1 - b) + v11 * b) * a


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def shade(distance: Array, row: Array, column: Array, rays: Array, pixel_rad: float, first_row: int,
          centre_step: Array, across: Array, across_step: Array, radius: Array, maps: Field, texels: tuple[Field, ...],
          texel_first_m: float, base_radius_m: float, albedo: Array, leds: Array, switches: Array, radiance: Field,
          normal: Field, reflectance: Field) -> None:
    """Radiance, normal and albedo of wall points.

    Args:
        distance, row, column: (n,) hits of `rasterise`; rows count from the stretch's first row.
        rays: (n, 3) unit rays in camera axes.
        pixel_rad: angle that one pixel spans.
        first_row: of the stretch, in rows of the wall.
        centre_step, across, across_step: (k, 3), (k, 2, 3), (k, 2, 3) centre change per row, directions across the
            lumen and their change per row, in camera axes.
        radius: (k, m) [m] as it is now.
        maps: (k, m, 5) of `Wall.maps`.
        texels: mip levels of `TextureWindow`.
        texel_first_m: where along the wall they begin.
        base_radius_m: radius at which a texel is as wide as it is long.
        albedo: (3,) of bare mucosa.
        leds: (n, 3) positions in camera axes [m].
        switches: (4,) scales of highlight, subsurface wrap, relief, second bounce.
        radiance, normal, reflectance: (n, 3), filled in, left alone where nothing was hit; normals in camera axes,
            towards the camera.
    """
    k, m = radius.shape
    texture_columns = texels[0].shape[1]
    turn = 2 * math.pi / m
    wrap = _WRAP * switches[1]
    rough2 = _ROUGHNESS * _ROUGHNESS
    t8 = np.empty(8)
    for h in range(len(distance)):
        t = distance[h]
        if t >= MISS:
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
        cos, sin = math.cos(fc * turn), math.sin(fc * turn)
        # tangents along (per row) and around (per radian)
        sx = sy = sz = tx = ty = tz = ox = oy = oz = 0.0
        for c in range(3):
            u = across[i, 0, c] * (1 - a) + across[i + 1, 0, c] * a
            v = across[i, 1, c] * (1 - a) + across[i + 1, 1, c] * a
            du = across_step[i, 0, c] * (1 - a) + across_step[i + 1, 0, c] * a
            dv = across_step[i, 1, c] * (1 - a) + across_step[i + 1, 1, c] * a
            out = cos * u + sin * v
            along = centre_step[i, c] * (1 - a) + centre_step[i + 1, c] * a + rs * out + r * (cos * du + sin * dv)
            around = rt * out + r * (cos * v - sin * u)
            if c == 0:
                sx, tx, ox = along, around, out
            elif c == 1:
                sy, ty, oy = along, around, out
            else:
                sz, tz, oz = along, around, out
        nx, ny, nz = ty * sz - tz * sy, tz * sx - tx * sz, tx * sy - ty * sx
        q = math.sqrt(nx * nx + ny * ny + nz * nz)
        if nx * ox + ny * oy + nz * oz > 0:
            q = -q
        nx, ny, nz = nx / q, ny / q, nz / q
        ls, lt = math.sqrt(sx * sx + sy * sy + sz * sz), math.sqrt(tx * tx + ty * ty + tz * tz)
        ls, lt = max(ls, 1e-9), max(lt, 1e-9)
        sx, sy, sz, tx, ty, tz = sx / ls, sy / ls, sz / ls, tx / lt, ty / lt, tz / lt
        normal[h, 0], normal[h, 1], normal[h, 2] = nx, ny, nz
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
        iy = min(max(math.floor(ty_), 0), texture.shape[0] - 2)
        fy = min(max(ty_ - iy, 0.0), 1.0)
        ix = math.floor(tx_)
        fx = tx_ - ix
        ix, ix1 = ix % wide, (ix + 1) % wide
        for c in range(8):
            t8[c] = _mix(texture[iy, ix, c], texture[iy, ix1, c], texture[iy + 1, ix, c], texture[iy + 1, ix1, c],
                         fy, fx)
        # slopes per metre of texture become slopes per metre of the stretched wall
        pinch = switches[2] * min(1.0, (2 * r / base_radius_m) ** 2)  # textures run together at the poles
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
        # light
        diffuse = gloss = 0.0
        for n in range(leds.shape[0]):
            lx, ly, lz = leds[n, 0] - t * dx, leds[n, 1] - t * dy, leds[n, 2] - t * dz
            d2 = lx * lx + ly * ly + lz * lz
            d = math.sqrt(d2)
            lx, ly, lz = lx / d, ly / d, lz / d
            emission = -lz  # LEDs look along the optical axis
            if emission <= 0:
                continue
            flat = max(0.0, lx * nx + ly * ny + lz * nz)
            bumped = max(0.0, (lx * bx + ly * by + lz * bz + wrap) / (1 + wrap))
            light = emission / (1e6 * d2 + _LED_SIZE_MM2)
            diffuse += light * bumped * min(1.0, flat * 4 + wrap)
            if flat > 0:
                hx, hy, hz = lx - dx, ly - dy, lz - dz
                nh = hx * wx + hy * wy + hz * wz
                if nh > 0:
                    q = nh * nh / (hx * hx + hy * hy + hz * hz) * (rough2 - 1) + 1
                    gloss += light * flat * rough2 / (math.pi * q * q)
        diffuse /= leds.shape[0]
        gloss *= 0.06 * switches[0] / leds.shape[0]
        dull = _mix(maps[i, j, 2], maps[i, j1, 2], maps[i + 1, j, 2], maps[i + 1, j1, 2], a, b)
        gloss *= math.exp(-1.5 * max(dull - 0.3, 0.0))  # residue is rough, an opening is dark
        for c in range(3):
            density = t8[c] + _mix(maps[i, j, 2 + c], maps[i, j1, 2 + c], maps[i + 1, j, 2 + c],
                                   maps[i + 1, j1, 2 + c], a, b)
            v = min(max(albedo[c] * math.exp(-density), 0.01), 0.95)
            v += _FOAM_WHITE * t8[7] * (0.9 - v)
            reflectance[h, c] = v
            radiance[h, c] = v * (1 + switches[3] * (-0.28 + 0.62 * v)) * diffuse + gloss
