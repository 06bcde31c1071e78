"""Whether motions and gyro speak of the same turns: motions that measured nothing, a camera mounted otherwise.

The turns of the body that the motions report, y, are regressed on the gyro's, x: y = M x + c. M is the identity where
all is well, near zero where the motions measured nothing, a rotation where the camera sits otherwise than calibrated.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from fusion.camera_imu import LEAST_PAIRS, Pairs
from vio import se3
from vio.errors import CalibrationError, ImuError, MotionsError

Array = NDArray[np.float64]

CLEAR_SIGNAL = 2.0
"""Turns over the motions' claimed noise, about every axis, at which the motions must follow the gyro."""
STANDING_STILL = 0.05
FOLLOWING = 0.3
"""Share of the turns that motions with that signal must at least explain; sound ones explain more than 0.8."""
MISMOUNTED_RAD = float(np.deg2rad(30.0))
NEAR_PERMUTATION = 0.35
CAUCHY = 3.0


def check_against_gyro(pairs: Pairs, T_body_camera: Array) -> None:
    """Refuse motions that have nothing to do with the gyro, and a camera that plainly sits otherwise than calibrated.

    Where the capsule hardly turned, nothing is concluded.

    Raises:
        MotionsError: the motions stand still, or are unrelated to the gyro, while the gyro turns clearly.
        CalibrationError: the motions follow the gyro, turned by more than 30 degrees.
        ImuError: they follow it once two of the gyro's axes are swapped, or one is reversed.
    """
    if len(pairs) < LEAST_PAIRS:
        return
    R_bc = T_body_camera[:3, :3]
    turned, seen = se3.so3_log(pairs.gyro), se3.so3_log(pairs.R) @ R_bc.T
    turned, seen = turned - np.median(turned, axis=0), seen - np.median(seen, axis=0)
    claimed = float(np.sqrt(np.mean(np.linalg.inv(pairs.whiten) ** 2) * 3))
    spread = np.sqrt(np.linalg.eigvalsh(turned.T @ turned / len(turned)))
    if spread[0] < CLEAR_SIGNAL * claimed:
        return
    if np.sqrt(np.mean(seen**2)) < STANDING_STILL * np.sqrt(np.mean(turned**2)):
        turns = f"{np.rad2deg(spread.mean()):.2g} degrees per frame (rms per axis, {len(pairs)} motions)"
        raise MotionsError(f"motions: they stand still while the gyro turns {turns}: their source measured nothing; "
                           "measure again")
    M, explained = _regressed(turned, seen)
    if explained < FOLLOWING:
        raise MotionsError(f"motions: their rotations do not follow the gyro's (they share {100 * explained:.0f} % of "
                           f"its turns, limit {100 * FOLLOWING:.0f} %): noise, or another recording's; measure again")
    _check_swapped(M)
    U, _, Vt = np.linalg.svd(M)
    turn = se3.so3_log(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
    angle = float(np.linalg.norm(turn))
    if angle > MISMOUNTED_RAD:
        axis = ", ".join(f"{x:+.2f}" for x in turn / angle)
        degrees, limit = np.rad2deg([angle, MISMOUNTED_RAD])
        raise CalibrationError(f"calibration: camera and IMU are turned by {degrees:.0f} degrees about body axis "
                               f"({axis}) against T_BS (limit {limit:.0f}): IMU upside down, or T_BS wrong; correct it "
                               "in cam0/sensor.yaml")


def _check_swapped(M: Array) -> None:
    """Two swapped axes, or a reversed one, make a left-handed gyro, which no mounting explains."""
    for permutation in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            P = np.eye(3)[list(permutation)] * signs
            if np.linalg.det(P) < 0 and np.abs(M - P).max() < NEAR_PERMUTATION:
                moved = [k for k in range(3) if permutation[k] != k]
                axes = f"{'xyz'[moved[0]]} and {'xyz'[moved[1]]} are swapped" if len(moved) == 2 else \
                    f"{'xyz'[int(np.argmin(signs))]} is reversed" if not moved else "axes are mixed up"
                raise ImuError(f"imu: gyro {axes}: the camera's turns follow the gyro's only so (within "
                               f"{np.abs(M - P).max():.2f} of it); correct the axes in imu0/data.csv")


def _regressed(x: Array, y: Array) -> tuple[Array, float]:
    """M (3, 3) of y = M x, robustly, and the share of y's variance (weighted) that it explains."""
    weight = np.ones(len(x))
    for _ in range(6):
        M = np.linalg.lstsq(x * weight[:, None] ** 0.5, y * weight[:, None] ** 0.5, rcond=None)[0].T
        squared = ((y - x @ M.T) ** 2).sum(axis=1)
        weight = 1 / (1 + squared / (CAUCHY**2 * max(float(np.median(squared)) / 2.366, 1e-20)))
    return np.asarray(M, float), 1 - float((weight * squared).sum() / max((weight * (y**2).sum(axis=1)).sum(), 1e-30))
