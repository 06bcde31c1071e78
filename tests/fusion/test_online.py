"""The online estimator against the batch solution, its own causality, and broken streams."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fusion import OnlineEstimator, OnlineMotion, online_refine, read_refinement
from fusion.chain_engine import ChainEngine
from fusion.cli import main
from fusion.config import RobustConfig
from fusion.problem import build_problem
from fusion.solve import MotionTerm
from vio import se3
from vio.consistency import fix_gauge
from vio.errors import EstimationError, ImuError, MotionsError
from vio.formats.asl import write_asl
from vio.metrics import ate, nees
from vio.sensor_faults import with_gap
from vio.trajectory import Trajectory


@pytest.fixture(scope="module")
def online(examination):
    return online_refine(examination.recording, examination.motions, lag_s=20.0)


def test_it_is_better_than_the_motions_and_knows_how_good(examination, online):
    truth = examination.recording.truth_at_frames()
    alone = ate(online.motions_only, truth, "sim3").rmse_m  # scale is held for all three
    smoothed, filtered = (ate(t, truth, "sim3").rmse_m for t in (online.trajectory, online.online.filtered))
    assert smoothed < 0.5 * alone and filtered < 0.5 * alone
    assert (online.scale.policy, online.estimator, online.fallback_reason) == ("fixed", "graph", None)
    for trajectory in (online.trajectory, online.online.filtered):
        assert 0.1 < np.nanmean(nees(trajectory, truth)) < 4
    assert 0 < online.online.latency_ms["p50"] <= online.online.latency_ms["p99"] <= online.online.latency_ms["max"]


def test_a_filtered_pose_knows_nothing_of_the_future(examination, online):
    n = 150
    cut = replace(examination.motions, **{name: getattr(examination.motions, name)[:n]
                                          for name in ("t_i_s", "t_j_s", "T_i_j", "cov")})
    past = online_refine(examination.recording, cut, lag_s=20.0)
    np.testing.assert_allclose(past.online.filtered.T_world_body[1:],
                               online.online.filtered.T_world_body[1:n + 1], atol=1e-9)
    assert np.abs(past.trajectory.positions_m[-1] - online.trajectory.positions_m[n]).max() > 0


def test_with_an_endless_lag_it_ends_where_the_batch_ends(examine, configured):
    """One Gaussian cost, two optimisers; the smoother stops relinearising within its threshold."""
    clean = examine("small-bowel", "gaussian", 2, 30.0, 207, network={"outliers": 0.0})
    cut, n = replace(clean.motions, scale_log_sd=1e-9), len(clean.motions)
    config = configured(robust=RobustConfig(huber=1e6))
    online = online_refine(clean.recording, cut, config, lag_s=1e6)
    problem = build_problem(clean.recording, cut)
    engine = ChainEngine()
    begin = engine.begin(problem, config, problem.scale_log_mean, 1.0)
    term = MotionTerm(problem.motions, None, problem.scale_log_mean, config.robust.huber, np.ones(n))
    solution = engine.solve(begin, term, 50, 1e-12)
    sure = engine.uncertainty(replace(begin, values=solution.values), term, None, np.random.default_rng(0))
    sd = np.sqrt(np.diagonal(sure.cov, axis1=1, axis2=2))
    batch = fix_gauge(online.trajectory, Trajectory(problem.t_s, solution.values.T_world_body))
    off = se3.log(se3.inverse(online.trajectory.T_world_body) @ batch.T_world_body)
    assert np.abs(off[1:] / sd[1:]).max() < 0.5
    ratio = np.sqrt(np.diagonal(online.trajectory.cov, axis1=1, axis2=2))[5:] / sd[5:]
    assert ratio.min() > 0.8 and ratio.max() < 1.25


def test_holes_are_bridged(examination):
    """Four seconds without IMU, two of them without motions either."""
    t = examination.motions.t_i_s
    keep = ~((t > 41.0) & (t < 43.0))
    holed = replace(examination.motions, **{name: getattr(examination.motions, name)[keep]
                                            for name in ("t_i_s", "t_j_s", "T_i_j", "cov")})
    recording = replace(examination.recording, imu=with_gap(examination.recording.imu, 40.0, 4.0))
    refined = online_refine(recording, holed, lag_s=10.0)
    truth = examination.recording.truth_at_frames()
    inside = np.searchsorted(truth.t_s, [40.0, 43.5])
    sd = np.sqrt(np.diagonal(refined.online.filtered.cov, axis1=1, axis2=2))[:, 3:].max(axis=1)
    assert sd[inside[1]] > 3 * sd[inside[0]]
    assert np.nanmean(nees(refined.trajectory, truth)) < 4


def estimator_of(examination, **options):
    calibration = examination.recording.calibration
    return OnlineEstimator(calibration.imu_noise, calibration.T_body_camera, -0.2, **options)


def test_what_is_read_between_frames_is_what_would_have_been_read(examination):
    recording, motions, frames = examination.recording, examination.motions, 60
    t, imu_t, imu = recording.frame_t_s, recording.imu_t_s, recording.imu
    upto, settled = int(np.searchsorted(imu_t, t[frames])), []
    for early in (False, True):
        estimator, read = estimator_of(examination, lag_s=5.0), []
        estimator.add_imu(imu_t[:upto], imu.gyro_rad_s[:upto], imu.accel_m_s2[:upto])
        for k in range(frames):
            seen = [OnlineMotion(k - 1, motions.T_i_j[k - 1], motions.cov[k - 1])] if k else []
            answer = estimator.add_frame(t[k], seen)
            read += answer.settled if answer else ()
            if early:
                estimator.between_frames()
                assert k < 20 or len(estimator._read) in (1, 2)
        settled.append(read)
    assert [state.frame for state in settled[0]] == [state.frame for state in settled[1]] == list(range(frames - 16))
    for one, other in zip(*settled, strict=True):
        np.testing.assert_array_equal(one.T_world_body, other.T_world_body)
        np.testing.assert_array_equal(one.cov, other.cov)


def test_broken_streams_are_refused_in_one_line(examination):
    recording, motions = examination.recording, examination.motions
    t, imu_t, imu = recording.frame_t_s, recording.imu_t_s, recording.imu
    estimator = estimator_of(examination, lag_s=2.0)
    upto = int(np.searchsorted(imu_t, t[12]))
    estimator.add_imu(imu_t[:upto], imu.gyro_rad_s[:upto], imu.accel_m_s2[:upto])
    with pytest.raises(ImuError, match="times do not increase near"):
        estimator.add_imu(imu_t[upto - 1:upto + 1], imu.gyro_rad_s[:2], imu.accel_m_s2[:2])
    with pytest.raises(ImuError, match="is not finite; drop that sample"):
        estimator.add_imu(imu_t[upto:upto + 1], np.full((1, 3), np.nan), imu.accel_m_s2[:1])
    for k in range(12):
        estimator.add_frame(t[k], [OnlineMotion(k - 1, motions.T_i_j[k - 1], motions.cov[k - 1])] if k else [])
    with pytest.raises(EstimationError, match=r"is not after .* drop it"):
        estimator.add_frame(t[11])
    with pytest.raises(MotionsError, match=r"starts at frame 0, open are \d+ to 11; give motions within the lag"):
        estimator.add_frame(t[12], [OnlineMotion(0, motions.T_i_j[0], motions.cov[0])])
    with pytest.raises(ImuError, match="imu: no samples"):
        blind = estimator_of(examination)
        blind.add_frame(t[0])
        blind.add_frame(t[1])
    with pytest.raises(EstimationError, match="the lag is 0 s"):
        estimator_of(examination, lag_s=0)


def test_the_command_writes_the_same_folder(short, tmp_path, capsys):
    write_asl(short.recording, tmp_path / "REC")
    short.motions.save(tmp_path / "motions.npz")
    command = ["refine", str(tmp_path / "REC"), "--motions", str(tmp_path / "motions.npz"), "--online", "--lag", "5",
               "--out", str(tmp_path / "RUN"), "--json"]
    assert main(command) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["online"]["lag_s"] == 5 and summary["online"]["resets"] == 0
    assert set(summary["accuracy"]) == {"refined", "motions", "filtered"}
    again = read_refinement(tmp_path / "RUN")
    assert again.online.latency_ms == summary["online"]["latency_ms"]
    assert len(again.online.filtered) == len(again.trajectory) == 36
