"""Cameras that a simulated capsule can carry; vendors quote 140 to 172 degrees of view for real ones."""

from __future__ import annotations

import math

from vio.camera import Camera
from vio.errors import SimulationError

MIROCAM = Camera("pinhole", 320, 320, 159.5906, 159.2241, 161.9297, 163.1686, (0.1994, -0.1279, 0.0, 0.0))
"""MiroCam at 320×320, pinhole intrinsics published with EndoSLAM (k1, k2, p1, p2)."""


def fisheye(view_deg: float, size: int = 320) -> Camera:
    """Equidistant fisheye whose view fills the width of a square image."""
    focal = 0.5 * size / math.radians(0.5 * view_deg)
    return Camera("equidistant", size, size, focal, focal, 0.5 * size - 0.5, 0.5 * size - 0.5)


def pinhole(view_deg: float, size: int = 320) -> Camera:
    """Undistorted pinhole with this horizontal field of view."""
    focal = 0.5 * size / math.tan(math.radians(0.5 * view_deg))
    return Camera("pinhole", size, size, focal, focal, 0.5 * size - 0.5, 0.5 * size - 0.5)


CAMERAS = {"mirocam": MIROCAM, "fisheye-140": fisheye(140), "fisheye-156": fisheye(156), "pinhole-110": pinhole(110)}
"""Presets at 320×320."""


def preset_camera(name: str, size: int = 320) -> Camera:
    """A camera of `CAMERAS`, at another size of its image.

    Raises:
        SimulationError: unknown name, or a size that no image can have.
    """
    if name not in CAMERAS:
        raise SimulationError(f"simulate: unknown camera {name!r}; choose one of {', '.join(CAMERAS)}")
    if isinstance(size, bool) or size != int(size) or size < 1:
        raise SimulationError(f"simulate: image size is {size}; give a whole number of pixels")
    return CAMERAS[name] if size == 320 else CAMERAS[name].resized(int(size), int(size))
