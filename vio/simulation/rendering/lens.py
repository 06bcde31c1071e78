"""A camera as the kernels need it: one ray per pixel, and numbers that project points as `vio.camera` does."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vio.camera import Camera

Array = NDArray[np.float64]

WIDEST_RAD = 3.0
"""Wall points up to this far off the axis count, whatever the lens sees: a triangle beside it may reach into view."""


@dataclass(frozen=True)
class Lens:
    """Rays and projection of one camera.

    Build it with `make_lens`.
    """

    camera: Camera
    rays: Array
    """(H, W, 3) unit rays in camera axes; zero where no light reaches the pixel."""
    sees: NDArray[np.bool_]
    """(H, W) whether light reaches the pixel."""
    numbers: Array
    """(15,) for `project_point`: fisheye?, fx, fy, cx, cy, k1..k4, p1, p2, widest angle, pixel's angle, the angle
    beyond which the model gives no pixels (there points are laid out on and on outside the image), and its tangent."""


def make_lens(camera: Camera, view_circle: bool) -> Lens:
    """The lens of a camera; with `view_circle` only the largest circle of the image is lit, as in a capsule."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([columns, rows], axis=-1).astype(float)
    rays = camera.unproject(pixels)
    sees = np.asarray(np.isfinite(rays).all(axis=-1))
    if view_circle:
        centre = 0.5 * np.array([camera.width - 1, camera.height - 1])
        sees &= np.linalg.norm(pixels - centre, axis=-1) <= 0.5 * min(camera.width, camera.height)
    rays = np.where(sees[..., None], rays, 0.0)
    fisheye = camera.model == "equidistant"
    k = camera.distortion
    radial = list(k[:4]) if fisheye else [k[0], k[1], k[4] if len(k) > 4 else 0.0, 0.0]
    p1, p2 = (0.0, 0.0) if fisheye else (k[2], k[3])
    limit = _one_to_one(radial, 3.1 if fisheye else 10.0)
    numbers = [float(fisheye), camera.fx, camera.fy, camera.cx, camera.cy, *radial, p1, p2,
               WIDEST_RAD, 1.0 / math.sqrt(camera.fx * camera.fy),
               limit if fisheye else math.atan(limit), limit]
    return Lens(camera, np.ascontiguousarray(rays), sees, np.array(numbers))


def _one_to_one(radial: list[float], largest: float) -> float:
    """How far the radial polynomial grows, at most `largest`."""
    s = np.linspace(0, largest, 20001)
    value = s * (1 + radial[0] * s**2 + radial[1] * s**4 + radial[2] * s**6 + radial[3] * s**8)
    falls = np.flatnonzero(np.diff(value) <= 0)
    return float(s[falls[0]]) if len(falls) else largest


@njit(cache=True, inline="always")
def project_point(x: float, y: float, z: float, n: Array) -> tuple[float, float, bool]:
    """Pixel of a point in camera axes, and whether it lies within the lens's widest angle."""
    r = math.sqrt(x * x + y * y)
    beyond = 0.0
    if n[0] < 0.5 and r < z * n[14]:
        s, planar = r / z, 1.0 / z
    else:
        angle = math.atan2(r, z)
        if angle >= n[11]:
            return 0.0, 0.0, False
        seen = min(angle, n[13])
        beyond = angle - seen
        s = seen if n[0] > 0.5 else math.tan(seen)
        planar = s / r if r > 1e-12 else 1.0 / z
    q = s * s
    scale = 1.0 + q * (n[5] + q * (n[6] + q * (n[7] + q * n[8]))) + 3.0 * beyond
    a, b = x * planar, y * planar
    u = a * scale + 2.0 * n[9] * a * b + n[10] * (q + 2.0 * a * a)
    v = b * scale + n[9] * (q + 2.0 * b * b) + 2.0 * n[10] * a * b
    return n[1] * u + n[3], n[2] * v + n[4], True
