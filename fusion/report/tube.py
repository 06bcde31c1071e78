"""The uncertainty of the trajectory in space: a tube whose cross-sections are the claimed 95 % ellipsoids' shadows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fusion.report.aligned import Scene
from fusion.report.figures import Figure, numbers

Array = NDArray[np.float64]

RINGS, SIDES = 320, 10
RADIUS_SD = float(np.sqrt(chi2.ppf(0.95, 3)))
"""An ellipsoid of so many standard deviations holds 95 % of a Gaussian in space."""


def tube_figure(scene: Scene, factor: float) -> list[Figure]:
    """The tube as a mesh for the picture in space; empty where nothing is claimed.

    Args:
        scene: what the picture shows.
        factor: of its unit, from metres.
    """
    if scene.claimed_cov_m2 is None or len(scene.t_s) < 2:
        return []
    frames = ring_frames(scene.refined_m)
    if len(frames) < 2:
        return []
    vertices, faces = tube(scene.refined_m[frames], scene.claimed_cov_m2[frames])
    mesh = {"type": "mesh3d", "name": "95 % tube", "color": "--refined", "opacity": 0.16, "hoverinfo": "skip",
            "showlegend": True, "lighting": {"ambient": 0.9, "diffuse": 0.2, "specular": 0.0}}
    mesh |= {axis: numbers(factor * vertices[:, k]) for k, axis in enumerate("xyz")}
    return [mesh | {corner: faces[:, k].tolist() for k, corner in enumerate("ijk")}]


def ring_frames(points_m: Array) -> NDArray[np.int64]:
    """Frames (of M) that carry a ring: evenly along the way, so that rests take none, with both ends."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1))])
    at = np.searchsorted(way, np.linspace(0, way[-1], min(RINGS, len(way))))
    return np.unique(np.concatenate([[0], np.minimum(at, len(way) - 1), [len(way) - 1]])).astype(np.int64)


def tube(points_m: Array, cov_m2: Array) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (N * SIDES, 3) and triangles (F, 3) of a tube through N points.

    The ring at a point is the outline of its ellipsoid seen along the way: with the plane's axes E (3, 2) the points
    p + r E chol(Eᵀ Σ E) (cos a, sin a).

    Args:
        points_m: (N, 3), N at least 2.
        cov_m2: (N, 3, 3) in the same axes.
    """
    axes = _planes(points_m)
    flat = np.swapaxes(axes, 1, 2) @ cov_m2 @ axes
    size = np.maximum(np.trace(flat, axis1=1, axis2=2), 1e-24)[:, None, None]
    root = np.linalg.cholesky(flat + 1e-9 * size * np.eye(2))
    angle = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    rings = points_m[:, None] + RADIUS_SD * np.swapaxes(axes @ root @ circle, 1, 2)
    here = np.arange(len(points_m) - 1)[:, None] * SIDES + np.arange(SIDES)
    beside = np.arange(len(points_m) - 1)[:, None] * SIDES + (np.arange(SIDES) + 1) % SIDES
    faces = np.concatenate([np.stack([here, beside, here + SIDES], -1), np.stack([beside, beside + SIDES,
                                                                                  here + SIDES], -1)])
    return rings.reshape(-1, 3), faces.reshape(-1, 3)


def _planes(points_m: Array) -> Array:
    """(N, 3, 2) axes across the way, turning as little as possible from one point to the next."""
    way = np.gradient(points_m, axis=0)
    axes = np.empty((len(points_m), 3, 2))
    along, first = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    for k, step in enumerate(way):
        length = np.linalg.norm(step)
        along = step / length if length > 0 else along
        first = first - (first @ along) * along
        if np.linalg.norm(first) < 1e-6:
            first = np.eye(3)[np.argmin(np.abs(along))]
            first = first - (first @ along) * along
        first = first / np.linalg.norm(first)
        axes[k] = np.stack([first, np.cross(along, first)], axis=1)
    return axes
