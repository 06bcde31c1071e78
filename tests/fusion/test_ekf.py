"""The fallback filter: its matrices against numeric differences, its covariance, and when it must give up."""

from dataclasses import replace

import numpy as np
import pytest

from fusion.config import InitialConfig
from fusion.ekf import BA, BG, CLONE_POS, CLONE_ROT, DIM, POS, ROT, VEL, _CapsuleEkf, ekf_estimate
from fusion.estimate import Estimate
from fusion.problem import build_problem
from vio import se3
from vio.errors import EstimationError
from vio.metrics import ate
from vio.trajectory import Trajectory

AFTER = 20  # frames filtered before the matrices are looked at


@pytest.fixture(scope="module")
def problem(short):
    return build_problem(short.recording, short.motions)


def running(problem, truth, frames=AFTER):
    """A filter that has seen some frames, with full correlations, and has just predicted the next."""
    ekf = _CapsuleEkf(problem, truth.rotations[0], InitialConfig())
    for k in range(frames):
        ekf.predict(k)
        ekf.update(k)
    ekf.predict(frames)
    return ekf


def displaced(ekf, error):
    """Move the nominal state by an error state (21,), as `_fold` and the definition of the clone do."""
    ekf.R = se3.so3_exp(error[ROT]) @ ekf.R
    ekf.v, ekf.p = ekf.v + error[VEL], ekf.p + error[POS]
    ekf.gyro_bias, ekf.accel_bias = ekf.gyro_bias + error[BG], ekf.accel_bias + error[BA]
    ekf.R_clone, ekf.p_clone = se3.so3_exp(error[CLONE_ROT]) @ ekf.R_clone, ekf.p_clone + error[CLONE_POS]


STEP = np.repeat([1e-6, 1e-6, 1e-6, 1e-6, 1e-5, 1e-6, 1e-6], 3)


def unit(axis, sign):
    error = np.zeros(DIM)
    error[axis] = sign * STEP[axis]
    return error


def test_measurement_jacobian_is_the_derivative_of_the_innovation(problem, short):
    """At a measurement that agrees with the prediction: the right Jacobian of the residual is left out."""
    truth = short.recording.truth
    ekf = running(problem, truth)
    motions = problem.motions
    neutral = replace(motions, R=np.broadcast_to(np.eye(3), motions.R.shape), t=np.zeros_like(motions.t))
    ekf.problem = replace(problem, motions=neutral)
    z = ekf._innovation(AFTER)[0]
    agreeing = replace(motions, R=motions.R.copy(), t=motions.t.copy())
    agreeing.R[AFTER], agreeing.t[AFTER] = se3.so3_exp(-z[:3]), -z[3:]
    problem = replace(problem, motions=agreeing)
    ekf.problem = problem
    z, H, noise = ekf._innovation(AFTER)
    np.testing.assert_allclose(z, 0, atol=1e-12)
    np.testing.assert_allclose(noise, short.motions.cov[AFTER], rtol=1e-9)

    numeric = np.zeros((6, DIM))
    for axis in range(DIM):
        sides = []
        for sign in (1, -1):
            other = running(problem, truth)
            displaced(other, unit(axis, sign))
            sides.append(other._innovation(AFTER)[0])
        numeric[:, axis] = (sides[0] - sides[1]) / (2 * STEP[axis])
    np.testing.assert_allclose(numeric, -H, atol=1e-5 * np.abs(H).max())
    assert np.abs(H[:, ROT]).max() > 0.1 and not H[:, VEL].any() and not H[:, BG].any()


def test_transition_is_the_derivative_of_the_prediction(problem, short):
    """To first order in a sample's turn, 25 ms at the capsule's rates: a few thousandths."""
    truth = short.recording.truth
    numeric = np.zeros((DIM, DIM))
    for axis in range(DIM):
        ends = []
        for sign in (1, -1):
            ekf = running(problem, truth)
            displaced(ekf, unit(axis, sign))
            ekf.predict(AFTER + 1)
            ends.append(ekf)
        plus, minus = ends
        turn = [se3.so3_log(a @ b.T) for a, b in ((plus.R, minus.R), (plus.R_clone, minus.R_clone))]
        numeric[:, axis] = np.r_[turn[0], plus.v - minus.v, plus.p - minus.p, plus.gyro_bias - minus.gyro_bias,
                                 plus.accel_bias - minus.accel_bias, turn[1],
                                 plus.p_clone - minus.p_clone] / (2 * STEP[axis])
    F = running(problem, truth, AFTER + 1).filter.F
    blocks = [(row, column) for row in (ROT, VEL, POS, BG, BA, CLONE_ROT, CLONE_POS)
              for column in (ROT, VEL, POS, BG, BA, CLONE_ROT, CLONE_POS)]
    for row, column in blocks:
        size = np.abs(F[row, column]).max()
        np.testing.assert_allclose(numeric[row, column], F[row, column], atol=max(0.01 * size, 1e-6))
    assert np.abs(numeric[POS, BG]).max() > 1e-3  # tilt that the gyro bias makes, through gravity


