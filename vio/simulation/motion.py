"""The shaken motion: nominal path and vibration composed in closed form.

With nominal R_n, p_n, body rate w_n, body angular acceleration a_n, and the vibration's rotation vector phi
and displacement d in nominal body axes:
    R = R_n Exp(phi),  p = p_n + R_n d,  omega = Exp(phi)ᵀ w_n + J_r(phi) phi',
    p'' = p_n'' + R_n (d'' + 2 w_n × d' + a_n × d + w_n × (w_n × d)),  f = Rᵀ (p'' - g).
Everything is exact at any time, so camera, depth and IMU can be driven by the same motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.imu import GRAVITY_M_S2
from vio.simulation.path import NominalPath
from vio.simulation.vibration import Vibration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MotionState:
    """State of the body at n instants."""

    T_world_body: Array
    """(n, 4, 4)"""
    velocity_m_s: Array
    """(n, 3) in the world."""
    acceleration_m_s2: Array
    """(n, 3) in the world, without gravity."""
    gyro_rad_s: Array
    """(n, 3) angular rate in body axes."""
    specific_force_m_s2: Array
    """(n, 3) in body axes: what an accelerometer feels, +9.81 upward at rest."""


@dataclass(frozen=True)
class CapsuleMotion:
    """A continuous motion, defined from 2 s before the first frame to 2 s after the last."""

    nominal: NominalPath
    vibration: Vibration

    def evaluate(self, t_s: ArrayLike) -> MotionState:
        """State at times (n,) [s after the first frame], in any order."""
        t = np.asarray(t_s, float)
        R_n, w, alpha = self.nominal.rotation(t), self.nominal.body_rate(t, 1), self.nominal.body_rate(t, 2)
        offset, offset1, offset2 = self.vibration(t)
        d, d1, d2 = offset[:, 3:], offset1[:, 3:], offset2[:, 3:]
        turn = se3.so3_exp(offset[:, :3])
        R = R_n @ turn
        position = self.nominal.position_m(t) + _rotate(R_n, d)
        velocity = self.nominal.position_m(t, 1) + _rotate(R_n, d1 + np.cross(w, d))
        shaken = d2 + 2 * np.cross(w, d1) + np.cross(alpha, d) + np.cross(w, np.cross(w, d))
        acceleration = self.nominal.position_m(t, 2) + _rotate(R_n, shaken)
        gyro = _rotate_back(turn, w) + _rotate(se3.so3_right_jacobian(offset[:, :3]), offset1[:, :3])
        force = _rotate_back(R, acceleration + np.array([0.0, 0.0, GRAVITY_M_S2]))
        return MotionState(se3.transform(R, position), velocity, acceleration, gyro, force)


def _rotate(R: Array, v: Array) -> Array:
    return (R @ v[:, :, None])[:, :, 0]


def _rotate_back(R: Array, v: Array) -> Array:
    return (v[:, None, :] @ R)[:, 0, :]
