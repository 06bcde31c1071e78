"""Samples of a trajectory's joint uncertainty, held against the covariances they must have."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import S, X

from fusion import chain, ekf, estimate, joint, joint_graph, native_engine, refine
from fusion.chain_engine import ChainEngine
from fusion.config import ScaleConfig
from fusion.joint import JointSamples, checkpoints
from fusion.joint_graph import sample_graph
from fusion.problem import build_problem
from fusion.run_folder import Provenance, write_run
from fusion.run_states import read_refinement

MANY = 4000
TOLERANCE = 6 / np.sqrt(MANY)


@pytest.fixture
def many(monkeypatch) -> None:
    for module in (chain, ekf, joint, joint_graph):
        monkeypatch.setattr(module, "SAMPLES", MANY)


@pytest.fixture
def on_gtsam(monkeypatch) -> None:
    monkeypatch.setattr(ChainEngine, "suits", lambda problem: False)


def check_covariance(draws: np.ndarray, cov: np.ndarray) -> None:
    """Sampled and exact covariance agree to sampling error, in units of the standard deviations."""
    sd = np.sqrt(np.diag(cov))
    sampled = draws.T @ draws / len(draws)
    np.testing.assert_allclose(sampled / np.outer(sd, sd), cov / np.outer(sd, sd), atol=TOLERANCE)


@pytest.mark.parametrize("policy", ["free", "fixed"])
def test_graph_samples_have_gtsams_joint_covariance(short, configured, many, on_gtsam, monkeypatch, policy):
    caught = {}

    def catch(gaussian, nodes, segments, rng):
        caught.update(gaussian=gaussian, nodes=nodes, segments=segments)
        return sample_graph(gaussian, nodes, segments, rng)

    monkeypatch.setattr(native_engine, "sample_graph", catch)
    scale = ScaleConfig(policy=policy, segment_s=5.0)
    refine(short.recording, short.motions, configured(estimator="graph", scale=scale))
    drawn = sample_graph(caught["gaussian"], caught["nodes"], caught["segments"], np.random.default_rng(3))
    tree = caught["gaussian"].eliminateMultifrontal(gtsam.Ordering.MetisGaussianFactorGraph(caught["gaussian"]))
    for a, b in ((3, 4), (2, 35), (10, 30)):
        cov = tree.jointMarginalCovariance([X(a), X(b)]).fullMatrix()
        check_covariance(np.hstack([drawn.xi[:, a], drawn.xi[:, b]]), cov)
    if policy == "free":
        segment = caught["segments"]
        assert segment[30] > segment[2]
        cov = tree.jointMarginalCovariance([S(segment[2]), S(segment[30]), X(30)]).fullMatrix()
        check_covariance(np.column_stack([drawn.log_scale[:, [2, 30]], drawn.xi[:, 30]]), cov)


@pytest.mark.parametrize("chain_suits", [True, False])
def test_wide_motions_are_sampled_too(short, configured, many, monkeypatch, chain_suits):
    """Every other frame joined as well: the band is wider, the covariances still gtsam's own."""
    m = short.motions
    wide = replace(m, t_i_s=np.r_[m.t_i_s, m.t_i_s[:-1]], t_j_s=np.r_[m.t_j_s, m.t_j_s[1:]],
                   T_i_j=np.r_[m.T_i_j, m.T_i_j[:-1] @ m.T_i_j[1:]], cov=np.r_[m.cov, 4 * m.cov[:-1]], snr=None)
    monkeypatch.setattr(ChainEngine, "suits", lambda problem: chain_suits)
    refined = refine(short.recording, wide, configured(estimator="graph"))
    for k in (5, 20, 35):
        check_covariance(refined.joint.xi[:, k], refined.trajectory.cov[k])


@pytest.mark.parametrize("estimator", ["graph", "ekf"])
def test_samples_have_the_covariances_that_are_reported(short, configured, many, estimator):
    refined = refine(short.recording, short.motions, configured(estimator=estimator, scale=ScaleConfig(policy="fixed")))
    for k in (1, 17, 35):
        check_covariance(refined.joint.xi[:, k], refined.trajectory.cov[k])
    assert refined.joint.log_scale[:, 9].std() == pytest.approx(refined.log_scale_sd[9], rel=0.03)


def test_chained_motions_have_samples_too(short, many):
    found = estimate.motions_estimate(build_problem(short.recording, short.motions), short.motions, np.eye(4), 0.2)
    for k in (1, 17, 35):
        check_covariance(found.joint.xi[:, k], found.cov[k])


@pytest.mark.parametrize("policy", ["free", "fixed"])
def test_a_graph_too_wide_for_a_band_is_sampled_by_gtsam(short, configured, many, on_gtsam, monkeypatch, policy):
    monkeypatch.setattr(joint_graph, "LARGEST_BAND", 100)
    refined = refine(short.recording, short.motions, configured(estimator="graph", scale=ScaleConfig(policy=policy)))
    for k in (5, 20, 35):
        check_covariance(refined.joint.xi[:, k], refined.trajectory.cov[k])
    assert refined.joint.log_scale[:, 9].std() == pytest.approx(refined.log_scale_sd[9], rel=0.05)


def test_between_checkpoints_errors_are_interpolated(monkeypatch):
    monkeypatch.setattr(joint, "CHECKPOINTS", 4)
    node = checkpoints(10)
    assert node.tolist() == [0, 3, 6, 9] and checkpoints(3).tolist() == [0, 1, 2]
    xi = np.zeros((1, 4, 6))
    xi[0, :, 3] = node**2
    samples = JointSamples(node, xi, np.zeros((1, 4)))
    found = samples.position_errors(np.tile(np.eye(3), (10, 1, 1)), np.arange(10))[0, :, 0]
    np.testing.assert_allclose(found, np.interp(np.arange(10), node, node**2))


def test_a_run_folder_keeps_what_localisation_needs(examination, refined, configured, tmp_path):
    write_run(refined, tmp_path / "RUN", Provenance(["x"], configured(), {}), examination.motions)
    again = read_refinement(tmp_path / "RUN")
    np.testing.assert_array_equal(again.trajectory.cov, refined.trajectory.cov)
    np.testing.assert_allclose(again.joint.xi, refined.joint.xi, rtol=1e-6)
    assert again.view.camera == refined.view.camera and again.view.first_frame == 0
    assert again.view.prior_log_scale == examination.motions.scale_log_mean
    assert (again.estimator, again.scale, again.imu) == (refined.estimator, refined.scale, refined.imu)
    assert len(again.truth) == len(refined.truth) and again.motions_used == refined.motions_used
