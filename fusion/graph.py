"""The native half of the graph: gauge, inertial factors, gap links, scale walk; and how to read a solution.

Keys: X pose, V velocity in the world, B IMU bias (gtsam order: accelerometer, gyro), S log scale of a segment.
The relative motions are not in here: they are linearised in numpy (`scaled_motion.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, S, V, X
from numpy.typing import NDArray

from fusion.chain_state import ChainState
from fusion.config import InitialConfig
from fusion.problem import Problem

Array = NDArray[np.float64]
Values: TypeAlias = "gtsam.Values | ChainState"

ANCHOR_SD_M, ANCHOR_SD_YAW_RAD = 1e-5, 1e-5
"""The first pose defines the world's origin and yaw; the sds only keep the system well conditioned."""
GAP_VELOCITY_SD_M_S_RTS = 0.02
"""Random walk of the velocity where the IMU is missing [m/s/sqrt(s)]."""
BLIND_SPEED_M_S = 0.02
"""Sd of the mean velocity where neither IMU nor motion speaks: a capsule hardly travels faster for long."""
BLIND_GYRO_RAD_S = 2e-4
"""Sd of the gyro's bias where it alone carries the attitude over a long stretch."""


@dataclass(frozen=True)
class Anchor:
    """Prior on the first state of a graph (or of a chunk)."""

    T_world_body: Array
    pose_cov: Array
    """(6, 6) body axes, rotation first."""
    velocity_m_s: Array
    velocity_sd: float
    bias: gtsam.imuBias.ConstantBias
    bias_sd: Array
    """(6,) accelerometer, gyro."""


@dataclass(frozen=True)
class States:
    """Values of M nodes as arrays."""

    R: Array
    p: Array
    v: Array
    accel_bias: Array
    gyro_bias: Array

    @property
    def T_world_body(self) -> Array:
        """(M, 4, 4)"""
        T = np.tile(np.eye(4), (len(self.R), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = self.R, self.p
        return T


def first_anchor(T_world_body: Array, gyro_bias_rad_s: Array, initial: InitialConfig) -> Anchor:
    """The world's definition: position and yaw of the first pose are exact, tilt is only roughly known."""
    R = T_world_body[:3, :3]
    cov = np.zeros((6, 6))
    cov[:3, :3] = R.T @ np.diag([initial.tilt_sd_rad**2, initial.tilt_sd_rad**2, ANCHOR_SD_YAW_RAD**2]) @ R
    cov[3:, 3:] = np.eye(3) * ANCHOR_SD_M**2
    bias_sd = np.array([initial.accel_bias_sd_m_s2] * 3 + [initial.gyro_bias_sd_rad_s] * 3)
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), gyro_bias_rad_s)
    return Anchor(T_world_body, cov, np.zeros(3), initial.velocity_sd_m_s, bias, bias_sd)


def add_anchor(graph: gtsam.NonlinearFactorGraph, node: int, anchor: Anchor) -> None:
    """Pin pose, velocity and bias of one node."""
    noise = gtsam.noiseModel
    pose = gtsam.Pose3(anchor.T_world_body)
    graph.add(gtsam.PriorFactorPose3(X(node), pose, noise.Gaussian.Covariance(anchor.pose_cov)))
    graph.add(gtsam.PriorFactorVector(V(node), anchor.velocity_m_s, noise.Isotropic.Sigma(3, anchor.velocity_sd)))
    graph.add(gtsam.PriorFactorConstantBias(B(node), anchor.bias, noise.Diagonal.Sigmas(anchor.bias_sd)))


def add_imu(graph: gtsam.NonlinearFactorGraph, measurements: list[gtsam.PreintegratedCombinedMeasurements],
            problem: Problem, first: int = 0) -> None:
    """Add the intervals `first` onward; where a gap makes one unusable, only loose links."""
    for k, measurement in enumerate(measurements, first):
        if problem.imu_usable[k]:
            graph.add(gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), measurement))
        else:
            _add_gap_link(graph, problem, k, measurement)


