"""Network-like motions against the statistics they claim."""

import numpy as np
import pytest

from vio import se3
from vio.errors import SimulationError
from vio.simulation import T_BODY_CAMERA, CapsuleMotion, network_like_motions
from vio.simulation.anatomy import make_anatomy
from vio.simulation.path import moving_path
from vio.simulation.vibration import NoVibration
from vio.trajectory import Trajectory


def error_per_motion(truth, network):
    """Right-perturbation error (N, 6) of the motions against truth, at the true scale."""
    T = truth.T_world_body @ T_BODY_CAMERA
    step = se3.inverse(T[:-1]) @ T[1:]
    step[:, :3, 3] *= np.exp(-network.true_log_scale)[:, None]
    return se3.log(se3.inverse(step) @ network.motions.T_i_j)


@pytest.fixture(scope="module")
def long_truth():
    motion = CapsuleMotion(moving_path(make_anatomy("small-bowel", 1), "natural", 4000.0, np.random.default_rng(1)),
                           NoVibration())
    t = np.arange(12_000) / 3
    return Trajectory(t, motion.evaluate(t).T_world_body)


def test_network_errors_match_the_reported_covariance_except_for_outliers(long_truth):
    network = network_like_motions(long_truth, T_BODY_CAMERA, 3)
    error = error_per_motion(long_truth, network)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(network.motions.cov), error) / 6
    good = ~network.is_outlier
    assert nees[good].mean() == pytest.approx(np.exp(2 * 0.2**2), rel=0.03)  # 1.083: sigmas are off by 20 %
    assert np.median(nees[network.is_outlier]) > 20
    assert network.is_outlier.mean() == pytest.approx(0.02, abs=0.004)
    per_axis = error[good] / np.sqrt(np.diagonal(network.motions.cov[good], axis1=1, axis2=2))
    np.testing.assert_allclose(per_axis.std(axis=0), np.sqrt(np.exp(0.08)), rtol=0.05)
    assert np.rad2deg(error[good, :3].std()) == pytest.approx(0.3 * np.exp(0.4**2), rel=0.05)
    camera = long_truth.T_world_body @ T_BODY_CAMERA
    step_m = np.linalg.norm(np.diff(camera[:, :3, 3], axis=0), axis=1)
    relative = error[:, 3:] * np.exp(network.true_log_scale)[:, None] / (0.03 * step_m + 5e-5)[:, None]
    assert relative[good].std() == pytest.approx(np.exp(0.4**2), rel=0.05)
    perfect = network_like_motions(long_truth, T_BODY_CAMERA, 3, reported_sd=0.0, outliers=0.0)
    error = error_per_motion(long_truth, perfect)
    assert not perfect.is_outlier.any()
    assert (error**2 / np.diagonal(perfect.motions.cov, axis1=1, axis2=2)).mean() == pytest.approx(1.0, rel=0.02)


def test_network_scale_is_drawn_from_its_prior_and_walks(long_truth):
    short = long_truth.select(np.arange(1001))
    runs = [network_like_motions(short, T_BODY_CAMERA, seed) for seed in range(150)]
    first, last = (np.array([run.true_log_scale[k] for run in runs]) for k in (0, -1))
    assert first.mean() == pytest.approx(np.log(0.8), abs=0.02)
    assert first.std() == pytest.approx(0.10, rel=0.17)
    assert (last - first).std() == pytest.approx(0.10, rel=0.17)
    assert (runs[0].motions.scale_log_mean, runs[0].motions.scale_log_sd) == (pytest.approx(np.log(0.8)), 0.10)


def test_network_outliers_can_come_in_bursts(long_truth):
    masks = [network_like_motions(long_truth, T_BODY_CAMERA, seed, outliers=0.05, burst_length=8).is_outlier
             for seed in range(20)]
    # about 75 bursts in one run: its share has a standard deviation of 0.006, the mean of 20 runs one of 0.0013
    assert np.mean(masks) == pytest.approx(0.05, abs=0.004)
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[False], masks[0], [False]]).astype(int))))[::2]
    assert np.median(runs) == 8


@pytest.mark.parametrize("changes", [{"outliers": 1.0}, {"burst_length": 0}, {"reported_sd": -0.1},
                                     {"rotation_sd_rad": 0.0}, {"translation_rel": float("nan")}])
def test_impossible_network_noise_is_refused(long_truth, changes):
    with pytest.raises(SimulationError, match=next(iter(changes))):
        network_like_motions(long_truth, T_BODY_CAMERA, 0, **changes)
