import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vio import se3
from vio.errors import TrackingError
from vio.rigid_fit import fit_rigid

POINTS = 40


def clouds(seed: int, n: int, T: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1, 1, (n, POINTS, 3)) * [20, 20, 15] + [0, 0, 30]
    p = q @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
    return p + rng.normal(0, sigma, p.shape), q


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6), st.sampled_from([0.0, 1e-9, 1e-5, 1e-2, 1.0]),
       st.integers(0, 99))
def test_exact_points_give_the_exact_motion_down_to_none(xi: list[float], size: float, seed: int) -> None:
    T = se3.exp(size * np.array(xi))[None]
    p, q = clouds(seed, 1, T, 0.0)
    fit = fit_rigid(p, q)
    assert np.abs(se3.log(se3.inverse(T) @ fit.T_i_j)).max() < 1e-11
    assert fit.observable.all()


@pytest.mark.parametrize("outliers", [0, 6])
def test_claimed_covariance_matches_the_scatter(outliers: int) -> None:
    rng = np.random.default_rng(1)
    T = se3.exp(rng.normal(0, 0.2, (600, 6)) * [1, 1, 1, 5, 5, 5])
    p, q = clouds(2, 600, T, 0.3)
    p[:, :outliers] += rng.normal(0, 10, (600, outliers, 3))
    fit = fit_rigid(p, q, sigma=0.3)
    xi = se3.log(se3.inverse(fit.T_i_j) @ T)
    nees = np.einsum("ni,nij,nj->n", xi, np.linalg.inv(fit.cov), xi) / 6
    assert 0.7 < nees.mean() < 1.4
    if outliers:
        assert np.median(fit.weight[:, :outliers]) < 0.1 < 0.5 < np.median(fit.weight[:, outliers:])


def test_wrong_sigma_is_corrected_by_the_residuals() -> None:
    T = np.broadcast_to(np.eye(4), (200, 4, 4))
    p, q = clouds(3, 200, T, 0.3)
    told, right = fit_rigid(p, q, sigma=0.03).cov, fit_rigid(p, q, sigma=0.3).cov
    ratio = np.sqrt(np.trace(told, axis1=1, axis2=2) / np.trace(right, axis1=1, axis2=2))
    assert 0.8 < np.median(ratio) < 1.2


def test_information_along_the_ray_beats_one_sigma() -> None:
    rng = np.random.default_rng(4)
    T = se3.exp(rng.normal(0, 0.05, (200, 6)) * [1, 1, 1, 10, 10, 10])
    p, q = clouds(5, 200, T, 0.0)
    ray = p / np.linalg.norm(p, axis=2, keepdims=True)
    p = p + rng.normal(0, 0.02, p.shape) + ray * rng.normal(0, 1.0, (*p.shape[:2], 1))
    along = ray[..., :, None] * ray[..., None, :]
    information = (np.eye(3) - along) / 0.02**2 + along / (0.02**2 + 1.0)
    best, plain = fit_rigid(p, q, information=information), fit_rigid(p, q, sigma=0.6)
    error = [np.linalg.norm(se3.log(se3.inverse(f.T_i_j) @ T)[:, :3], axis=1) for f in (best, plain)]
    assert np.median(error[0]) < 0.25 * np.median(error[1])
    xi = se3.log(se3.inverse(best.T_i_j) @ T)
    nees = np.einsum("ni,nij,nj->n", xi, np.linalg.inv(best.cov), xi) / 6
    assert 0.6 < nees.mean() < 1.6


def test_padding_changes_nothing() -> None:
    T = se3.exp(np.array([[0.1, -0.2, 0.3, 1, 2, 3.0]]))
    p, q = clouds(6, 1, T, 0.1)
    hole = np.full((1, 7, 3), np.nan)
    valid = np.arange(POINTS + 7)[None] < POINTS
    padded = fit_rigid(np.concatenate([p, hole], 1), np.concatenate([q, hole], 1), valid=valid)
    plain = fit_rigid(p, q)
    np.testing.assert_allclose(padded.T_i_j, plain.T_i_j, atol=1e-13)
    np.testing.assert_allclose(padded.cov, plain.cov, rtol=1e-9)


def test_points_on_a_line_leave_the_turn_about_it_open() -> None:
    T = se3.exp(np.array([[0.05, 0.02, 0.1, 1, 0, 2.0]]))
    q = np.linspace(-10, 10, POINTS)[None, :, None] * np.array([1.0, 0, 0]) + [0, 0, 30]
    p = q @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
    fit = fit_rigid(p, q, sigma=0.1)
    assert not fit.observable[0]
    value, vector = np.linalg.eigh(fit.cov[0])
    about_line = np.concatenate([[1, 0, 0], np.cross([0.0, 0, 30], [1, 0, 0])])
    assert value[-1] > 1e2
    assert abs(vector[:, -1] @ about_line) / np.linalg.norm(about_line) > 0.99


@pytest.mark.parametrize(("change", "message"), [
    ({"points_j": np.zeros((1, 4, 3))}, "shape"),
    ({"valid": np.zeros((1, 5), bool)}, "at most 0 points"),
    ({"valid": np.arange(5)[None] < 2}, "at most 2 points"),
    ({"points_i": np.full((1, 5, 3), np.nan)}, "point 0 of pair 0 is not finite"),
    ({"sigma": 0.0}, "sigma is not a positive"),
    ({"sigma": np.ones(3)}, "sigma has shape"),
    ({"information": np.ones((1, 5, 3))}, "information"),
])
def test_unusable_input_is_refused_in_one_line(change: dict[str, object], message: str) -> None:
    rng = np.random.default_rng(0)
    arguments: dict[str, object] = {"points_i": rng.normal(size=(1, 5, 3)), "points_j": rng.normal(size=(1, 5, 3))}
    with pytest.raises(TrackingError, match=message) as caught:
        fit_rigid(**{**arguments, **change})
    assert "\n" not in str(caught.value)
