"""Camera against IMU, and motions against their claims: what is measured, what is corrected, what is refused."""

import importlib
import json
from dataclasses import replace

import numpy as np
import pytest

from fusion import RefineConfig, refine
from fusion.camera_imu import compared_pairs, measure_camera_imu, read_camera_imu
from fusion.chain_engine import ChainEngine
from fusion.engine import Begin
from fusion.graph_estimator import GraphEstimator
from fusion.motion_noise import translation_noise
from fusion.native_engine import NativeEngine
from fusion.problem import build_problem
from fusion.report.words import sentences
from fusion.solve import linear_graph
from fusion.stages import Stages
from fusion.summary import summarize
from vio import se3
from vio.errors import CalibrationError, ImuError, MotionsError
from vio.metrics import ate
from vio.recording import Recording
from vio.sensor_faults import with_clock_jump, with_dead_axis, with_swapped_axes, with_time_shift


def turned(recording: Recording, degrees: list[float]) -> Recording:
    calibration = recording.calibration
    T = calibration.T_body_camera @ se3.transform(se3.so3_exp(np.deg2rad(degrees)), np.zeros(3))
    return replace(recording, calibration=replace(calibration, T_body_camera=T))


def measured(recording, motions):
    problem = build_problem(recording, motions)
    return measure_camera_imu(problem, compared_pairs(problem))


@pytest.mark.parametrize(("degrees", "shift_s"), [([0, 0, 0], 0.0), ([3.0, -1.0, 0.5], 0.02), ([-8.0, 6.0, 9.0], -0.05),
                                                  ([0.0, 2.0, 0.0], 0.2)])
def test_a_wrong_calibration_is_measured_within_what_is_claimed(examination, degrees, shift_s):
    wrong = turned(examination.recording, degrees)
    found = measured(replace(wrong, imu=with_time_shift(wrong.imu, shift_s)), examination.motions)
    left = se3.so3_log(se3.so3_exp(np.deg2rad(degrees)) @ se3.so3_exp(found.rotation_rad))
    assert (np.abs(left) < 3.5 * found.rotation_sd_rad).all() and found.rotation_sd_rad.max() < np.deg2rad(0.5)
    assert abs(found.time_offset_s - shift_s) < 3.5 * found.time_offset_sd_s < 0.02
    assert found.rotation_significant == any(degrees) and found.offset_significant == (shift_s != 0)
    assert found.rotation_noise == pytest.approx(1.0, abs=0.15)


