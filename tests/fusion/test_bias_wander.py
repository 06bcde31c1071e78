"""Biases that wander more than the noise card says in some stretches may do so there, and cost nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from fusion import RefineConfig, refine
from fusion.bias_changes import BiasChanges
from fusion.chain_engine import ChainEngine
from fusion.chain_start import inertial_steps
from fusion.config import SolverConfig
from fusion.initialization import first_guess
from fusion.prepare import prepare
from fusion.report import words
from fusion.result import BiasWander
from fusion.run_folder import Provenance, write_run
from fusion.run_states import read_refinement
from fusion.summary import sentences
from vio import se3
from vio.errors import EstimationError
from vio.metrics import ate, nees
from vio.sensor_faults import with_bias_drift

GYRO, ACCEL = (0.02, -0.01, 0.01), (0.3, -0.2, 0.2)


@pytest.fixture(scope="module")
def chunked(configured):
    return configured(estimator="graph", solver=SolverConfig(chunk_frames=200, overlap_frames=30))


@pytest.fixture(scope="module")
def made(examine):
    """1000 frames."""
    return examine("small-bowel", "gaussian", 3, 1000 / 3, 3104)


@pytest.fixture(scope="module")
def clean(made, chunked):
    return refine(made.recording, made.motions, chunked)


def warming(recording, time_constant_s=40.0, gyro=1.0, accel=1.0):
    return replace(recording, imu=with_bias_drift(recording.imu, gyro * np.array(GYRO), accel * np.array(ACCEL),
                                                  time_constant_s))


@pytest.fixture(scope="module")
def warm(made, chunked):
    return refine(warming(made.recording), made.motions, chunked)


def error_m(refined):
    return ate(refined.trajectory, refined.truth).rmse_m


def test_a_sensor_that_warms_up_keeps_its_imu_and_costs_little(clean, warm):
    assert clean.imu.bias_wanders == () and clean.imu.bias_steps == ()
    wander, = warm.imu.bias_wanders
    assert wander.first_frame == 0 and 200 <= wander.last_frame <= 600 and wander.start_s == warm.trajectory.t_s[0]
    assert wander.end_s == warm.trajectory.t_s[wander.last_frame] and warm.imu.bias_steps == ()
    assert wander.in_words().startswith("the accelerometer's and the gyro's biases wander up to ")
    assert warm.fallback_reason is None and warm.scale.policy == "free" and warm.imu.chi2_per_dof < 0.75
    assert error_m(warm) < 1.25 * error_m(clean)
    assert 0.3 < np.nanmean(nees(warm.trajectory, warm.truth)) < 1.4
    true = clean.gyro_bias_rad_s + np.outer(1 - np.exp(-(clean.trajectory.t_s - clean.trajectory.t_s[0]) / 40), GYRO)
    assert np.abs(warm.gyro_bias_rad_s - true)[20:].max() < 2e-3


@pytest.mark.parametrize("time_constant_s", [20.0, 120.0])
def test_however_fast_it_warms(made, chunked, clean, time_constant_s):
    """At 120 s hardly a stretch is left that needs nothing."""
    warm = refine(warming(made.recording, time_constant_s), made.motions, chunked)
    assert warm.imu.bias_wanders[0].first_frame == 0 and warm.fallback_reason is None and warm.scale.policy == "free"
    assert error_m(warm) < 1.4 * error_m(clean) and np.nanmean(nees(warm.trajectory, warm.truth)) < 1.4


def test_only_the_sensor_that_wanders_may(made, chunked, clean):
    warm = refine(warming(made.recording, accel=0.0), made.motions, chunked)
    wander = warm.imu.bias_wanders[0]
    assert wander.gyro_times > 50 and wander.accel_times == 1.0 and "the gyro's bias wanders" in wander.in_words()
    assert error_m(warm) < 1.25 * error_m(clean)


@pytest.mark.parametrize("seed", range(4101, 4107))
def test_sound_sensors_are_left_alone(examine, chunked, seed):
    sound = examine(("small-bowel", "colon")[seed % 2], "gaussian", 1 + seed % 3, 600 / 3, seed)
    refined = refine(sound.recording, sound.motions, chunked)
    assert refined.imu.bias_wanders == () and refined.imu.bias_steps == ()


@pytest.mark.parametrize("part", [False, True], ids=["throughout", "for a while"])
@pytest.mark.parametrize(("amplitude_m", "frequency_hz"), [(0.005, 0.25), (0.001, 1.0), (0.02, 1.7)],
                         ids=["breathing", "shifting", "walking"])
def test_a_body_that_moves_is_no_sensor_that_warms_up(made, chunked, amplitude_m, frequency_hz, part):
    shaken = made.shaken_unseen(amplitude_m, frequency_hz)
    if part:
        t = made.recording.imu_t_s[:, None]
        shaken = made.with_imu(accel_m_s2=np.where((t > 120) & (t < 160), shaken.imu.accel_m_s2,
                                                   made.recording.imu.accel_m_s2))
    refined = refine(shaken, made.motions, chunked)
    assert refined.imu.bias_wanders == () and refined.imu.bias_steps == ()


def test_a_single_stretch_is_the_scale_policys_business(made):
    refined = refine(warming(made.recording), made.motions)
    assert refined.imu.bias_wanders == () and "biases that wander" in refined.scale.reason


def test_gtsam_lets_biases_wander_alike(made, chunked, warm, monkeypatch):
    def refuse(*_):
        raise EstimationError("graph: the linear system is indeterminate (frame 7)")

    monkeypatch.setattr(ChainEngine, "uncertainty", refuse)
    native = refine(warming(made.recording), made.motions, chunked)
    assert native.fallback_reason.endswith("solved by gtsam") and native.imu.bias_wanders == warm.imu.bias_wanders
    sd = np.sqrt(np.einsum("nii->ni", warm.trajectory.cov)[1:, 3:])
    apart = np.abs(native.trajectory.positions_m - warm.trajectory.positions_m)[1:]
    assert (apart / sd).max() < 0.5
    np.testing.assert_allclose(np.einsum("nii->ni", native.trajectory.cov)[1:, 3:], sd**2, rtol=0.25)


def test_it_is_told_and_survives_a_kill_and_a_run_folder(made, warm, chunked, tmp_path, monkeypatch):
    kept = refine(warming(made.recording), made.motions, chunked, resume=tmp_path / "kept")
    monkeypatch.setattr(ChainEngine, "solve", None)  # what is finished is not solved again
    again = refine(warming(made.recording), made.motions, chunked, resume=tmp_path / "kept")
    assert again.imu == kept.imu == warm.imu
    np.testing.assert_array_equal(again.trajectory.cov, warm.trajectory.cov)
    summary = write_run(warm, tmp_path / "RUN", Provenance(["refine"], chunked, {}))
    assert read_refinement(tmp_path / "RUN").imu == warm.imu
    told, = summary["imu"]["bias_wanders"]
    assert told["words"] == warm.imu.bias_wanders[0].in_words()
    assert f"imu: {told['words']}; it may do so there" in sentences(summary)
    spoken = dict(words.sentences(warm, summary, None))
    assert any("biases wander up to" in text and "between 0.0 and" in text for text in spoken.values())


def test_stretches_that_follow_each_other_are_told_as_one():
    def wander(first, last, accel, gyro):
        return BiasWander(first, last, first / 3, last / 3, accel, gyro)

    changes = BiasChanges((), (wander(0, 300, 1.0, 9.0), wander(300, 600, 3.0, 2.0), wander(900, 1200, 1.0, 4.0)))
    assert changes.told_wanders == (wander(0, 600, 3.0, 9.0), wander(900, 1200, 1.0, 4.0))
    assert changes.told_wanders[1].in_words().startswith("the gyro's bias wanders up to 4 times")


def test_a_chunk_starts_from_the_bias_that_the_motions_show(made):
    """Held at one bias, the gyro of a sensor that warms up would have turned the chunk's end away."""
    recording, problem, _ = prepare(warming(made.recording, 100.0, gyro=4.0), made.motions)
    wandering = replace(problem, bias_slack=np.ones((len(problem) - 1, 2)))
    steps, truth = inertial_steps(problem), recording.truth_at_frames().rotations
    turned = []
    for given in (problem, wandering):
        R = first_guess(given, given.motions, steps.rotations(given.gyro_bias_rad_s), RefineConfig().initial,
                        given.scale_log_mean, 0, None)[0]
        off = np.swapaxes(R[0].T @ R, 1, 2) @ truth[0].T @ truth
        turned.append(np.linalg.norm(se3.so3_log(off), axis=1).max())
    assert turned[1] < 0.6 < 2 * turned[1] < turned[0], turned
