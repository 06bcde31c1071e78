"""Real feature tracks of EuRoC V1_01's first 30 s, as shipped inside the gtsam wheel (eqvio_processed_30s.csv).

Rows `vision_feature` hold a frame index at 20 Hz, a landmark and its coordinates on the plane of unit depth. Those were
undistorted with a polynomial that only approximates the inverse of the calibrated distortion: going back through it
lands new features on whole pixels, as a detector makes them, and their rays are then taken with the exact model.
Frame k is the k-th image of the sequence.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio.camera import Camera
from vio.tracks import Tracks, tracks_from_table

Array = NDArray[np.float64]

CAMERA = Camera("pinhole", 752, 480, 458.654, 457.296, 367.215, 248.375,
                (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))
FRAME_RATE_HZ = 20
NEWTON_STEPS = 50


def load_eqvio_tracks(path: Path) -> tuple[NDArray[np.int64], Tracks]:
    """Frame indices at 20 Hz (all frames up to the last) and the tracks in pixels of `CAMERA`."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["row_type"] == "vision_feature"]
    frame = np.array([int(row["frame_idx"]) for row in rows])
    landmark = np.array([int(row["landmark_id"]) for row in rows])
    plane = np.array([[float(row["u_norm"]), float(row["v_norm"])] for row in rows])
    pixel = _pixels(plane)
    inside = ((pixel >= 0) & (pixel <= [CAMERA.width - 1, CAMERA.height - 1])).all(axis=1)
    tracks = tracks_from_table(frame[inside], landmark[inside], pixel[inside])
    return np.arange(tracks.n_frames), tracks


def _pixels(plane: Array) -> Array:
    """Distorted pixels (N, 2) whose approximate undistortion is `plane` (N, 2), by Newton's method."""
    coefficients = _approximate_inverse()
    q, h = plane.copy(), 1e-6
    for _ in range(NEWTON_STEPS):
        slope = np.stack([(_polynomial(q + step, coefficients) - _polynomial(q - step, coefficients)) / (2 * h)
                          for step in h * np.eye(2)], axis=2)
        q -= np.linalg.solve(slope, (_polynomial(q, coefficients) - plane)[:, :, None])[:, :, 0]
    return q * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]


def _terms(xy: Array) -> Array:
    """(N, 2, 5) derivatives of the distortion by k1, k2, p1, p2, k3."""
    x, y = xy.T
    r2 = x * x + y * y
    return np.stack([np.column_stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3]),
                     np.column_stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3])], axis=1)


def _polynomial(xy: Array, coefficients: Array) -> Array:
    return xy + _terms(xy) @ coefficients


def _approximate_inverse() -> Array:
    """Coefficients (5,) of the same polynomial, fitted on a 30 × 30 grid to undo the distortion."""
    columns, rows = np.meshgrid(np.arange(0, CAMERA.width, CAMERA.width // 30),
                                np.arange(0, CAMERA.height, CAMERA.height // 30), indexing="ij")
    ideal = np.column_stack([(columns.ravel() - CAMERA.cx) / CAMERA.fx, (rows.ravel() - CAMERA.cy) / CAMERA.fy])
    distorted = _polynomial(ideal, np.append(CAMERA.distortion, 0.0))
    A, b = _terms(distorted).reshape(-1, 5), (ideal - distorted).ravel()
    return np.linalg.lstsq(A, b)[0]