def test_errors_that_hang_together_are_not_taken_for_knowledge(examination):
    """A network's rotations err alike for some frames; claimed as if they did not, offsets came out up to 5 sds off."""
    motions, truth = examination.motions, examination.recording.truth_at_frames()
    T_true = se3.inverse(truth.T_world_body[:-1]) @ truth.T_world_body[1:]
    T_true = se3.inverse(examination.recording.calibration.T_body_camera) @ T_true @ \
        examination.recording.calibration.T_body_camera
    assert len(T_true) == len(motions.T_i_j)
    off = []
    for seed in range(12):
        lasting = np.repeat(np.random.default_rng(seed).standard_normal((len(T_true) // 8 + 1, 3)), 8, axis=0)
        error = np.deg2rad(0.5) * lasting[:len(T_true)]
        T, cov = motions.T_i_j.copy(), motions.cov.copy()
        T[:, :3, :3] = T_true[:, :3, :3] @ se3.so3_exp(error)
        cov[:, :3], cov[:, :, :3] = 0.0, 0.0
        cov[:, :3, :3] = np.deg2rad(0.5) ** 2 * np.eye(3)
        found = measured(examination.recording, replace(motions, T_i_j=T, cov=cov))
        off.append(np.r_[found.rotation_rad / found.rotation_sd_rad, found.time_offset_s / found.time_offset_sd_s])
    assert np.sqrt(np.mean(np.square(off))) < 1.6  # measured 1.3; 1.9 as if they were independent


def test_a_correction_gives_the_track_of_the_right_calibration_and_says_so(examination, refined):
    wrong = turned(examination.recording, [4.0, 0.0, -3.0])
    corrected = refine(replace(wrong, imu=with_time_shift(wrong.imu, 0.03)), examination.motions)
    assert corrected.camera_imu.applied and "degrees against the calibration" in corrected.camera_imu.reason
    assert corrected.time_offset_s == pytest.approx(0.03, abs=0.008) and not refined.camera_imu.applied
    assert ate(corrected.trajectory, corrected.truth).rmse_m < 2 * ate(refined.trajectory, refined.truth).rmse_m
    summary = json.loads(json.dumps(summarize(corrected), allow_nan=False))
    again = read_camera_imu(summary["camera_imu"], 1.0)
    assert again.reason == corrected.camera_imu.reason
    assert (again.rotation_rad == corrected.camera_imu.rotation_rad).all()
    text = dict(sentences(corrected, summary, None))["Camera and IMU"]
    assert "corrected" in text and "clock is +" in text


def test_rotations_from_the_gyro_are_not_compared_with_it(examination):
    same = refine(examination.recording, replace(examination.motions, meta={"rotation": "gyro"}))
    assert same.camera_imu.pairs == 0 and "come from the gyro" in same.camera_imu.reason


@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_a_wrong_noise_card_changes_nothing(examination, refined, factor):
    """Claimed standard deviations three times too small or too large, noticed and undone."""
    card = replace(examination.motions, cov=examination.motions.cov * factor**2)
    result = refine(examination.recording, card)
    assert result.motion_noise == pytest.approx((1 / factor, 1 / factor), rel=0.15)
    assert np.linalg.norm(result.trajectory.positions_m - refined.trajectory.positions_m, axis=1).max() < 2e-3
    np.testing.assert_allclose(result.scale.log_sd, refined.scale.log_sd, rtol=0.2)
    assert "corrected" in dict(sentences(result, summarize(result), None))["Motions"]


def test_translations_alone_may_be_claimed_wrongly(examination):
    cov = examination.motions.cov.copy()
    cov[:, 3:, 3:] *= 2.5**2
    result = refine(examination.recording, replace(examination.motions, cov=cov))
    assert result.motion_noise[0] == 1.0 and 0.3 < result.motion_noise[1] < 0.6


def test_the_redundancy_is_that_of_the_dense_hat_matrix(short, monkeypatch):
    """tr(P) by probes against the full projection of the same linear system."""
    problem = build_problem(short.recording, short.motions)
    estimator = GraphEstimator(problem, RefineConfig(), Stages())
    estimator.engine = NativeEngine()
    fixed = estimator._fixed_pass(estimator._start(problem.scale_log_mean, 1.0), problem.scale_log_mean)
    term = replace(fixed.term, huber=None)
    values = fixed.solution.values
    gaussian = linear_graph(fixed.model, values, term)
    A, b = gaussian.jacobian()
    rows = len(b) - 6 * len(term.motions) + (6 * np.arange(len(term.motions))[:, None] + np.arange(3, 6)).ravel()
    hat = A @ np.linalg.pinv(A)
    expected = np.sqrt((b[rows] ** 2).sum() / (len(rows) - np.trace(hat[np.ix_(rows, rows)])))
    module = importlib.import_module("fusion.motion_noise")
    monkeypatch.setattr(module, "LEAST_REDUNDANCY", 0.0)
    monkeypatch.setattr(module, "LEAST_SHARE", 0.0)
    monkeypatch.setattr(module, "LEAST_MOTIONS", 0)
    begin = Begin(fixed.model, values)
    factor = translation_noise(estimator.engine, begin, term, np.random.default_rng(0))
    assert factor == pytest.approx(expected, rel=0.25)
    chain = GraphEstimator(problem, RefineConfig(), Stages())
    fixed = chain._fixed_pass(chain._start(problem.scale_log_mean, 1.0), problem.scale_log_mean)
    again = translation_noise(chain.engine, Begin(fixed.model, fixed.solution.values), term, np.random.default_rng(0))
    assert isinstance(chain.engine, ChainEngine) and again == pytest.approx(factor, rel=0.02)


UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])


def upside_down(recording):
    imu = recording.imu
    return replace(recording, imu=replace(imu, gyro_rad_s=imu.gyro_rad_s @ UPSIDE_DOWN,
                                          accel_m_s2=imu.accel_m_s2 @ UPSIDE_DOWN))


def standing(motions):
    return replace(motions, T_i_j=np.broadcast_to(np.eye(4), motions.T_i_j.shape).copy())


def shuffled(motions):
    return replace(motions, T_i_j=motions.T_i_j[np.random.default_rng(0).permutation(len(motions))])


@pytest.mark.parametrize(("spoil", "kind", "words"), [
    (lambda r, m: (turned(r, [0, 0, 180]), m), CalibrationError, ["180 degrees", "T_BS", "correct it"]),
    (lambda r, m: (upside_down(r), m), CalibrationError, ["180 degrees", "IMU upside down", "+0.00"]),
    (lambda r, m: (replace(r, imu=with_clock_jump(r.imu, 50.0, 0.3)), m), ImuError,
     ["its clock jumps by +", "between", "mend the stamps"]),
    (lambda r, m: (r, standing(m)), MotionsError, ["stand still while the gyro turns", "measure again"]),
    (lambda r, m: (r, shuffled(m)), MotionsError, ["do not follow the gyro", "limit 30 %", "measure again"]),
    *[(lambda r, m, s=s, a=a: (replace(r, imu=with_dead_axis(r.imu, s, a)), m), ImuError,
       [f"{name} {'xyz'[a]} is dead"])
      for s, name in (("gyro", "gyro"), ("accel", "accelerometer")) for a in range(3)],
    *[(lambda r, m, s=s, a=a, b=b: (replace(r, imu=with_swapped_axes(r.imu, s, a, b)), m), ImuError,
       [f"{name} {'xyz'[a]} and {'xyz'[b]} are swapped"])
      for s, name in (("gyro", "gyro"), ("accel", "accelerometer")) for a, b in ((0, 1), (0, 2), (1, 2))],
])
def test_what_contradicts_is_refused_by_name(examination, spoil, kind, words):
    recording, motions = spoil(examination.recording, examination.motions)
    with pytest.raises(kind) as caught:
        refine(recording, motions)
    message = str(caught.value)
    assert caught.value.exit_code == 3 and "\n" not in message
    for word in words:
        assert word in message, message
