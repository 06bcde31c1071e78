"""Fallback when the graph cannot be solved: an error-state EKF on filterpy, scale held fixed.

filterpy keeps only the ERROR state (21): rotation, velocity, position, gyro bias, accelerometer bias, and
a clone of the previous pose (rotation, position). The nominal state lives outside it. Per frame: clone →
IMU steps → predict → update with the measured motion → fold the error into the nominal state → reset.
The rotation error is in the world frame: R = Exp(theta) R_hat.

Beside the filter, a bundle of sampled errors goes through the same steps: how the errors of all poses hang together.

There is no backward pass: a Rauch-Tung-Striebel smoother over the error state changed the aligned error by at most 1 %
(8 runs of 1000 frames, levels 1 and 5, scale exact: 1.73-2.33 mm filtered, 1.71-2.31 mm smoothed) for twice the work.

Outliers inflate R and are never refused outright: a hard gate that once loses track refuses everything
after. Scale is not estimated: an EKF's free scale is biased and overconfident.
"""

from __future__ import annotations

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray

from fusion.config import InitialConfig
from fusion.estimate import Estimate, add_scale_uncertainty
from fusion.joint import SAMPLES, SEED, JointSamples, checkpoints, square_root, with_assumed_scale
from fusion.problem import Problem
from fusion.result import ScaleConclusion
from vio import se3
from vio.errors import EstimationError
from vio.imu import GRAVITY_M_S2

Array = NDArray[np.float64]

DIM = 21
ROT, VEL, POS, BG, BA, CLONE_ROT, CLONE_POS = (slice(i, i + 3) for i in range(0, 21, 3))
CHI2_6_99, CHI2_6_999 = 16.8, 22.5
GAP_VELOCITY_SD_M_S_RTS, GAP_RATE_SD_RAD_RTS = 0.05, 1.0
"""Random walks of velocity and attitude where the IMU is missing."""
STARTING_STEPS = 3
"""Steps whose median is the first velocity: a filter that starts from rest at speed bends its first steps."""
LOST_SHARE = 0.5
"""Share of motions that may look like outliers; beyond it the filter follows the IMU alone, wherever that leads."""
GRAVITY_WORLD = np.array([0.0, 0.0, -GRAVITY_M_S2])
EYE3 = np.eye(3)