def test_covariance_stays_symmetric_and_positive(problem, short):
    ekf = _CapsuleEkf(problem, short.recording.truth.rotations[0], InitialConfig())
    for k in range(len(problem) - 1):
        ekf.predict(k)
        ekf.update(k)
        P = ekf.filter.P
        np.testing.assert_array_equal(P, P.T)
        root = np.sqrt(np.diagonal(P))
        assert np.linalg.eigvalsh(P / np.outer(root, root)).min() > -1e-9
        pose = ekf.pose_cov()
        assert np.linalg.eigvalsh(0.5 * (pose + pose.T)).min() > 0


def test_an_update_shrinks_and_a_prediction_widens(problem, short):
    ekf = running(problem, short.recording.truth)
    predicted = ekf.filter.P.copy()
    ekf.update(AFTER)
    gained = np.diagonal(predicted) - np.diagonal(ekf.filter.P)
    assert (gained[POS] > 0).all() and (gained > -1e-15).all()
    updated = ekf.filter.P.copy()
    ekf.predict(AFTER + 1)
    assert (np.diagonal(ekf.filter.P)[POS] > np.diagonal(updated)[POS]).all()


def test_a_state_of_the_wrong_shape_is_caught(problem, short):
    """filterpy broadcasts a (21, 1) state with a (6,) residual into a matrix, in silence."""
    ekf = running(problem, short.recording.truth)
    ekf.filter.x = np.zeros((DIM, 1))
    with pytest.raises(EstimationError, match=r"ekf: the error state became \(21, 6\)"):
        ekf.update(AFTER)
    ekf = running(problem, short.recording.truth)
    ekf.filter.x = np.full(DIM, np.nan)
    with pytest.raises(EstimationError, match="not finite"):
        ekf.update(AFTER)


def estimate_of(problem, R0) -> Estimate:
    return ekf_estimate(problem, R0, InitialConfig())


@pytest.mark.parametrize("seed, limit_m", [(25, 1e-4), (21, 2e-4)], ids=["slow start", "at 38 mm/s"])
def test_perfect_data_give_the_truth(examine, noiseless, seed, limit_m):
    perfect = {"scale_prior_sd": 0.0, "scale_walk_per_sqrt_1000_frames": 0.0, "rotation_sd_rad": 1e-5,
               "translation_rel": 0.0, "translation_abs_m": 1e-6, "reported_sd": 0.0, "outliers": 0.0}
    # Measured 0.02 to 0.08 mm on seeds 22 to 29, 0.15 mm on 21, which starts at 38 mm/s; 0.86 mm there from rest.
    exact = examine("stomach", "none", 0, 30.0, seed, perfect, accel_bias_sd_m_s2=0.05, gyro_bias_sd_rad_s=0.005)
    problem = build_problem(exact.recording, exact.motions)
    truth = exact.recording.truth
    estimate = estimate_of(problem, truth.rotations[0])
    T = truth.T_world_body[0] @ se3.inverse(estimate.T_world_body[0]) @ estimate.T_world_body
    assert ate(Trajectory(truth.t_s, T), truth, "none").rmse_m < limit_m
    state = exact.recording.truth_state
    np.testing.assert_allclose(estimate.gyro_bias_rad_s[-1], state.gyro_bias_rad_s[-1], atol=2e-4)
    np.testing.assert_allclose(estimate.accel_bias_m_s2[-1], state.accel_bias_m_s2[-1], atol=5e-3)
    np.testing.assert_allclose(estimate.velocity_m_s[-1], state.velocity_m_s[-1], atol=5e-4)
    assert len(estimate.rejected) == 0


def test_gross_outliers_are_softened_and_reported(examination):
    problem = build_problem(examination.recording, examination.motions)
    rejected = estimate_of(problem, examination.recording.truth.rotations[0]).rejected
    outliers = np.flatnonzero(examination.network.is_outlier)
    assert len(outliers) >= 4
    assert np.isin(outliers, rejected).mean() >= 0.8
    assert len(rejected) < 3 * len(outliers)


def test_the_surest_of_several_motions_is_used(short):
    """A second, vague and wrong measurement of every pair changes nothing; only neighbours are used."""
    m = short.motions
    wrong = m.T_i_j @ se3.exp([0.3, 0, 0, 0, 0, 0.01])
    twice = replace(m, t_i_s=np.tile(m.t_i_s, 2), t_j_s=np.tile(m.t_j_s, 2), T_i_j=np.concatenate([wrong, m.T_i_j]),
                    cov=np.concatenate([100 * m.cov, m.cov]))
    R0 = short.recording.truth.rotations[0]
    alone = build_problem(short.recording, m)
    once = estimate_of(alone, R0)
    # The initial gyro bias is a median over all motions; here it is not what is tested.
    problem = replace(build_problem(short.recording, twice), gyro_bias_rad_s=alone.gyro_bias_rad_s)
    np.testing.assert_allclose(estimate_of(problem, R0).T_world_body, once.T_world_body, atol=1e-12)


def test_a_filter_that_lost_track_says_so(examination):
    """Walking, which the camera does not see: the softened motions no longer hold the filter, it flies off."""
    problem = build_problem(examination.shaken_unseen(0.02, 1.7), examination.motions)
    with pytest.raises(EstimationError, match=r"ekf: \d+ of 299 motions looked like outliers \(limit 50 %\)"):
        estimate_of(problem, examination.recording.truth.rotations[0])
