"""Cameras: from points to pixels and back, for a pinhole with lens distortion and for a fisheye.

Camera axes: x right, y down, z forward. Pixel centres have integer coordinates (the OpenCV convention), so an
image of width w reaches from -0.5 to w - 0.5. Both models share one radial polynomial
`s (1 + k1 s² + k2 s⁴ + ...)`: s is the tangent of the angle to the optical axis for the pinhole (Brown 1966,
plus tangential terms) and the angle itself for the fisheye (Kannala and Brandt 2006).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio.errors import CameraError

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
CameraModel = Literal["pinhole", "equidistant"]

PINHOLE_LIMIT = 100.0  # tangent of 89.4 degrees: no pinhole looks further aside
FOLD_MARGIN = 0.999  # stay off the radius where the polynomial turns back and two rays share a pixel
KNOTS = 1024
NEWTON_STEPS = 8
CONVERGED = 1e-12  # in units of focal lengths, and relative to the radius beyond one of them


@dataclass(frozen=True)
class Camera:
    """One calibrated camera.

    Raises:
        CameraError: an unknown model, a size or focal length that is not positive, a principal point more than
            one image away from the image, or the wrong number of distortion coefficients.
    """

    model: CameraModel
    width: int
    """Columns of the image."""
    height: int
    """Rows of the image."""
    fx: float
    """Focal length along x [pixels]."""
    fy: float
    """Focal length along y [pixels]."""
    cx: float
    """Column of the optical axis [pixels]."""
    cy: float
    """Row of the optical axis [pixels]."""
    distortion: tuple[float, ...] = ()
    """Pinhole: k1, k2, p1, p2 and optionally k3; equidistant: k1, k2, k3, k4; empty = none."""

    def __post_init__(self) -> None:
        if self.model not in get_args(CameraModel):
            raise CameraError(f"camera: model {self.model!r} is unknown; use one of {', '.join(get_args(CameraModel))}")
        for name, value in (("width", self.width), ("height", self.height)):
            if value != int(value) or value < 1:
                raise CameraError(f"camera: {name} is {value}, must be a whole number of pixels ≥ 1")
            object.__setattr__(self, name, int(value))
        distortion = tuple(float(k) for k in self.distortion) or (0.0, 0.0, 0.0, 0.0)
        allowed = (4, 5) if self.model == "pinhole" else (4,)
        if len(distortion) not in allowed:
            raise CameraError(
                f"camera: {len(distortion)} distortion coefficients for model {self.model!r}, "
                f"expected {' or '.join(map(str, allowed))}"
            )
        object.__setattr__(self, "distortion", distortion)
        self._check_numbers()

    def _check_numbers(self) -> None:
        numbers = np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion], float)
        if not np.isfinite(numbers).all():
            raise CameraError(f"camera: intrinsics or distortion are not finite ({numbers.tolist()})")
        if self.fx <= 0 or self.fy <= 0:
            raise CameraError(f"camera: focal lengths are {self.fx:g}, {self.fy:g} pixels, must be positive")
        for name, value, size in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if not -size < value < 2 * size:
                raise CameraError(
                    f"camera: {name} is {value:g} in an image of {self.width} x {self.height} pixels (limit: one "
                    "image beyond its edge); check the order fx, fy, cx, cy and the resolution"
                )

    @property
    def K(self) -> Array:
        """(3, 3) matrix of the intrinsics."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same image scaled to another size."""
        x, y = width / self.width, height / self.height
        return Camera(self.model, width, height, self.fx * x, self.fy * y,
                      (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5, self.distortion)

    def contains(self, pixels: ArrayLike) -> Bools:
        """Which pixels (..., 2) lie on the image; False for NaN."""
        pixels = np.asarray(pixels, float)
        inside = (pixels >= -0.5) & (pixels < np.array([self.width, self.height]) - 0.5)
        return np.asarray(inside.all(axis=-1))

    def project(self, points_camera: ArrayLike) -> tuple[Array, Bools]:
        """Pixels (..., 2) of points (..., 3) in camera axes, and which of them (...) the model can see.

        Not seen are points behind a pinhole, and points beyond the angle at which the distortion polynomial
        turns back; their pixels are NaN. A seen point may still lie off the image: ask `contains`.
        """
        points = np.asarray(points_camera, float)
        planar, valid = self._distort_pinhole(points) if self.model == "pinhole" else self._distort_fisheye(points)
        pixels = planar * [self.fx, self.fy] + [self.cx, self.cy]
        pixels[~valid] = np.nan
        return pixels, valid

    def unproject(self, pixels: ArrayLike) -> Array:
        """Unit rays (..., 3) in camera axes of pixels (..., 2); NaN where no ray reaches the pixel."""
        pixels = np.asarray(pixels, float)
        planar = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        radius = np.linalg.norm(planar, axis=-1)
        s = self._undo_radial(radius)
        if self.model == "pinhole":
            plane = self._undo_tangential(planar, planar * _ratio(s, radius)[..., None])
            ray = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
            return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))
        sine = planar * _ratio(np.sin(s), radius)[..., None]
        return np.concatenate([sine, np.cos(s)[..., None]], axis=-1)

    @property
    def _radial(self) -> Array:
        """k1, k2, ... of the radial polynomial."""
        k = self.distortion
        return np.array([*k[:2], *k[4:]] if self.model == "pinhole" else k)

    @property
    def _tangential(self) -> tuple[float, float]:
        return (self.distortion[2], self.distortion[3]) if self.model == "pinhole" else (0.0, 0.0)

    @property
    def reach(self) -> float:
        """Largest s that maps one-to-one to an image radius: tangent for the pinhole, angle [rad] for the fisheye."""
        return self._limit

    @cached_property
    def _limit(self) -> float:
        k = self._radial
        slope = np.append(((2 * np.arange(len(k)) + 3) * k)[::-1], 1.0)  # of s (1 + k1 s² + ...), over s²
        roots = np.roots(slope)
        turns = roots[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)].real
        fold = FOLD_MARGIN * float(np.sqrt(turns.min())) if len(turns) else np.inf
        return min(fold, PINHOLE_LIMIT if self.model == "pinhole" else np.pi)

    def _stretch(self, s: Array) -> tuple[Array, Array]:
        """1 + k1 s² + k2 s⁴ + ..., and the slope of `s` times it."""
        square, value, slope = s * s, np.zeros_like(s), np.zeros_like(s)
        k = self._radial
        for power in range(len(k), 0, -1):
            value = (value + k[power - 1]) * square
            slope = (slope + (2 * power + 1) * k[power - 1]) * square
        return 1 + value, 1 + slope

    def _distort_pinhole(self, points: Array) -> tuple[Array, Bools]:
        z = points[..., 2]
        front = np.isfinite(points).all(axis=-1) & (z > 0)
        front &= np.abs(points[..., :2]).max(axis=-1, initial=0.0) < PINHOLE_LIMIT * np.where(front, z, 0.0)
        plane = np.where(front[..., None], points[..., :2], 0.0) / np.where(front, z, 1.0)[..., None]
        valid: Bools = front & (np.linalg.norm(plane, axis=-1) < self._limit)
        return self._distort_plane(np.where(valid[..., None], plane, 0.0)), valid

    def _distort_plane(self, plane: Array) -> Array:
        x, y = plane[..., 0], plane[..., 1]
        square = x * x + y * y
        p1, p2 = self._tangential
        shift = np.stack([2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y], -1)
        return np.asarray(plane * self._stretch(np.sqrt(square))[0][..., None] + shift)

    def _distort_fisheye(self, points: Array) -> tuple[Array, Bools]:
        usable = np.isfinite(points).all(axis=-1) & (points != 0).any(axis=-1)
        points = np.where(usable[..., None], points, [0.0, 0.0, 1.0])
        radius = np.hypot(points[..., 0], points[..., 1])
        angle = np.arctan2(radius, points[..., 2])
        valid: Bools = usable & (angle < self._limit)
        angle = np.where(valid, angle, 0.0)
        return points[..., :2] * _ratio(angle * self._stretch(angle)[0], radius)[..., None], valid

    def _undo_radial(self, radius: Array) -> Array:
        """s of every distorted radius: a table for the first guess, then Newton inside the table's cell."""
        knots = np.linspace(0.0, self._limit, KNOTS)
        table = knots * self._stretch(knots)[0]
        reachable = radius <= table[-1] * (1 + 1e-9)  # a ray at the limit itself comes back; False for NaN
        target = np.where(reachable, radius, 0.0)
        cell = np.clip(np.searchsorted(table, target, "right") - 1, 0, KNOTS - 2)
        s = np.interp(target, table, knots)
        for _ in range(NEWTON_STEPS):
            stretch, slope = self._stretch(s)
            s = np.clip(s - (s * stretch - target) / slope, knots[cell], knots[cell + 1])
        return np.where(reachable, s, np.nan)

    def _undo_tangential(self, planar: Array, guess: Array) -> Array:
        """Newton in the plane, from the point that the radial part alone would give."""
        p1, p2 = self._tangential
        if p1 == 0 and p2 == 0:
            return guess
        plane, off = guess, self._distort_plane(guess) - planar
        limit = CONVERGED * (1 + np.abs(planar).max(axis=-1, keepdims=True))
        for _ in range(NEWTON_STEPS):
            plane = plane - self._newton_step(plane, off)
            off = self._distort_plane(plane) - planar
            if not (np.abs(off) > limit).any():
                break
        return np.where((np.abs(off) <= limit).all(axis=-1, keepdims=True), plane, np.nan)

    def _newton_step(self, plane: Array, off: Array) -> Array:
        """`off` divided by the (symmetric) 2 x 2 derivative of `_distort_plane`."""
        x, y = plane[..., 0], plane[..., 1]
        square = x * x + y * y
        p1, p2 = self._tangential
        stretch, slope = self._stretch(np.sqrt(square))
        bend = _ratio(slope - stretch, square)  # (d stretch / d s) / s
        xx = stretch + bend * x * x + 2 * p1 * y + 6 * p2 * x
        yy = stretch + bend * y * y + 6 * p1 * y + 2 * p2 * x
        xy = bend * x * y + 2 * p1 * x + 2 * p2 * y
        u, v = off[..., 0], off[..., 1]
        return np.stack([yy * u - xy * v, xx * v - xy * u], axis=-1) / (xx * yy - xy * xy)[..., None]


def _ratio(a: Array, b: Array) -> Array:
    """a / b, and 1 where b is zero: there both vanish along the optical axis and the numerator's partner is 0."""
    zero = b == 0
    return np.where(zero, 1.0, a) / np.where(zero, 1.0, b)
