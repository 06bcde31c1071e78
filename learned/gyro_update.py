"""The network's motion corrected by what the gyro says about its rotation, the gyro's own bias estimated first.

For whoever uses motions without a graph. A graph that fuses the IMU itself must get the network's own motions: the same
gyro counted twice makes it overconfident, and hides the gyro's bias from it.

Bias and motions are estimated together: the bias from gravity and from all of the network's rotations
(`vio.gyro_bias`), then, given the bias, every motion by one Kalman update. What is left unknown of the bias is one
error that all motions share; each carries its part of it, and `meta` says how large it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.errors import ImuError
from vio.gyro_bias import GyroBias, SeenRotations, estimate_gyro_bias, gyro_noise_var
from vio.imu import GAP_LIMIT_S, preintegrate_rotation, split_at_frames
from vio.recording import Recording

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FEWEST_SAMPLES = 3


@dataclass(frozen=True)
class CorrectedMotions:
    """N motions after the gyro's update."""

    T_i_j: Array
    """(N, 4, 4)"""
    cov: Array
    """(N, 6, 6) each with its part of the bias's uncertainty."""
    bias: GyroBias
    """In body axes."""
    without_gyro: int
    """Motions that stayed as they were, for the stream has a hole there."""

    def meta(self) -> dict[str, Any]:
        """What goes along with the motions."""
        return {"pairs_without_gyro": self.without_gyro,
                "gyro_bias": {"bias_rad_s": self.bias.bias_rad_s.tolist(), "cov": self.bias.cov.tolist(),
                              "force_sd_m_s2": self.bias.force_sd_m_s2,
                              "rotation_spread": self.bias.rotation_spread}}


class GyroRotations:
    """What a recording's gyro says about the camera's rotation between its frames.

    Args:
        recording: with an IMU log that covers the frames.
        first: first frame.
        end: end, exclusive; None = the recording's.

    Raises:
        ImuError: fewer than three inertial samples, or samples that do not reach over all frames.
    """

    def __init__(self, recording: Recording, first: int = 0, end: int | None = None) -> None:
        if len(recording.imu) < FEWEST_SAMPLES:
            raise ImuError(f"recording {recording.name}: {len(recording.imu)} inertial samples, too few to correct "
                           "rotations by; add imu0/data.csv, or use the network's rotations")
        self.t_s = recording.frame_t_s[first:end]
        self.noise, self.interval_s = recording.calibration.imu_noise, np.diff(self.t_s)
        self.R_body_camera = recording.calibration.T_body_camera[:3, :3]
        self.pieces = split_at_frames(recording.imu, recording.imu_t_s, self.t_s)
        self.noise_var = gyro_noise_var(recording.imu, recording.imu_t_s, self.t_s, self.noise)
        self.known = self.pieces.longest_s <= GAP_LIMIT_S
        """(M,) no hole of the stream between frames k and k + 1."""

    def between_frames(self, bias_rad_s: Array) -> Array:
        """(M, 3, 3) rotations from every frame to the next in camera axes, freed of a bias in body axes."""
        R = self.R_body_camera
        return np.asarray(R.T @ preintegrate_rotation(self.pieces, bias_rad_s) @ R)

    def bias(self, T_i_j: Array, cov: Array, i: Indices, j: Indices) -> GyroBias:
        """The gyro's bias, from gravity and from motions between neighbouring frames among those given."""
        order = np.argsort(i, kind="stable")
        chosen, R = order[(j - i)[order] == 1], self.R_body_camera
        seen = SeenRotations(i[chosen], R @ T_i_j[chosen, :3, :3] @ R.T, R @ cov[chosen, :3, :3] @ R.T)
        return estimate_gyro_bias(self.pieces, self.interval_s, self.known, self.noise, seen)

    def correct(self, T_i_j: Array, cov: Array, i: Indices, j: Indices) -> CorrectedMotions:
        """Motions between frames i and j, counted from the first one asked for, after the update.

        Args:
            T_i_j: (N, 4, 4) the network's motions.
            cov: (N, 6, 6) their covariances.
            i: (N,) earlier frames.
            j: (N,) later frames.
        """
        bias = self.bias(T_i_j, cov, i, j)
        steps, spans = self.between_frames(bias.bias_rad_s), list(zip(i, j, strict=True))
        R = np.array([np.linalg.multi_dot([np.eye(3), *steps[a:b], np.eye(3)]) for a, b in spans])
        variance = np.array([self.noise_var[a:b].sum() for a, b in spans])
        known = np.array([bool(self.known[a:b].all()) for a, b in spans])
        lasted = (self.t_s[j] - self.t_s[i])[:, None, None]
        shared = lasted**2 * (self.R_body_camera.T @ bias.cov @ self.R_body_camera)
        T, P = T_i_j.copy(), cov.copy()
        T[known], P[known] = with_gyro(T[known], P[known], R[known], variance[known], shared[known])
        return CorrectedMotions(T, P, bias, int((~known).sum()))


def with_gyro(T_i_j: Array, cov: Array, R_i_j_gyro: Array, noise_var: Array, shared_cov: Array) -> tuple[Array, Array]:
    """Motions (N, 4, 4) and covariances (N, 6, 6) after the update.

    The error ξ of T has covariance P and its rotation part is measured: z = Log(R_netᵀ R_gyro) with variance
    `noise_var` per axis. K = P Hᵀ (H P Hᵀ + R)⁻¹ with H = [I 0], T ← T Exp(K z), P ← (I - K H) P + K S Kᵀ, S being what
    is not known of the gyro's bias. Where rotation and translation errors are correlated, the translation is corrected
    too.

    Args:
        T_i_j: network's motions.
        cov: their covariances, rotation first.
        R_i_j_gyro: (N, 3, 3) integrated gyro freed of its bias, camera axes.
        noise_var: (N,) of the gyro's own noise per axis [rad²].
        shared_cov: (N, 3, 3) of the turn that the bias's error makes [rad²].
    """
    z = se3.so3_log(np.swapaxes(T_i_j[:, :3, :3], 1, 2) @ R_i_j_gyro)
    innovation = cov[:, :3, :3] + noise_var[:, None, None] * np.eye(3)
    gain = np.swapaxes(np.linalg.solve(innovation, cov[:, :3, :]), 1, 2)
    xi = (gain @ z[:, :, None])[:, :, 0]
    updated = cov - gain @ cov[:, :3, :] + gain @ shared_cov @ np.swapaxes(gain, 1, 2)
    return T_i_j @ se3.exp(xi), 0.5 * (updated + np.swapaxes(updated, 1, 2))
