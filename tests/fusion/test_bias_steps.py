"""A bias that steps is found, named and let go there alone; what moves otherwise is not taken for a step."""

import importlib
from dataclasses import replace

import numpy as np
import pytest

from fusion import refine
from fusion.chain_engine import ChainEngine
from fusion.config import SolverConfig
from fusion.run_folder import Provenance, write_run
from fusion.run_states import read_refinement
from vio.errors import EstimationError
from vio.metrics import ate, nees
from vio.sensor_faults import with_bias_drift, with_bias_step

GYRO, ACCEL = np.array([0.02, -0.01, 0.01]), np.array([0.15, -0.1, 0.08])


@pytest.fixture(scope="module")
def made(examine):
    """1000 frames, and the error of their refinement as they are."""
    made = examine("small-bowel", "gaussian", 3, 1000 / 3, 3104)
    refined = refine(made.recording, made.motions)
    assert refined.imu.bias_steps == ()
    return made, ate(refined.trajectory, refined.truth).rmse_m


def stepped(made, at_s, gyro=0.0, accel=0.0, recording=None):
    """The recording whose biases step `at_s` after its first frame."""
    recording = recording or made.recording
    imu = with_bias_step(recording.imu, at_s - recording.imu_t_s[0], gyro * GYRO, accel * ACCEL)
    return replace(recording, imu=imu)


def error(size, sd, true):
    """The largest over the axes, in sds."""
    return np.max(np.abs(np.array(size) - true) / sd)


@pytest.mark.parametrize("gyro, accel, at_s, words", [
    (1.0, 0.0, 211.4, "the gyro's bias steps by 1.40"), (0.0, 1.0, 96.2, "the accelerometer's bias steps by 0.19"),
    (-0.1, 0.0, 170.0, "the gyro's bias steps by 0.1"),
], ids=["gyro", "accelerometer", "a tenth of the gyro's"])
def test_a_step_costs_the_trajectory_nothing(made, gyro, accel, at_s, words):
    examination, clean_m = made
    refined = refine(stepped(examination, at_s, gyro, accel), examination.motions)
    step, = refined.imu.bias_steps
    assert step.start_s <= at_s <= step.end_s < step.start_s + 5 and step.in_words().startswith(words)
    assert error(step.gyro_rad_s, step.gyro_sd_rad_s, gyro * GYRO) < 4 and max(step.gyro_sd_rad_s) < 1e-4
    assert error(step.accel_m_s2, step.accel_sd_m_s2, accel * ACCEL) < 4 and max(step.accel_sd_m_s2) < 5e-3
    assert refined.scale.policy == "free" and refined.imu.chi2_per_dof < 0.75 and refined.fallback_reason is None
    assert ate(refined.trajectory, refined.truth).rmse_m < 1.3 * clean_m
    assert np.nanmean(nees(refined.trajectory, refined.truth)) < 1.6


def test_two_steps_survive_a_kill_a_run_folder_and_gtsam(made, tmp_path, monkeypatch, configured):
    examination, clean_m = made
    recording = stepped(examination, 240.0, accel=1.0, recording=stepped(examination, 120.0, gyro=1.0))
    refined = refine(recording, examination.motions, resume=tmp_path / "kept")
    assert [step.start_s <= at_s <= step.end_s for step, at_s in zip(refined.imu.bias_steps, (120.0, 240.0),
                                                                     strict=True)] == [True, True]
    monkeypatch.setattr(ChainEngine, "solve", None)  # what is finished is not solved again
    again = refine(recording, examination.motions, resume=tmp_path / "kept")
    assert again.imu == refined.imu
    np.testing.assert_array_equal(again.trajectory.cov, refined.trajectory.cov)
    monkeypatch.undo()
    summary = write_run(refined, tmp_path / "RUN", Provenance(["refine"], configured(), {}))
    assert read_refinement(tmp_path / "RUN").imu == refined.imu
    assert "gyro's bias steps" in summary["imu"]["bias_steps"][0]["words"]

    def refuse(*_):
        raise EstimationError("graph: the linear system is indeterminate (frame 7)")

    monkeypatch.setattr(ChainEngine, "uncertainty", refuse)
    native = refine(recording, examination.motions)
    assert native.fallback_reason.endswith("solved by gtsam") and native.scale.policy == "free"
    assert ate(native.trajectory, native.truth).rmse_m < 1.5 * clean_m


def test_a_step_in_a_long_recording_costs_no_stretch_its_imu(made, configured):
    examination, clean_m = made
    chunked = configured(estimator="graph", solver=SolverConfig(chunk_frames=200, overlap_frames=30))
    refined = refine(stepped(examination, 150.0, gyro=1.0), examination.motions, chunked)
    step, = refined.imu.bias_steps
    assert step.start_s <= 150.0 <= step.end_s and refined.fallback_reason is None
    assert ate(refined.trajectory, refined.truth).rmse_m < 1.3 * clean_m


def test_what_is_no_step_is_not_called_one(made):
    """Walking drives the free scale to a hundredfold where everything agrees but the motions; warming is gradual."""
    examination, _ = made
    warm = replace(examination.recording, imu=with_bias_drift(examination.recording.imu, GYRO, ACCEL, 300.0))
    looked_at = importlib.import_module("fusion.graph_estimator")
    for recording in (examination.shaken_unseen(0.02, 1.7), warm):
        with pytest.MonkeyPatch.context() as patch:
            find, seen = looked_at.find_bias_changes, []
            patch.setattr(looked_at, "find_bias_changes", lambda *a, find=find, seen=seen: seen.append(1) or find(*a))
            assert refine(recording, examination.motions).imu.bias_steps == ()
            assert seen
