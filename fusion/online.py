"""A live capsule: fixed-lag smoothing frame by frame, with the factors of the graph.

Each frame adds its inertial factor and its measured motions to gtsam's incremental fixed-lag smoother; what is older
than the lag is marginalised. Scale is held at its prior, as in the filter: freeing it needs the whole recording. A pose
is known twice: filtered, when its frame arrives, and smoothed, when it leaves the lag.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import SupportsFloat, SupportsIndex, SupportsInt, TypeAlias

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray

from fusion.config import InitialConfig, RobustConfig
from fusion.graph import BLIND_SPEED_M_S, GAP_VELOCITY_SD_M_S_RTS, Anchor, add_anchor, first_anchor
from fusion.preintegration import make_bias, preintegrate
from fusion.vibration import vibration_inflation
from vio import se3
from vio.errors import EstimationError, ImuError, MotionsError
from vio.imu import GAP_LIMIT_S, ImuNoise, ImuPieces, ImuSamples, split_at_frames

Array = NDArray[np.float64]
Stamps: TypeAlias = "dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex]"
"""Key → time, in gtsam's types."""

RELINEARIZE_THRESHOLD = 3e-3
"""Change of a variable (rad, m, m/s) above which its factors are linearised anew."""
WILDFIRE_THRESHOLD = 1e-5
"""Change [rad, m, m/s] below which a correction is not carried further back; gtsam's own, 1e-3, is a millimetre."""
FORESEEN = 1.2
"""Frame intervals that are looked ahead: frames do not come like clockwork."""
NS_PER_S = 1e9


@dataclass(frozen=True)
class OnlineMotion:
    """A measured motion of the camera that ends at the frame it comes with."""

    frame: int
    """Number of the frame that it starts at, counted from 0 in the order of arrival."""
    T_i_j: Array
    """(4, 4) camera at the newest frame in the camera at the earlier one, motion units."""
    cov: Array
    """(6, 6) right perturbation, rotation first."""


@dataclass(frozen=True)
class OnlineState:
    """One frame as known at some moment."""

    frame: int
    t_s: float
    T_world_body: Array
    """(4, 4)"""
    cov: Array
    """(6, 6) body axes, rotation first; scale taken as exact."""
    velocity_m_s: Array
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array


@dataclass(frozen=True)
class OnlineAnswer:
    """What a new frame brought."""

    newest: OnlineState
    """The new frame, filtered."""
    settled: tuple[OnlineState, ...]
    """Frames that leave the lag with this one, as last known: nothing will change them any more."""
    latency_s: float
    """From the frame's arrival to this answer."""