def _add_gap_link(graph: gtsam.NonlinearFactorGraph, problem: Problem, k: int,
                  measurement: gtsam.PreintegratedCombinedMeasurements) -> None:
    dt, noise = float(problem.dt_s[k]), problem.noise
    root = np.sqrt(dt)
    walk = np.array([noise.accel_walk_m_s3_rthz] * 3 + [noise.gyro_walk_rad_s2_rthz] * 3) * root
    if problem.bias_slack is not None:
        walk = np.hypot(walk, np.repeat(problem.bias_slack[k], 3))
    diagonal, isotropic = gtsam.noiseModel.Diagonal.Sigmas, gtsam.noiseModel.Isotropic.Sigma
    graph.add(gtsam.BetweenFactorVector(V(k), V(k + 1), np.zeros(3), isotropic(3, GAP_VELOCITY_SD_M_S_RTS * root)))
    graph.add(gtsam.BetweenFactorConstantBias(B(k), B(k + 1), gtsam.imuBias.ConstantBias(), diagonal(walk)))
    measured = ((problem.motions.i <= k) & (problem.motions.j > k)).any()
    if not measured:
        turned = gtsam.Pose3(measurement.deltaRij(), np.zeros(3)) if gyro_covers(problem, k) else gtsam.Pose3()
        turn_sd = BLIND_GYRO_RAD_S * dt if gyro_covers(problem, k) else np.pi
        sigmas = np.array([min(turn_sd, np.pi)] * 3 + [BLIND_SPEED_M_S * dt] * 3)
        graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), turned, diagonal(sigmas)))


def gyro_covers(problem: Problem, k: int) -> bool:
    """Whether no hole of the IMU touches interval k."""
    return not any(gap.start_s < problem.t_s[k + 1] and gap.end_s > problem.t_s[k] for gap in problem.gaps)


def add_scale_walk(graph: gtsam.NonlinearFactorGraph, segment_t_s: Array, log_mean: float, log_sd: float,
                   walk_per_sqrt_s: float) -> None:
    """Prior on the first segment's log scale and a random walk from segment to segment."""
    isotropic = gtsam.noiseModel.Isotropic.Sigma
    graph.add(gtsam.PriorFactorDouble(S(0), log_mean, isotropic(1, log_sd)))
    for k, step in enumerate(np.diff(segment_t_s)):
        graph.add(gtsam.BetweenFactorDouble(S(k), S(k + 1), 0.0, isotropic(1, walk_per_sqrt_s * np.sqrt(step))))


def insert_states(values: gtsam.Values, T_world_body: Array, v: Array, biases: list[gtsam.imuBias.ConstantBias],
                  first: int = 0) -> None:
    """Insert consecutive nodes from `first` on."""
    for k in range(len(T_world_body)):
        values.insert(X(first + k), gtsam.Pose3(T_world_body[k]))
        values.insert(V(first + k), v[k])
        values.insert(B(first + k), biases[k])


def read_poses(values: Values) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) and positions (M, 3) of all poses, in key order."""
    if isinstance(values, ChainState):
        return values.R, values.p
    flat = gtsam.utilities.extractPose3(values)
    return flat[:, :9].reshape(-1, 3, 3), flat[:, 9:]


def read_states(values: Values, first: int, count: int) -> States:
    """Read `count` nodes from `first` on out of a solution that holds exactly those poses."""
    R, p = read_poses(values)
    if isinstance(values, ChainState):
        return States(R, p, values.v, values.accel_bias, values.gyro_bias)
    nodes = range(first, first + count)
    v = np.array([values.atVector(V(k)) for k in nodes])
    bias = np.array([values.atConstantBias(B(k)).vector() for k in nodes])
    return States(R, p, v, bias[:, :3], bias[:, 3:])


def read_log_scales(values: Values, count: int) -> Array:
    """(count,) log scales of all segments."""
    if isinstance(values, ChainState):
        return values.log_scale
    return np.array([values.atDouble(S(k)) for k in range(count)])