class _CapsuleEkf:
    """Nominal state and the filterpy filter of its error."""

    def __init__(self, problem: Problem, R0: Array, initial: InitialConfig) -> None:
        self.problem = problem
        self.R, self.v, self.p = R0.copy(), np.zeros(3), np.zeros(3)
        self.gyro_bias, self.accel_bias = problem.gyro_bias_rad_s.copy(), np.zeros(3)
        self.R_clone, self.p_clone = self.R, self.p
        self.filter = ExtendedKalmanFilter(dim_x=DIM, dim_z=6)
        self.filter.x = np.zeros(DIM)  # 1-D on purpose: the default (n, 1) silently becomes (n, n)
        P = np.full(DIM, 1e-12)
        P[ROT] = [initial.tilt_sd_rad**2, initial.tilt_sd_rad**2, 1e-12]
        P[VEL], P[BG], P[BA] = (initial.velocity_sd_m_s**2, initial.gyro_bias_sd_rad_s**2,
                                initial.accel_bias_sd_m_s2**2)
        self.filter.P = np.diag(P)
        self.rng = np.random.default_rng(SEED)
        self.errors = self.rng.standard_normal((SAMPLES, DIM)) * np.sqrt(P)

    def predict(self, k: int) -> None:
        """Clone the pose, then carry state and covariance over interval k."""
        self.R_clone, self.p_clone = self.R, self.p
        if self.problem.imu_usable[k]:
            Phi, Q = self._integrate(k)
        else:
            Phi, Q = self._coast(float(self.problem.dt_s[k]))
        clone = np.eye(DIM)
        clone[CLONE_ROT], clone[CLONE_POS] = 0, 0
        clone[CLONE_ROT, ROT], clone[CLONE_POS, POS] = EYE3, EYE3
        F, full_Q = np.eye(DIM), np.zeros((DIM, DIM))
        F[:15, :15], full_Q[:15, :15] = Phi, Q
        self.filter.F, self.filter.Q = F @ clone, full_Q
        self.filter.predict()
        drawn = self.rng.standard_normal((SAMPLES, 15)) @ square_root(Q).T
        self.errors = self.errors @ self.filter.F.T
        self.errors[:, :15] += drawn

    def _integrate(self, k: int) -> tuple[Array, Array]:
        pieces, noise = self.problem.pieces, self.problem.noise
        accel_density = noise.accel_density_m_s2_rthz * self.problem.accel_inflation[k]
        gyro_density = noise.gyro_density_rad_s_rthz * self.problem.gyro_inflation[k]
        walks = noise.gyro_walk_rad_s2_rthz, noise.accel_walk_m_s3_rthz
        rates = np.repeat([gyro_density, accel_density, 0.0, *walks], 3)
        Phi, Q = np.eye(15), np.zeros((15, 15))
        for n in range(pieces.first[k], pieces.first[k + 1]):
            dt = pieces.dt_s[n]
            force = self.R @ (pieces.accel_m_s2[n] - self.accel_bias)
            rate = pieces.gyro_rad_s[n] - self.gyro_bias
            A = np.eye(15)
            A[ROT, BG] = -self.R * dt
            A[VEL, ROT], A[VEL, BA] = -se3.skew(force) * dt, -self.R * dt
            A[POS, VEL] = EYE3 * dt
            A[POS, ROT], A[POS, BA] = -0.5 * dt**2 * se3.skew(force), -0.5 * dt**2 * self.R
            Phi = A @ Phi
            Q = A @ Q @ A.T + np.diag(rates**2 * dt)
            acceleration = force + GRAVITY_WORLD
            self.p = self.p + self.v * dt + 0.5 * acceleration * dt**2
            self.v = self.v + acceleration * dt
            self.R = self.R @ se3.so3_exp(rate * dt)
        return Phi, Q

    def _coast(self, dt: float) -> tuple[Array, Array]:
        """No IMU: constant velocity with generous random walks; the measured motion must do the work."""
        Phi = np.eye(15)
        Phi[POS, VEL] = EYE3 * dt
        noise = self.problem.noise
        rates = np.repeat([GAP_RATE_SD_RAD_RTS, GAP_VELOCITY_SD_M_S_RTS, GAP_VELOCITY_SD_M_S_RTS * dt,
                           noise.gyro_walk_rad_s2_rthz, noise.accel_walk_m_s3_rthz], 3)
        self.p = self.p + self.v * dt
        return Phi, np.diag(rates**2 * dt)

    def update(self, n: int) -> bool:
        """Measured motion n between the clone and now; returns whether it looked like an outlier."""
        z, H, noise = self._innovation(n)
        S = H @ self.filter.P @ H.T + noise
        squared = float(z @ np.linalg.solve(S, z))
        noise = noise * max(1.0, squared / CHI2_6_99) ** 2  # soften, never refuse
        self.filter.update(z, lambda x: H, lambda x: H @ x, R=noise)
        drawn = self.rng.standard_normal((SAMPLES, 6)) @ square_root(noise).T
        self.errors -= (self.errors @ H.T + drawn) @ self.filter.K.T
        self._fold()
        return squared > CHI2_6_999

    def _innovation(self, n: int) -> tuple[Array, Array, Array]:
        """Residual (6,), its Jacobian (6, 21) and noise of motion n, in motion units and camera axes."""
        motions = self.problem.motions
        R_bc, t_bc = motions.T_body_camera[:3, :3], motions.T_body_camera[:3, 3]
        inverse_scale = np.exp(-self.problem.scale_log_mean)
        R_meas, t_meas = motions.R[n], motions.t[n]
        away = self.p - self.p_clone
        R_ij = self.R_clone.T @ self.R
        R_pred = R_bc.T @ R_ij @ R_bc
        t_pred = R_bc.T @ (self.R_clone.T @ away + R_ij @ t_bc - t_bc)
        z = np.r_[se3.so3_log(R_pred.T @ R_meas), R_meas.T @ (t_meas - inverse_scale * t_pred)]
        to_units = inverse_scale * R_meas.T @ R_bc.T @ self.R_clone.T
        lever = self.R @ t_bc
        H = np.zeros((6, DIM))
        H[:3, ROT], H[:3, CLONE_ROT] = R_bc.T @ self.R.T, -R_bc.T @ self.R.T
        H[3:, POS], H[3:, CLONE_POS] = to_units, -to_units
        H[3:, ROT] = -to_units @ se3.skew(lever)
        H[3:, CLONE_ROT] = to_units @ se3.skew(away + lever)
        lower = np.linalg.inv(motions.whiten[n])
        return z, H, lower @ lower.T

    def _fold(self) -> None:
        x = self.filter.x
        if x.shape != (DIM,) or not np.isfinite(x).all():
            raise EstimationError(f"ekf: the error state became {x.shape} or not finite")
        self.R = se3.so3_exp(x[ROT]) @ self.R
        self.v, self.p = self.v + x[VEL], self.p + x[POS]
        self.gyro_bias, self.accel_bias = self.gyro_bias + x[BG], self.accel_bias + x[BA]
        self.filter.x = np.zeros(DIM)
        self.filter.P = 0.5 * (self.filter.P + self.filter.P.T)  # filterpy does not symmetrise

    def pose_cov(self) -> Array:
        """(6, 6) right perturbation in body axes, rotation first."""
        turn = np.zeros((6, DIM))
        turn[:3, ROT] = turn[3:, POS] = self.R.T
        cov: Array = turn @ self.filter.P @ turn.T
        return cov

    def pose_errors(self) -> Array:
        """(S, 6) sampled errors in the terms of `pose_cov`."""
        return np.concatenate([self.errors[:, ROT] @ self.R, self.errors[:, POS] @ self.R], axis=1)