class OnlineEstimator:
    """Estimates the newest pose from inertial samples and motions as they arrive.

    Feed samples with `add_imu` and then each frame with `add_frame`; call `between_frames` once its answer is used.
    Times are seconds on the frames' clock.

    Args:
        noise: continuous densities and walks of the IMU.
        T_body_camera: (4, 4) camera pose in the body.
        scale_log_mean: ln(metres per motion unit), held.
        lag_s: how long a frame stays open to correction.
        robust: its `huber` is where the motions' loss bends.
        initial: standard deviations of the first state.
    """

    def __init__(self, noise: ImuNoise, T_body_camera: Array, scale_log_mean: float, lag_s: float = 30.0,
                 robust: RobustConfig | None = None, initial: InitialConfig | None = None) -> None:
        if not (np.isfinite(lag_s) and lag_s > 0):
            raise EstimationError(f"online: the lag is {lag_s} s, must be a positive number of seconds")
        self.noise, self.lag_s = noise, lag_s
        self.robust, self.initial = robust or RobustConfig(), initial or InitialConfig()
        self.resets = 0
        """How often the smoother had to begin anew from its last state."""
        self._T_body_camera, self._scale = np.asarray(T_body_camera, float), float(np.exp(scale_log_mean))
        self._imu = np.zeros((0, 7))
        self._times: list[float] = []
        self._newest: OnlineState | None = None
        self._oldest = 0
        self._read: dict[int, OnlineState] = {}
        self._smoother = self._make_smoother()

    def add_imu(self, t_s: Array, gyro_rad_s: Array, accel_m_s2: Array) -> None:
        """Take samples (N,), (N, 3), (N, 3), later than all before.

        Raises:
            ImuError: times that do not increase, or values that are not finite.
        """
        rows = np.column_stack([np.asarray(t_s, float), gyro_rad_s, accel_m_s2])
        if not np.isfinite(rows).all():
            raise ImuError(f"online imu: a value near {rows[0, 0]:.3f} s is not finite; drop that sample")
        if (np.diff(np.concatenate([self._imu[-1:, 0], rows[:, 0]])) <= 0).any():
            raise ImuError(f"online imu: times do not increase near {rows[0, 0]:.6f} s; sort them, drop repeated ones")
        self._imu = np.concatenate([self._imu, rows])

    def add_frame(self, t_s: float, motions: Sequence[OnlineMotion] = ()) -> OnlineAnswer | None:
        """Take a frame with the motions that end at it; None for the first frame, which has no interval.

        Raises:
            ImuError: no samples reach over the first interval; later holes are bridged.
            MotionsError: a motion starts at a frame that is not within the lag.
            EstimationError: the frame is not later than the one before, or no state is finite any more.
        """
        begun = time.perf_counter()
        if self._times and not t_s > self._times[-1]:
            raise EstimationError(f"online: frame at {t_s:.6f} s is not after {self._times[-1]:.6f} s; drop it")
        for motion in motions:
            if not self._oldest <= motion.frame < len(self._times):
                raise MotionsError(f"online: a motion starts at frame {motion.frame}, open are {self._oldest} to "
                                   f"{len(self._times) - 1}; give motions within the lag of {self.lag_s:g} s")
        self._times.append(float(t_s))
        if len(self._times) == 1:
            return None
        settled = self._settle()
        self._extend(motions)
        return OnlineAnswer(self._newest_state(), settled, time.perf_counter() - begun)

    def between_frames(self) -> None:
        """Read what will leave the lag with the next frame, should it come as soon as the last one did.

        Nothing changes it until then. Without this call the next answer is the same and comes later.
        """
        if len(self._times) > 1:
            leaves = self._times[-1] + FORESEEN * (self._times[-1] - self._times[-2]) - self.lag_s
            open_frames = range(self._oldest, len(self._times) - 1)
            self._read = {k: self._state(k) for k in takewhile(lambda k: self._times[k] < leaves, open_frames)}

    def open_states(self) -> list[OnlineState]:
        """All frames within the lag, oldest first, as known now."""
        return [self._state(k) for k in range(self._oldest, len(self._times))]

    def _extend(self, motions: Sequence[OnlineMotion]) -> None:
        """Add the newest frame's states and factors."""
        k = len(self._times) - 2
        pieces = self._cut()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        anchor = self._last_anchor(pieces)
        stamps: Stamps = {}
        if k == 0:
            add_anchor(graph, 0, anchor)
            self._insert(values, stamps, 0, gtsam.NavState(gtsam.Pose3(anchor.T_world_body), anchor.velocity_m_s),
                         anchor.bias)
        guess = self._add_interval(graph, pieces, k, anchor, bool(motions))
        for motion in motions:
            graph.add(self._motion_factor(motion, k + 1))
        self._insert(values, stamps, k + 1, guess, anchor.bias)
        try:
            self._smoother.update(graph, values, stamps)
        except RuntimeError:  # indeterminate: gtsam has no class of its own for it
            self._begin_anew(pieces, k, anchor)

    def _begin_anew(self, pieces: ImuPieces | None, k: int, anchor: Anchor) -> None:
        """Go on from the last state with the inertial factor alone."""
        self.resets += 1
        self._smoother, self._oldest = self._make_smoother(), k
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        stamps: Stamps = {}
        add_anchor(graph, k, anchor)
        state = gtsam.NavState(gtsam.Pose3(anchor.T_world_body), anchor.velocity_m_s)
        self._insert(values, stamps, k, state, anchor.bias)
        self._insert(values, stamps, k + 1, self._add_interval(graph, pieces, k, anchor, False), anchor.bias)
        try:
            self._smoother.update(graph, values, stamps)
        except RuntimeError as error:
            raise EstimationError(f"online: frame {k + 1} cannot be solved ({str(error).strip().splitlines()[0]})"
                                  ) from None

    def _cut(self) -> ImuPieces | None:
        """The IMU of the newest interval, None where it has a hole; samples older than the lag are forgotten."""
        last, now = self._times[-2:]
        bias = np.zeros(3) if self._newest is None else self._newest.gyro_bias_rad_s
        first = int(np.searchsorted(self._imu[:, 0], min(last, now - self.lag_s)))
        self._imu = self._imu[max(first - 2, 0):]
        near = self._imu[max(int(np.searchsorted(self._imu[:, 0], last)) - 2, 0):]
        slack = 1.5 / self.noise.rate_hz
        if self._newest is not None and (len(near) < 2 or near[-1, 0] < now - slack or near[0, 0] > last + slack):
            return None
        pieces = split_at_frames(_samples(near), near[:, 0], np.array([last, now]), bias)
        return pieces if float(pieces.longest_s[0]) <= GAP_LIMIT_S else None

    def _add_interval(self, graph: gtsam.NonlinearFactorGraph, pieces: ImuPieces | None, k: int, anchor: Anchor,
                      measured: bool) -> gtsam.NavState:
        """The inertial factor of interval k, or loose links across a hole, and the state it predicts."""
        last, now = self._times[-2:]
        state = gtsam.NavState(gtsam.Pose3(anchor.T_world_body), anchor.velocity_m_s)
        if pieces is not None:
            accel, gyro = self._inflation()
            measurement, = preintegrate(pieces, self.noise, anchor.bias.accelerometer(), anchor.bias.gyroscope(),
                                        accel, gyro, (0, 1))
            graph.add(gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), measurement))
            return measurement.predict(state, anchor.bias)
        root = np.sqrt(now - last)
        diagonal = gtsam.noiseModel.Diagonal.Sigmas
        walk = np.repeat([self.noise.accel_walk_m_s3_rthz, self.noise.gyro_walk_rad_s2_rthz], 3) * root
        graph.add(gtsam.BetweenFactorVector(V(k), V(k + 1), np.zeros(3),
                                            diagonal(np.full(3, GAP_VELOCITY_SD_M_S_RTS * root))))
        graph.add(gtsam.BetweenFactorConstantBias(B(k), B(k + 1), gtsam.imuBias.ConstantBias(), diagonal(walk)))
        if not measured:
            blind = np.repeat([np.pi, BLIND_SPEED_M_S * (now - last)], 3)
            graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), gtsam.Pose3(), diagonal(blind)))
        return state

    def _inflation(self) -> tuple[Array, Array]:
        """Factors (1,), (1,) on the densities for vibration, judged against the samples of the lag."""
        inside = [t for t in self._times if t >= self._imu[0, 0]]
        accel, gyro = vibration_inflation(_samples(self._imu), self._imu[:, 0], np.array(inside), self.noise)
        return accel[-1:], gyro[-1:]

    def _motion_factor(self, motion: OnlineMotion, k: int) -> gtsam.NonlinearFactor:
        """The body's metric motion, with its covariance; Cauchy's loss lets go of outliers, as no gate comes later."""
        T = np.array(motion.T_i_j, float)
        T[:3, 3] *= self._scale
        unit = np.repeat([1.0, self._scale], 3)
        to_body = se3.adjoint(self._T_body_camera) * unit
        noise = gtsam.noiseModel.Gaussian.Covariance(to_body @ motion.cov @ to_body.T)
        loss = gtsam.noiseModel.mEstimator.Cauchy.Create(self.robust.huber)
        body = self._T_body_camera @ T @ se3.inverse(self._T_body_camera)
        return gtsam.BetweenFactorPose3(X(motion.frame), X(k), gtsam.Pose3(body),
                                        gtsam.noiseModel.Robust.Create(loss, noise))

    def _last_anchor(self, pieces: ImuPieces | None) -> Anchor:
        """The last state: of the first frame, levelled by the mean specific force, or as estimated."""
        if self._newest is None:
            if pieces is None:
                raise ImuError("online imu: a hole within the first frame interval; begin where samples are whole")
            up = (pieces.accel_m_s2 * pieces.dt_s[:, None]).sum(axis=0)
            T = se3.transform(_levelled(up), np.zeros(3))
            return first_anchor(T, np.zeros(3), self.initial)
        s = self._newest
        return Anchor(s.T_world_body, s.cov, s.velocity_m_s, 0.003, make_bias(s.accel_bias_m_s2, s.gyro_bias_rad_s),
                      np.repeat([0.02, 2e-4], 3))

    def _insert(self, values: gtsam.Values, stamps: Stamps, k: int, state: gtsam.NavState,
                bias: gtsam.imuBias.ConstantBias) -> None:
        values.insert(X(k), state.pose())
        values.insert(V(k), state.velocity())
        values.insert(B(k), bias)
        stamps |= {key(k): self._times[k] for key in (X, V, B)}

    def _newest_state(self) -> OnlineState:
        self._newest = self._state(len(self._times) - 1)
        if not np.isfinite(self._newest.T_world_body).all():
            raise EstimationError(f"online: the pose of frame {self._newest.frame} is not finite")
        return self._newest

    def _settle(self) -> tuple[OnlineState, ...]:
        """The frames that fall out of the lag now, read before the smoother forgets them."""
        first = self._oldest
        while self._oldest < len(self._times) - 2 and self._times[self._oldest] < self._times[-1] - self.lag_s:
            self._oldest += 1
        settled = tuple(self._read.get(k) or self._state(k) for k in range(first, self._oldest))
        self._read = {}
        return settled

    def _state(self, k: int) -> OnlineState:
        smoother = self._smoother
        bias = smoother.calculateEstimateConstantBias(B(k))
        return OnlineState(k, self._times[k], smoother.calculateEstimatePose3(X(k)).matrix(),
                           smoother.marginalCovariance(X(k)), smoother.calculateEstimateVector(V(k)),
                           bias.gyroscope(), bias.accelerometer())

    def _make_smoother(self) -> gtsam.IncrementalFixedLagSmoother:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(RELINEARIZE_THRESHOLD)
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(WILDFIRE_THRESHOLD))
        params.relinearizeSkip = 1
        params.setFactorization("QR")  # the first frames, held to 1e-5 m, are too stiff for Cholesky
        return gtsam.IncrementalFixedLagSmoother(self.lag_s, params)


def _levelled(up_body: Array) -> Array:
    """The attitude (3, 3) of zero yaw-like turn that brings a specific force (3,) upright."""
    up = up_body / np.linalg.norm(up_body)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    if sine < 1e-9:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return se3.so3_exp(axis / sine * np.arctan2(sine, up[2]))


def _samples(rows: Array) -> ImuSamples:
    return ImuSamples((rows[:, 0] * NS_PER_S).astype(np.int64), rows[:, 1:4], rows[:, 4:])
