"""A scale that walks as far as it may is believed, one that is off from the beginning is not; and noise that no
equation checks is not corrected."""

import importlib

import numpy as np
import pytest

from fusion import refine
from fusion.chain_engine import ChainEngine
from fusion.config import ScaleConfig
from fusion.engine import Begin
from fusion.graph_estimator import GraphEstimator
from fusion.motion_noise import translation_noise
from fusion.problem import build_problem
from fusion.scale import GRAVITY_ONLY, FreePass, reasons_against
from fusion.stages import Stages
from vio.metrics import ate
from vio.simulation import T_BODY_CAMERA, network_like_motions, simulate

WALK_PER_SQRT_S = 0.55 / np.sqrt(1000 / 3)


def test_a_long_walk_of_the_scale_is_followed(configured):
    """It moves by seven sds of its prior in the mean, which a walk of that size does in a third of all recordings."""
    recording = simulate("small-bowel", "gaussian", 3, 1000 / 3, 3205).recording
    network = network_like_motions(recording.truth, T_BODY_CAMERA, 4205, scale_walk_per_sqrt_1000_frames=0.55)
    moved = network.true_log_scale.mean() - network.motions.scale_log_mean
    assert moved < -0.6 and network.motions.scale_log_sd == 0.1
    refined = refine(recording, network.motions, configured(scale=ScaleConfig(walk_per_sqrt_s=WALK_PER_SQRT_S)))
    assert refined.scale.policy == "free" and refined.motion_noise == (1.0, 1.0)
    assert np.mean(refined.log_scale[:-1] - network.true_log_scale) == pytest.approx(0, abs=3 * refined.scale.log_sd)
    assert ate(refined.trajectory, refined.truth).rmse_m < 0.15 * ate(refined.motions_only, refined.truth).rmse_m


def test_a_scale_that_is_off_from_the_beginning_is_not_believed(examination):
    problem, config = build_problem(examination.recording, examination.motions), ScaleConfig()
    time_s = np.arange(0.0, 8 * 3600.0, 10.0)

    def objection(log_scale):
        found = FreePass(0.4, problem.scale_log_mean + log_scale, np.full(len(time_s), 0.02), time_s, 0.02, 10.0)
        return reasons_against(found, problem, config)

    assert objection(np.full(len(time_s), 0.4)) is None  # four prior sds
    assert objection(np.minimum(time_s / time_s[-1], 1.0) * 1.5) is None  # three sds of what it may walk in 8 hours
    assert "first 331 s" in objection(np.where(time_s < 400, 0.7, 0.0))
    assert "first 28790 s" in objection(np.where(time_s < 400, 0.0, 2.6))


def test_motions_that_nothing_else_checks_keep_their_noise(examination, configured, monkeypatch):
    problem = build_problem(examination.recording, examination.motions)
    estimator = GraphEstimator(problem, configured(), Stages())
    fixed = estimator._fixed_pass(estimator._start(problem.scale_log_mean, GRAVITY_ONLY), problem.scale_log_mean)
    final = estimator._gated(fixed)
    assert isinstance(estimator.engine, ChainEngine)
    monkeypatch.setattr(importlib.import_module("fusion.motion_noise"), "LEAST_REDUNDANCY", 0.0)
    for seed in range(6):
        assert translation_noise(estimator.engine, Begin(final.model, final.solution.values), final.term,
                                 np.random.default_rng(seed)) == 1.0
