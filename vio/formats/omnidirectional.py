"""A spherical omnidirectional camera as the fisheye of this library, with the error that this costs.

The model (Scaramuzza, Martinelli and Siegwart 2006; the form C3VD uses): (u'', v'') = A⁻¹ (u - cx, v - cy) with A =
[[c, d], [e, 1]], rho = |(u'', v'')|, ray = (u'', v'', a0 + a2 rho² + a3 rho³ + a4 rho⁴).

A splits into a rotation about the optical axis, which moves into the camera's pose, and a stretch along the axes,
which moves into fx and fy. What remains is rho as a function of the angle to the axis: a polynomial of Kannala and
Brandt is fitted to it over the whole image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import polar

from vio.camera import Camera

Array = NDArray[np.float64]

SAMPLES = 2000
LAWSON_STEPS = 40


@dataclass(frozen=True)
class Omnidirectional:
    """Parameters as published; lengths in pixels."""

    width: int
    height: int
    cx: float
    cy: float
    a: tuple[float, float, float, float]
    """a0, a2, a3, a4."""
    c: float
    d: float
    e: float

    @property
    def affine(self) -> Array:
        """(2, 2) from the ideal to the real image."""
        return np.array([[self.c, self.d], [self.e, 1.0]])

    def unproject(self, pixels: ArrayLike) -> Array:
        """Unit rays (..., 3) of pixels (..., 2)."""
        ideal = (np.asarray(pixels, float) - [self.cx, self.cy]) @ np.linalg.inv(self.affine).T
        ray = np.concatenate([ideal, self.height_of(np.linalg.norm(ideal, axis=-1))[..., None]], axis=-1)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def height_of(self, rho: Array) -> Array:
        """The third coordinate of the ray at radius rho."""
        a0, a2, a3, a4 = self.a
        return np.asarray(a0 + a2 * rho**2 + a3 * rho**3 + a4 * rho**4)


class Fisheye(NamedTuple):
    """The fitted camera."""

    camera: Camera
    T_omni_camera: Array
    """(4, 4) pose of the fitted camera in the axes of the published one: a turn about the optical axis."""


def fit_equidistant(omni: Omnidirectional) -> Fisheye:
    """The equidistant camera whose largest distance from the model, over the whole image, is smallest."""
    turn, stretch = polar(omni.affine)
    corners = np.array([[x, y] for x in (-0.5, omni.width - 0.5) for y in (-0.5, omni.height - 0.5)])
    ideal = (corners - [omni.cx, omni.cy]) @ np.linalg.inv(omni.affine).T
    rho = np.linspace(0, np.linalg.norm(ideal, axis=1).max(), SAMPLES + 1)[1:]
    angle = np.arctan2(rho, omni.height_of(rho))
    powers = angle[:, None] ** np.array([1, 3, 5, 7, 9])
    terms = _least_maximum(powers, rho)
    focal, k = float(terms[0]), tuple((terms[1:] / terms[0]).tolist())
    T_omni_camera = np.eye(4)
    T_omni_camera[:2, :2] = turn.T
    fx, fy = (float(focal * stretch[axis, axis]) for axis in (0, 1))
    return Fisheye(Camera("equidistant", omni.width, omni.height, fx, fy, omni.cx, omni.cy, k), T_omni_camera)


def _least_maximum(terms: Array, values: Array) -> Array:
    """Coefficients with the smallest largest error: least squares, reweighted by the errors (Lawson 1961)."""
    weights = np.ones(len(values))
    coefficients: Array = np.zeros(terms.shape[1])
    for _ in range(LAWSON_STEPS):
        root = np.sqrt(weights)
        coefficients = np.asarray(np.linalg.lstsq(terms * root[:, None], values * root, rcond=None)[0], float)
        weights = weights * np.abs(terms @ coefficients - values)
        weights /= weights.mean()
    return coefficients
