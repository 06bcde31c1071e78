"""The paper's twelve metrics against hand calculation, plain loops, scipy and a published figure."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vio import se3
from vio.errors import GeometryError, TrajectoryError
from vio.paper_metrics import euler_angles_rad, paper_depth_metrics, paper_motion_metrics, snippet_ate

seeds = st.integers(0, 2**32 - 1)


def motions(rng, n, turn=0.1, step=1.0):
    return se3.exp(np.hstack([turn * rng.normal(size=(n, 3)), step * rng.normal(size=(n, 3))]))


def from_euler(angles, t):
    return se3.transform(Rotation.from_euler("xyz", angles).as_matrix(), t)


def test_motion_metrics_of_a_worked_example():
    true = from_euler([[0.1, -0.2, 0.05], [0.02, 0.04, -0.1]], [[1.0, -2.0, 4.0], [0.5, 1.0, -1.0]])
    pred = from_euler([[0.1, -0.2, 0.10], [0.05, 0.0, -0.1]], [[1.0, -2.0, 1.0], [0.8, 1.4, -1.0]])
    result = paper_motion_metrics(pred, true)
    assert result["ate_paper"] == pytest.approx((3.0 + 0.5) / 2)
    assert result["abs_diff_t"] == pytest.approx((3.0 + 0.7) / 2)
    assert result["abs_rel_t"] == pytest.approx((3 / 4 + 0.3 / 0.5 + 0.4 / 1.0) / 2)
    assert result["are_paper"] == pytest.approx((0.05 + 0.05) / 2)
    assert result["abs_diff_r"] == pytest.approx((0.05 + 0.07) / 2)
    assert result["abs_rel_r"] == pytest.approx((0.05 / 0.05 + 0.03 / 0.02 + 0.04 / 0.04) / 2)
    assert (result["abs_rel_t_excluded"], result["abs_rel_r_excluded"], result["pairs"]) == (0, 0, 2)


@settings(max_examples=80, deadline=None)
@given(seeds, st.sampled_from([0.0, 1e-12, 1e-7, 1e-3, 0.1, 1.0]))
def test_angles_are_scipys_and_norms_obey_their_inequality(seed, turn):
    rng = np.random.default_rng(seed)
    R = se3.so3_exp(turn * rng.normal(size=(20, 3)))
    angles = euler_angles_rad(R)
    np.testing.assert_allclose(Rotation.from_euler("xyz", angles).as_matrix(), R, atol=1e-14)
    np.testing.assert_allclose(angles, Rotation.from_matrix(R).as_euler("xyz"), atol=1e-9)
    # The mean 1-norm lies between the mean 2-norm and √3 times it. The paper's own tables break this.
    result = paper_motion_metrics(motions(rng, 20, turn), motions(rng, 20, turn))
    for two, one in (("ate_paper", "abs_diff_t"), ("are_paper", "abs_diff_r")):
        assert result[two] * (1 - 1e-12) <= result[one] <= math.sqrt(3) * result[two] * (1 + 1e-12)


def test_angles_survive_the_gimbal_and_errors_wrap():
    lock = Rotation.from_euler("xyz", [0.3, np.pi / 2, -0.4]).as_matrix()
    np.testing.assert_allclose(Rotation.from_euler("xyz", euler_angles_rad(lock)).as_matrix(), lock, atol=1e-7)
    true, pred = from_euler([[np.pi - 0.1, 0, 0]], np.ones((1, 3))), from_euler([[-np.pi + 0.1, 0, 0]], np.ones((1, 3)))
    assert paper_motion_metrics(pred, true)["are_paper"] == pytest.approx(0.2)


def test_relative_errors_leave_out_what_cannot_be_divided_by():
    true = from_euler([[0.1, 0.0, 0.2], [0.1, 0.2, 0.2]], [[1.0, 0.0, 2.0], [0.0, -2.0, 1e-7]])
    pred = from_euler([[0.2, 0.3, 0.2], [0.1, 0.2, 0.2]], [[1.5, 9.0, 2.0], [9.0, -1.0, 9.0]])
    result = paper_motion_metrics(pred, true)
    assert result["abs_rel_t_excluded"] == 3 and result["abs_rel_r_excluded"] == 1
    assert result["abs_rel_t"] == pytest.approx(3 * np.mean([0.5, 0.0, 0.5]))  # truth -2 divides as 2
    assert result["abs_rel_r"] == pytest.approx(3 * np.mean([1.0, 0.0, 0.0, 0.0, 0.0]))
    assert paper_motion_metrics(pred, true, limit_t=1e-8)["abs_rel_t_excluded"] == 2
    still = np.broadcast_to(np.eye(4), (4, 4, 4))
    resting = paper_motion_metrics(still, still)
    assert resting["abs_rel_t"] is None and resting["abs_rel_r"] is None and resting["abs_rel_t_excluded"] == 12
    assert resting["ate_paper"] == resting["are_paper"] == 0.0


def test_snippet_ate_against_the_published_figure_and_a_loop(shared_data):
    folder = shared_data / "scared_pose_curves"
    if not folder.is_dir():
        pytest.skip("needs ../shared/data/scared_pose_curves")
    true, pred = (np.load(folder / f"{name}_poses_sequence1.npz")["data"].astype(float) for name in ("gt", "pred"))
    for T in (true, pred):  # saved in float32: the bottom row is zero only to 1e-15
        T[:, 3] = [0, 0, 0, 1]
    result = snippet_ate(pred, true)
    assert result.mean == pytest.approx(0.0776, abs=3e-4)  # EndoDAC on this SCARED sequence, as printed by its peers
    values, squares = [], []
    for start in range(len(true) - 3):
        p, x = [np.zeros(3)], [np.zeros(3)]
        Tp, Tx = np.eye(4), np.eye(4)
        for k in range(start, start + 4):
            Tp, Tx = Tp @ pred[k], Tx @ true[k]
            p.append(Tp[:3, 3])
            x.append(Tx[:3, 3])
        scale = sum(a @ b for a, b in zip(p, x, strict=True)) / sum(a @ a for a in p)
        total = sum(np.sum((scale * a - b) ** 2) for a, b in zip(p, x, strict=True))
        values.append(math.sqrt(total) / 5)
        squares.append(total / 5)
    assert (result.snippets, result.frames) == (407, 5)
    # check_transforms brings float32 rotations back onto SO(3), which the loop does not.
    assert (result.mean, result.sd) == pytest.approx((np.mean(values), np.std(values)), rel=1e-5)
    assert result.rmse == pytest.approx(math.sqrt(np.mean(squares)), rel=1e-5)
    assert result.rmse > 1.9 * result.mean  # sqrt(sum)/5 understates the root mean square about √5-fold


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(-6, 6), st.integers(2, 7))
def test_snippets_are_blind_to_scale_and_perfect_motions_cost_nothing(seed, log_scale, frames):
    rng = np.random.default_rng(seed)
    true, noisy = motions(rng, 12), motions(rng, 12)
    scaled = noisy.copy()
    scaled[:, :3, 3] *= 10**log_scale
    assert snippet_ate(scaled, true, frames).mean == pytest.approx(snippet_ate(noisy, true, frames).mean, rel=1e-9)
    assert snippet_ate(true, true, frames).rmse < 1e-12
    still = np.broadcast_to(np.eye(4), (12, 4, 4))
    assert np.isfinite(snippet_ate(still, true, frames).mean)


def test_depth_metrics_against_a_pixel_loop():
    rng = np.random.default_rng(1)
    truth, pred = rng.uniform(0.5, 3, (3, 6, 5)), rng.uniform(0.5, 3, (3, 6, 5))
    truth[0, 0, 0], truth[1, 2, 2], truth[2, 1, 1], pred[0, 0, 0] = 0.0, np.nan, np.inf, -1.0
    valid = rng.random((3, 6, 5)) < 0.8
    rows = []
    for image in range(3):
        terms = []
        for p, x, use in zip(pred[image].flat, truth[image].flat, valid[image].flat, strict=True):
            if use and math.isfinite(x) and x > 0:
                d = abs(x - p)
                terms.append((d, d / x, d * d / x, d * d, (math.log(p) - math.log(x)) ** 2, max(p / x, x / p) < 1.25))
        mean = np.mean(terms, axis=0)
        rows.append([mean[0], mean[1], mean[2], math.sqrt(mean[3]), math.sqrt(mean[4]), mean[5]])
    result = paper_depth_metrics(pred, truth, valid)
    names = ("abs_diff", "abs_rel", "sq_rel", "rmse", "log_rmse", "acc_1_25")
    np.testing.assert_allclose([result[name] for name in names], np.mean(rows, axis=0), rtol=1e-12)
    assert (result["images"], result["depth_scale"]) == (3, "none")
    assert result["pixels"] == (valid & np.isfinite(truth) & (truth > 0)).sum()
    single = paper_depth_metrics(pred[1], truth[1], valid[1])
    np.testing.assert_allclose([single[name] for name in names], rows[1], rtol=1e-12)


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(-3, 3))
def test_median_scaling_removes_scale_per_image_and_is_named(seed, log_scale):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.5, 3, (2, 8, 8))
    pred = truth * np.array([10**log_scale, 0.1]).reshape(2, 1, 1)
    scaled = paper_depth_metrics(pred, truth, median_scaling=True)
    assert scaled["depth_scale"] == "median"
    assert scaled["abs_rel"] < 1e-12 and scaled["acc_1_25"] == 1.0
    assert paper_depth_metrics(pred, truth)["abs_rel"] == pytest.approx((abs(10**log_scale - 1) + 0.9) / 2)
    pred[:, 3, 5] *= 1e6  # a wild pixel moves no median
    assert paper_depth_metrics(pred, truth, median_scaling=True)["acc_1_25"] > 0.5


def test_unusable_inputs_are_refused_in_one_line():
    rng = np.random.default_rng(2)
    T, depth = motions(rng, 5), np.ones((2, 4, 4))
    hole = depth.copy()
    hole[1] = 0
    dark = np.ones((2, 4, 4))
    dark[1, 0, :2] = 0
    cases = [
        (lambda: paper_motion_metrics(T, T[:4]), TrajectoryError, r"\(5, 4, 4\) and true motions \(4, 4, 4\)"),
        (lambda: paper_motion_metrics(T[:0], T[:0]), TrajectoryError, "N ≥ 1"),
        (lambda: paper_motion_metrics(T, T, limit_t=0), TrajectoryError, "limit_t is 0"),
        (lambda: paper_motion_metrics(T, 2 * T), GeometryError, r"T_true\[0\]"),
        (lambda: snippet_ate(T, T, 7), TrajectoryError, "5 motions, 7 frames"),
        (lambda: snippet_ate(T, T, 1), TrajectoryError, "2 or more"),
        (lambda: paper_depth_metrics(depth, depth[:1]), TrajectoryError, "must agree"),
        (lambda: paper_depth_metrics(depth[:0], depth[:0]), TrajectoryError, "must agree"),
        (lambda: paper_depth_metrics(depth, depth, np.ones((3, 3))), TrajectoryError, r"mask \(3, 3\)"),
        (lambda: paper_depth_metrics(depth, hole), TrajectoryError, "image 1 has no valid pixel"),
        (lambda: paper_depth_metrics(dark, depth), TrajectoryError, "image 1 predicts 0 at 2 of 16"),
    ]
    for call, kind, message in cases:
        with pytest.raises(kind, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)
