"""A recording replayed as if it arrived live: the online estimator's results as a `Refinement`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fusion.config import RefineConfig
from fusion.estimate import Estimate, add_scale_uncertainty
from fusion.online import OnlineAnswer, OnlineEstimator, OnlineMotion, OnlineState
from fusion.problem import Problem, build_problem
from fusion.refine import conclude
from fusion.result import OnlineConclusion, Refinement, ScaleConclusion
from fusion.stages import Stages
from vio.motions import RelativeMotions, match_frames
from vio.recording import Recording
from vio.trajectory import Trajectory


def online_refine(recording: Recording, motions: RelativeMotions, config: RefineConfig | None = None,
                  lag_s: float = 30.0, progress: Callable[[int, int], None] | None = None) -> Refinement:
    """Refine frame by frame with nothing but the past, as for a live capsule.

    Args:
        recording: frames' times, IMU and calibration.
        motions: measured motions; none may reach back further than the lag.
        config: its `robust.huber` and `initial` are used.
        lag_s: how long a frame stays open to correction.
        progress: called with frames done and frames in all.

    Returns:
        The trajectory of poses as they left the lag, and in `online` the latency and the poses as each frame arrived.

    Raises:
        VioError: an input that cannot be used, in one line.
        EstimationError: no state is finite any more.
    """
    config = config or RefineConfig()
    stages = Stages()
    with stages("checks"):
        problem = build_problem(recording, motions)
    estimator = OnlineEstimator(recording.calibration.imu_noise, problem.motions.T_body_camera,
                                motions.scale_log_mean, lag_s, config.robust, config.initial)
    with stages("online"):
        answers, settled = _replay(recording, motions, problem, estimator, progress)
    filtered = [settled[0], *(answer.newest for answer in answers)]
    online = OnlineConclusion(lag_s, _latency_ms(answers), estimator.resets, _trajectory(filtered, problem, motions))
    note = f"the smoother began anew {estimator.resets} times from its last state" if estimator.resets else None
    refined = conclude(recording, motions, problem, _estimate(settled, problem, motions), "graph", note, stages)
    return replace(refined, online=online)


def _replay(recording: Recording, motions: RelativeMotions, problem: Problem, estimator: OnlineEstimator,
            progress: Callable[[int, int], None] | None) -> tuple[list[OnlineAnswer], list[OnlineState]]:
    """Every frame's answer (from the second on), and every frame as it left the lag."""
    ending = _by_last_frame(recording, motions, problem)
    imu_t_s, imu = recording.imu_t_s, recording.imu
    fed = int(np.searchsorted(imu_t_s, problem.t_s[0])) - 2
    fed = max(fed, 0)
    answers: list[OnlineAnswer] = []
    settled: list[OnlineState] = []
    for k, t in enumerate(problem.t_s):
        upto = int(np.searchsorted(imu_t_s, t, side="right"))
        estimator.add_imu(imu_t_s[fed:upto], imu.gyro_rad_s[fed:upto], imu.accel_m_s2[fed:upto])
        fed = max(upto, fed)
        answer = estimator.add_frame(float(t), ending[k])
        if answer is not None:
            answers.append(answer)
            settled += answer.settled
            estimator.between_frames()
        if progress is not None:
            progress(k + 1, len(problem))
    return answers, settled + estimator.open_states()


def _by_last_frame(recording: Recording, motions: RelativeMotions, problem: Problem) -> dict[int, list[OnlineMotion]]:
    i, j = match_frames(motions, recording.frame_t_s)
    ending: dict[int, list[OnlineMotion]] = defaultdict(list)
    for n in range(len(motions)):
        first = int(i[n]) - problem.first_frame
        ending[int(j[n]) - problem.first_frame].append(OnlineMotion(first, motions.T_i_j[n], motions.cov[n]))
    return ending


def _latency_ms(answers: list[OnlineAnswer]) -> dict[str, float]:
    ms = 1e3 * np.array([answer.latency_s for answer in answers])
    return {"p50": float(np.median(ms)), "p99": float(np.percentile(ms, 99)), "max": float(ms.max())}


def _trajectory(states: list[OnlineState], problem: Problem, motions: RelativeMotions) -> Trajectory:
    """Poses with covariances, widened for the scale that was assumed."""
    T = np.array([state.T_world_body for state in states])
    cov = np.array([state.cov for state in states])
    cov = 0.5 * (cov + np.swapaxes(cov, 1, 2))
    cov = add_scale_uncertainty(T, cov, motions.scale_log_sd, problem.motions.T_body_camera)
    return Trajectory(problem.t_s, T, cov)


def _estimate(states: list[OnlineState], problem: Problem, motions: RelativeMotions) -> Estimate:
    trajectory, m = _trajectory(states, problem, motions), len(states)
    mean, sd = motions.scale_log_mean, motions.scale_log_sd
    reason = "online, scale is held at its prior: freeing it needs the whole recording"
    return Estimate(
        trajectory.T_world_body, np.asarray(trajectory.cov), np.array([s.velocity_m_s for s in states]),
        np.array([s.gyro_bias_rad_s for s in states]), np.array([s.accel_bias_m_s2 for s in states]),
        np.full(m, mean), np.full(m, sd), ScaleConclusion("fixed", mean, sd, reason), np.zeros(0, np.int64))
