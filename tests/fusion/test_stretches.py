"""A stretch whose inertial data are wrong costs that stretch its inertial data, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from fusion import refine
from fusion import scale as scale_policy
from fusion.chain_engine import ChainEngine
from fusion.config import SolverConfig
from fusion.stretches import Stretch, contradicted
from vio.errors import EstimationError
from vio.metrics import ate

CHUNK = 150


@pytest.fixture(scope="module")
def long(examine):
    return examine("small-bowel", "gaussian", 2, 250.0, 211)


@pytest.fixture(scope="module")
def chunked(configured):
    return configured(estimator="graph", solver=SolverConfig(chunk_frames=CHUNK, overlap_frames=30))


@pytest.fixture(scope="module")
def clean_ate_m(long, chunked):
    refined = refine(long.recording, long.motions, chunked)
    assert refined.fallback_reason is None
    return ate(refined.trajectory, long.recording.truth_at_frames(), "se3").rmse_m


def spoiled(recording, sensor, begin_s, end_s, change):
    values = getattr(recording.imu, sensor).copy()
    inside = (recording.imu_t_s > begin_s) & (recording.imu_t_s < end_s)
    values[inside] = change(values[inside], recording.imu_t_s[inside, None])
    return replace(recording, imu=replace(recording.imu, **{sensor: values}))


@pytest.mark.parametrize("sensor, change, words", [
    ("accel_m_s2", lambda a, t: a + 0.5 * np.sin(2.0 * t), "the accelerometer serves for the direction of gravity"),
    ("gyro_rad_s", lambda w, t: w + 0.35, "the IMU is left out"),
], ids=["shaken", "turning gyro"])
def test_only_the_stretch_falls_back(long, chunked, clean_ate_m, sensor, change, words):
    recording = spoiled(long.recording, sensor, 112.0, 145.0, change)
    refined = refine(recording, long.motions, chunked)
    assert refined.estimator == "graph" and refined.scale.policy == "free" and refined.imu.inflation == 1.0
    assert f"frames 300 to 450: {words}" in refined.fallback_reason
    assert "frames 0 to" not in refined.fallback_reason
    truth = long.recording.truth_at_frames()
    alone = ate(refined.motions_only, truth, "se3").rmse_m
    assert ate(refined.trajectory, truth, "se3").rmse_m < min(8 * clean_ate_m, 0.5 * alone)


def test_a_stretch_that_cannot_be_solved_says_so_and_the_rest_goes_on(long, chunked, monkeypatch):
    from fusion import chain_start

    solve, seen = chain_start.chain_gauss_newton, []

    def failing(model, state, *rest):
        seen.append(float(model.steps.free_fall.sum()))
        if len(seen) % 4 == 2 and model.steps.free_fall.all():
            raise EstimationError("graph: the cost is nan after 0 iterations")
        return solve(model, state, *rest)

    monkeypatch.setattr(chain_start, "chain_gauss_newton", failing)
    refined = refine(long.recording, long.motions, chunked)
    assert refined.estimator == "graph"
    assert "frames 150 to 300: the IMU is left out (graph: the cost is nan" in refined.fallback_reason


def test_a_majority_is_the_policys_business():
    good, bad = Stretch(0, 10, 0.4), Stretch(10, 20, 900.0)
    assert contradicted([good, good, good, bad]) == [bad]
    assert contradicted([good, bad, bad]) == [] and contradicted([]) == [] and contradicted([good]) == []
    assert contradicted([good, good, good, Stretch(0, 1, np.inf, "x")])[0].reason == "x"
    assert contradicted([Stretch(0, 1, 3.0)] * 5 + [Stretch(1, 2, 12.0)]) == []  # four times the others


def test_where_the_chain_fails_gtsam_solves(long, monkeypatch, configured):
    def refuse(*_):
        raise EstimationError("graph: the linear system is indeterminate (frame 7)")

    monkeypatch.setattr(ChainEngine, "uncertainty", refuse)
    refined = refine(long.recording, long.motions, configured(estimator="graph"))
    assert refined.estimator == "graph" and refined.fallback_reason.endswith("(frame 7); solved by gtsam")
    assert refined.scale.policy == "free" and refined.imu.chi2_per_dof < scale_policy.CALM_CHI2
