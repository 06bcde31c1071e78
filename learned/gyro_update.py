"""The network's motion corrected by what the gyro says about its rotation: one Kalman update per pair.

For whoever uses motions without a graph. A graph that fuses the IMU itself must get the network's own motions: the same
gyro counted twice makes it overconfident, and hides the gyro's bias from it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.imu import GAP_LIMIT_S, preintegrate_rotation, split_at_frames
from vio.recording import Recording

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class GyroRotations:
    """What a recording's gyro says about the camera's rotation between its frames.

    Args:
        recording: with an IMU log that covers the frames.
        sd_rad: deviation per axis between neighbouring frames, bias included.

    Raises:
        ImuError: the inertial samples do not reach over all frames.
    """

    def __init__(self, recording: Recording, sd_rad: float) -> None:
        self.sd_rad = sd_rad
        pieces = split_at_frames(recording.imu, recording.imu_t_s, recording.frame_t_s)
        R_body_camera = recording.calibration.T_body_camera[:3, :3]
        self.R_k_k1 = R_body_camera.T @ preintegrate_rotation(pieces, np.zeros(3)) @ R_body_camera
        self.known = pieces.longest_s <= GAP_LIMIT_S
        """(M,) no hole of the stream between frames k and k + 1."""

    def correct(self, T_i_j: Array, cov: Array, i: Indices, j: Indices) -> tuple[Array, Array, int]:
        """Corrected motions between frames i and j, their covariances, and how many stayed as they were."""
        spans = list(zip(i, j, strict=True))
        R = np.array([np.linalg.multi_dot([np.eye(3), *self.R_k_k1[a:b], np.eye(3)]) for a, b in spans])
        known = np.array([bool(self.known[a:b].all()) for a, b in spans])
        T, P = T_i_j.copy(), cov.copy()
        T[known], P[known] = with_gyro(T[known], P[known], R[known], self.sd_rad)
        return T, P, int((~known).sum())


def with_gyro(T_i_j: Array, cov: Array, R_i_j_gyro: Array, sd_rad: float) -> tuple[Array, Array]:
    """Motions (N, 4, 4) and covariances (N, 6, 6) after the update.

    The error ξ of T has covariance P and its rotation part is measured: z = Log(R_netᵀ R_gyro) with deviation
    `sd_rad` per axis. K = P Hᵀ (H P Hᵀ + R)⁻¹ with H = [I 0], T ← T Exp(K z), P ← (I - K H) P. Where rotation and
    translation errors are correlated, the translation is corrected too.

    Args:
        T_i_j: network's motions.
        cov: their covariances, rotation first.
        R_i_j_gyro: (N, 3, 3) integrated gyro, camera axes.
        sd_rad: deviation of the gyro's rotation per axis, bias included.
    """
    z = se3.so3_log(np.swapaxes(T_i_j[:, :3, :3], 1, 2) @ R_i_j_gyro)
    innovation = cov[:, :3, :3] + sd_rad**2 * np.eye(3)
    gain = np.swapaxes(np.linalg.solve(innovation, cov[:, :3, :]), 1, 2)
    xi = (gain @ z[:, :, None])[:, :, 0]
    updated = cov - gain @ cov[:, :3, :]
    return T_i_j @ se3.exp(xi), 0.5 * (updated + np.swapaxes(updated, 1, 2))
