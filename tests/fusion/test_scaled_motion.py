"""The batched factor against numeric derivatives, the truth, and gtsam's own between factor."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.scaled_motion import ScaledMotions, linearize, make_motions, residuals
from vio import se3

FIRST, SECOND = np.array([0, 0, 1, 2, 0, 3]), np.array([1, 3, 2, 4, 4, 4])  # neighbours and wide baselines
NODES = 5

seeds = st.integers(0, 2**32 - 1)
angles = st.one_of(st.just(0.0), st.sampled_from([1e-14, 1e-9, 1e-7, 1e-5, 1e-3]), st.floats(1e-6, 2.0))
log_scales = st.floats(-7.0, 1.0)  # motion units from a millimetre to almost three metres


def unit_vectors(rng, n):
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def covariances(rng, n, rotation_sd, translation_sd):
    A = rng.normal(size=(n, 6, 6)) + 2 * np.eye(6)
    scale = np.repeat([rotation_sd, translation_sd], 3)
    return scale[:, None] * (A @ np.swapaxes(A, 1, 2)) * scale


def random_setup(seed, angle, error_angle, log_scale, error_units=0.1):
    """Poses `angle` apart, and motions that are off by a rotation of `error_angle` and some translation."""
    rng = np.random.default_rng(seed)
    T_bc = se3.transform(se3.so3_exp(rng.normal(size=3)), rng.normal(0, 0.02, 3))
    steps = se3.transform(se3.so3_exp(angle * unit_vectors(rng, NODES - 1)), rng.normal(0, 0.005, (NODES - 1, 3)))
    T = se3.chain(steps, se3.exp(rng.normal(size=6)))
    camera = T @ T_bc
    T_ij = se3.inverse(camera[FIRST]) @ camera[SECOND]
    T_ij[:, :3, 3] *= np.exp(-log_scale)
    size = np.linalg.norm(T_ij[:, :3, 3], axis=1, keepdims=True)
    error = np.hstack([error_angle * unit_vectors(rng, len(FIRST)), error_units * size * unit_vectors(rng, len(FIRST))])
    cov = covariances(rng, len(FIRST), 0.01, 0.1 * float(size.mean()))
    return T, make_motions(FIRST, SECOND, T_ij @ se3.exp(error), cov, T_bc), cov


def moved(T, node, xi):
    """Pose `node` perturbed as gtsam does: on the right, rotation first."""
    T = T.copy()
    T[node, :3, 3] += T[node, :3, :3] @ xi[3:]
    T[node, :3, :3] = T[node, :3, :3] @ se3.so3_exp(xi[:3])
    return T


def residuals_at(motions, T, log_scale):
    return residuals(motions, T[:, :3, :3], T[:, :3, 3], np.full(len(motions), log_scale))


@settings(max_examples=60)
@given(seed=seeds, angle=angles, error_angle=angles, log_scale=log_scales)
def test_jacobians_are_the_derivatives(seed, angle, error_angle, log_scale):
    T, motions, _ = random_setup(seed, angle, error_angle, log_scale)
    blocks = linearize(motions, T[:, :3, :3], T[:, :3, 3], np.full(len(motions), log_scale))
    r = residuals_at(motions, T, log_scale)
    np.testing.assert_allclose(blocks.b, -r, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(blocks.squared_norm, (r**2).sum(axis=1))

    h = np.repeat([1e-5, 1e-6], 3)
    numeric = np.zeros((NODES, len(motions), 6, 6))
    for node in range(NODES):
        for axis in range(6):
            xi = np.zeros(6)
            xi[axis] = h[axis]
            difference = residuals_at(motions, moved(T, node, xi), log_scale) - residuals_at(
                motions, moved(T, node, -xi), log_scale)
            numeric[node, :, :, axis] = difference / (2 * h[axis])
    for n in range(len(motions)):
        for node in range(NODES):
            expected = {FIRST[n]: blocks.A_i[n], SECOND[n]: blocks.A_j[n]}.get(node, np.zeros((6, 6)))
            size = np.abs(expected).max() or 1e-9
            np.testing.assert_allclose(numeric[node, n], expected, atol=3e-6 * size)
    plus, minus = (residuals_at(motions, T, log_scale + step) for step in (1e-5, -1e-5))
    np.testing.assert_allclose((plus - minus) / 2e-5, blocks.A_s[:, :, 0], rtol=1e-5,
                               atol=1e-6 * np.abs(blocks.A_s).max())


@given(seed=seeds, angle=angles, log_scale=log_scales)
def test_residual_is_zero_at_the_truth_and_only_there(seed, angle, log_scale):
    T, motions, _ = random_setup(seed, angle, 0.0, log_scale, error_units=0.0)
    assert np.abs(residuals_at(motions, T, log_scale)).max() < 1e-14 * max(np.abs(motions.whiten).max(), 1e5)
    body = motions.body_motion(log_scale)
    np.testing.assert_allclose(body, se3.inverse(T[FIRST]) @ T[SECOND], atol=1e-12)
    np.testing.assert_allclose(body[:, :3, :3], motions.body_rotation(), atol=1e-15)
    turned = moved(T, 4, np.array([1e-3, 0, 0, 0, 0, 0]))
    assert np.linalg.norm(residuals_at(motions, turned, log_scale)[3:], axis=1).min() > 1e-3


def test_residual_lives_in_motion_units_so_that_a_small_scale_wins_nothing():
    """In metres the residual would vanish as exp(s) does: the bias that this form avoids."""
    T, motions, _ = random_setup(3, 0.3, 0.0, 0.0, error_units=0.0)
    r = [np.linalg.norm(residuals_at(motions, T, s)) for s in (-2.0, 0.0, 2.0)]
    assert r[0] > r[1] < r[2] and r[0] > r[2]


@settings(max_examples=50)
@given(seed=seeds, angle=st.sampled_from([0.0, 1e-8, 0.2, 2.0]), log_scale=st.floats(-7.0, 1.0))
def test_equals_gtsams_between_factor_at_a_fixed_scale(seed, angle, log_scale):
    """Same error and same information matrix; both to first order, for gtsam's residual is the SE(3) logarithm."""
    T, motions, cov = random_setup(seed, angle, 1e-6, log_scale, error_units=1e-5)
    blocks = linearize(motions, T[:, :3, :3], T[:, :3, 3], np.full(len(motions), log_scale))
    units = np.diag(np.repeat([1.0, np.exp(log_scale)], 3))
    Ad = se3.adjoint(motions.T_body_camera) @ units
    values = gtsam.Values()
    for k in range(NODES):
        values.insert(X(k), gtsam.Pose3(T[k]))
    for n, body in enumerate(motions.body_motion(log_scale)):
        noise = gtsam.noiseModel.Gaussian.Covariance(Ad @ cov[n] @ Ad.T)
        factor = gtsam.BetweenFactorPose3(X(FIRST[n]), X(SECOND[n]), gtsam.Pose3(body), noise)
        assert 0.5 * blocks.squared_norm[n] == pytest.approx(factor.error(values), rel=1e-3)
        A = np.hstack([blocks.A_i[n], blocks.A_j[n]])
        theirs = factor.linearize(values).information()
        size = np.sqrt(np.diagonal(theirs))
        np.testing.assert_allclose(A.T @ A / np.outer(size, size), theirs / np.outer(size, size), atol=1e-3)


def test_selected_motions_keep_their_numbers_on_renumbered_nodes():
    T, motions, _ = random_setup(8, 0.3, 0.1, -1.0)
    inside = motions.i >= 2
    part = motions.select(inside, first_node=2)
    assert isinstance(part, ScaledMotions) and part.i.min() == 0
    np.testing.assert_array_equal(residuals_at(part, T[2:], -1.0), residuals_at(motions, T, -1.0)[inside])
