"""SO(3) and SE(3) against matrix exponentials, at ordinary angles, near zero and near pi."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from vio import se3
from vio.errors import GeometryError

ANGLES = st.one_of(
    st.sampled_from([0.0, 1e-300, 1e-12, 1e-7, 0.99e-4, 1.01e-4, 0.99e-2, 1.01e-2, 1.0, np.pi - 1e-3, np.pi - 1e-7]),
    st.floats(0, np.pi - 1e-6),
)
COORDINATE = st.floats(-1, 1, allow_subnormal=False)


@st.composite
def rotation_vectors(draw, angles=ANGLES):
    axis = np.array([draw(COORDINATE), draw(COORDINATE), draw(COORDINATE)])
    axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 1e-3 else np.array([0.0, 0.0, 1.0])
    return draw(angles) * axis


@st.composite
def twists(draw, angles=ANGLES):
    return np.concatenate([draw(rotation_vectors(angles)), [10 * draw(COORDINATE) for _ in range(3)]])


def hat(xi):
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = se3.skew(xi[:3]), xi[3:]
    return out


@given(rotation_vectors(), st.tuples(COORDINATE, COORDINATE, COORDINATE))
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(se3.skew(a) @ b, np.cross(a, b), atol=1e-15)


@given(twists())
def test_exp_is_the_matrix_exponential(xi):
    np.testing.assert_allclose(se3.exp(xi), expm(hat(xi)), atol=3e-14)


@given(twists())
def test_log_undoes_exp(xi):
    # The rotation vector is ill-conditioned near pi: one ulp in R moves it by about 1e-8 there.
    atol = 1e-12 if np.linalg.norm(xi[:3]) < 3.0 else 2e-7
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=atol)


@given(twists(st.sampled_from([np.pi - 1e-9, np.pi, np.pi + 1e-9, 4.0, 6.0])))
def test_exp_undoes_log_at_and_beyond_pi(xi):
    T = se3.exp(xi)
    turn = se3.log(T)
    assert np.linalg.norm(turn[:3]) <= np.pi + 1e-12
    np.testing.assert_allclose(se3.exp(turn), T, atol=1e-7)


@given(rotation_vectors())
def test_right_jacobian_is_the_integral_of_rotations(w):
    # J_r(w) = integral over s in [0, 1] of exp(-s [w]x): the corner of one larger matrix exponential.
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:] = -se3.skew(w), np.eye(3)
    oracle = expm(block)[:3, 3:]
    np.testing.assert_allclose(se3.so3_right_jacobian(w), oracle, atol=1e-13)
    np.testing.assert_allclose(se3.so3_right_jacobian_inverse(w) @ oracle, np.eye(3), atol=1e-11)


@given(rotation_vectors(st.sampled_from([0.0, 1e-9, 1e-5, 1e-3, 0.5, 2.0, 3.1])))
def test_right_jacobian_is_the_derivative_of_exp(w):
    h = 1e-6
    R_t = se3.so3_exp(w).T
    numeric = np.column_stack([
        (se3.so3_log(R_t @ se3.so3_exp(w + h * e)) - se3.so3_log(R_t @ se3.so3_exp(w - h * e))) / (2 * h)
        for e in np.eye(3)
    ])
    np.testing.assert_allclose(se3.so3_right_jacobian(w), numeric, atol=1e-8)


@given(twists(), twists())
def test_group_axioms_and_adjoint(a, b):
    A, B = se3.exp(a), se3.exp(b)
    np.testing.assert_allclose(se3.inverse(A) @ A, np.eye(4), atol=1e-13)
    np.testing.assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=1e-12)
    np.testing.assert_allclose(A @ B @ se3.inverse(A), expm(hat(se3.adjoint(A) @ b)), atol=1e-9)


@pytest.mark.parametrize("shape", [(), (0,), (5,), (2, 3)])
def test_every_function_maps_over_leading_shapes(shape):
    xi = np.random.default_rng(0).normal(size=(*shape, 6))
    T = se3.exp(xi)
    for function, argument in ((se3.exp, xi), (se3.log, T), (se3.inverse, T), (se3.adjoint, T),
                               (se3.so3_right_jacobian, xi[..., :3]), (se3.so3_right_jacobian_inverse, xi[..., :3]),
                               (se3.quat_xyzw_from_matrix, T[..., :3, :3])):
        batched = function(argument)
        assert batched.shape[: len(shape)] == shape
        for index in np.ndindex(shape):
            np.testing.assert_allclose(batched[index], function(argument[index]), atol=1e-14)


@given(st.lists(twists(), max_size=20), twists())
def test_chain_is_the_product_one_after_the_other(steps, first):
    T = expm(hat(first))
    product = [T] + [T := T @ expm(hat(step)) for step in steps]
    chained = se3.chain(se3.exp(np.array(steps).reshape(-1, 6)), expm(hat(first)))
    np.testing.assert_allclose(chained, product, atol=1e-11)


def test_a_long_chain_stays_orthonormal_and_exact():
    xi = np.array([1e-3, -2e-3, 3e-3, 1e-3, 0.0, 0.0])
    T = se3.chain(np.broadcast_to(se3.exp(xi), (100_000, 4, 4)))
    R = T[:, :3, :3]
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-14
    np.testing.assert_allclose(T[-1], expm(100_000 * hat(xi)), atol=1e-8)


@given(twists(), twists(st.floats(0, 3.0)), st.floats(0, 1))
def test_interpolation_turns_about_one_axis_and_moves_on_a_line(a, step, f):
    A = se3.exp(a)
    B = A @ se3.exp(step)
    T = se3.interpolate(A, B, np.array(f))
    np.testing.assert_allclose(T[:3, :3], A[:3, :3] @ expm(f * se3.skew(step[:3])), atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], (1 - f) * A[:3, 3] + f * B[:3, 3], atol=1e-12)


@given(rotation_vectors(st.floats(0, 6.0)))
def test_quaternions_are_xyzw_hamilton_and_canonical(w):
    R = se3.so3_exp(w)
    q = se3.quat_xyzw_from_matrix(R)
    assert q[3] >= 0
    v, s = q[:3], q[3]
    np.testing.assert_allclose((2 * s * s - 1) * np.eye(3) + 2 * np.outer(v, v) + 2 * s * se3.skew(v), R, atol=1e-12)
    np.testing.assert_allclose(se3.matrix_from_quat_xyzw(-3 * q), R, atol=1e-12)


def test_check_transforms_projects_rounded_text_onto_so3():
    T = se3.exp(np.random.default_rng(1).normal(size=(50, 6)))
    checked = se3.check_transforms(np.round(T, 5), "T")
    R = checked[:, :3, :3]
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-14
    np.testing.assert_allclose(checked, T, atol=2e-5)


@pytest.mark.parametrize(("damage", "words"), [
    (lambda T: T[:, :3], r"shape \(4, 3, 4\)"),
    (lambda T: np.where(np.arange(4)[:, None, None] == 2, np.nan, T), r"T\[2\].*not finite"),
    (lambda T: T * np.array([1, 1, 1, 1])[:, None] * np.where(np.arange(4) == 3, 1.01, 1)[:, None, None], r"T\[3\]"),
    (lambda T: T @ np.diag([1, -1, 1, 1]), r"T\[0\].*handedness"),
    (lambda T: np.swapaxes(T, 1, 2), r"T\[0\].*row/column"),
])
def test_check_transforms_names_what_is_no_transform(damage, words):
    T = se3.transform(np.eye(3), np.ones((4, 3)))
    with pytest.raises(GeometryError, match=words):
        se3.check_transforms(damage(T), "T")


@pytest.mark.parametrize(("cov", "words"), [
    (np.ones((2, 6, 5)), "shape"),
    (np.stack([np.eye(6), np.diag([1, 1, 1, 1, 1, np.inf])]), r"cov\[1\].*not finite"),
    (np.stack([np.eye(6), np.diag([1, 1, 1, 1, 1, 0.0])]), r"cov\[1\].*positive definite"),
    (np.ones((1, 6, 6)), r"cov\[0\].*positive definite"),
    (np.eye(6)[None] + 0.1 * np.eye(6, k=1), r"cov\[0\]"),
])
def test_check_covariances_names_what_is_no_covariance(cov, words):
    with pytest.raises(GeometryError, match=words):
        se3.check_covariances(cov, "cov")


def test_covariances_of_very_different_units_pass():
    scale = np.diag([1e-6, 1e-6, 1e-6, 1e3, 1e3, 1e3])
    cov = scale @ (np.eye(6) + 0.9 * (np.ones((6, 6)) - np.eye(6))) @ scale
    np.testing.assert_allclose(se3.check_covariances(cov[None], "cov")[0], cov)