def starting_velocity(problem: Problem, R_world_body_first: Array) -> Array:
    """(3,) velocity of the first node in the world: the median over the first measured steps, for outliers' sake."""
    surest = problem.motions.surest_neighbours(len(problem))[:STARTING_STEPS]
    k = np.flatnonzero(surest >= 0)
    if len(k) == 0:
        return np.zeros(3)
    steps = np.tile(np.eye(4), (len(surest), 1, 1))
    steps[k] = problem.motions.select(surest[k]).body_motion(problem.scale_log_mean)
    T = se3.chain(steps, se3.transform(R_world_body_first, np.zeros(3)))
    velocity: Array = np.median((np.diff(T[:, :3, 3], axis=0) / problem.dt_s[:len(surest), None])[k], axis=0)
    return velocity


def ekf_estimate(problem: Problem, R_world_body_first: Array, initial: InitialConfig) -> Estimate:
    """Filter a whole recording; only motions between neighbouring frames are used.

    Args:
        problem: the checked problem.
        R_world_body_first: (3, 3) levelled attitude of the first node.
        initial: standard deviations of the first state.

    Raises:
        EstimationError: no motion joins neighbours, most looked like outliers, or the state stopped being finite.
    """
    motion_of = problem.motions.surest_neighbours(len(problem))
    updates = int((motion_of >= 0).sum())
    if updates == 0:
        raise EstimationError("ekf: no motion joins two neighbouring frames, and the filter uses no others; "
                              "give such motions or use the graph")
    ekf = _CapsuleEkf(problem, R_world_body_first, initial)
    ekf.v = starting_velocity(problem, R_world_body_first)
    m = len(problem)
    T, cov, v = np.tile(np.eye(4), (m, 1, 1)), np.zeros((m, 6, 6)), np.zeros((m, 3))
    gyro_bias, accel_bias, outliers = np.zeros((m, 3)), np.zeros((m, 3)), []
    node = checkpoints(m)
    kept, sampled = set(node.tolist()), []
    for k in range(m):
        if k > 0:
            ekf.predict(k - 1)
            if motion_of[k - 1] >= 0 and ekf.update(int(motion_of[k - 1])):
                outliers.append(int(motion_of[k - 1]))
        T[k, :3, :3], T[k, :3, 3], v[k] = ekf.R, ekf.p, ekf.v
        cov[k], gyro_bias[k], accel_bias[k] = ekf.pose_cov(), ekf.gyro_bias, ekf.accel_bias
        if k in kept:
            sampled.append(ekf.pose_errors())
    if not np.isfinite(T).all():
        raise EstimationError("ekf: the trajectory is not finite")
    if len(outliers) > LOST_SHARE * updates:
        raise EstimationError(f"ekf: {len(outliers)} of {updates} motions looked like outliers (limit "
                              f"{100 * LOST_SHARE:.0f} %): the IMU disagrees with them and the filter lost track")
    mean, sd = problem.scale_log_mean, problem.scale_log_sd
    reason = "the filter holds scale at its prior: a filter's free scale is biased"
    conclusion = ScaleConclusion("fixed", mean, sd, reason)
    cov = add_scale_uncertainty(T, cov, sd, problem.motions.T_body_camera)
    joint = JointSamples(node, np.stack(sampled, axis=1), np.zeros((SAMPLES, len(node))))
    joint = with_assumed_scale(joint, T, sd, problem.motions.T_body_camera, ekf.rng)
    return Estimate(T, cov, v, gyro_bias, accel_bias, np.full(m, mean), np.full(m, sd), conclusion,
                    np.array(outliers, np.int64), joint=joint)
