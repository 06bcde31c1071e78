"""Trajectory metrics equal evo's on real data; covariance checks know honest from overconfident."""

import json

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync as evo_sync
from evo.core.trajectory import PosePath3D, PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from vio import se3
from vio.alignment import MODES, align, associate
from vio.errors import DegenerateAlignmentError, GeometryError, TrajectoryError
from vio.metrics import (
    accuracy_table,
    ate,
    coverage,
    fix_gauge,
    nees,
    rpe,
    rpe_lengths,
    scale_drift,
    scale_error,
)
from vio.trajectory import Trajectory

seeds = st.integers(0, 2**32 - 1)
STATISTICS = ("rmse", "mean", "median", "max")


def from_rows(t, positions, quat_xyzw):
    t, first = np.unique(t, return_index=True)  # V102.txt repeats four stamps
    return Trajectory(t, se3.transform(se3.matrix_from_quat_xyzw(quat_xyzw[first]), positions[first]))


@pytest.fixture(scope="module")
def evo_data(shared_data):
    folder = shared_data / "evo_testdata"
    if not folder.is_dir():
        pytest.skip("needs ../shared/data/evo_testdata")

    def tum(name):
        rows = np.loadtxt(folder / name)
        return from_rows(rows[:, 0], rows[:, 1:4], rows[:, 4:8])

    def kitti(name):
        rows = np.loadtxt(folder / name).reshape(-1, 3, 4)
        return Trajectory(np.arange(len(rows)) * 0.1, se3.transform(rows[:, :, :3], rows[:, :, 3]))

    csv = np.loadtxt(folder / "V102_groundtruth.csv", delimiter=",")
    v102 = from_rows(csv[:, 0] * 1e-9, csv[:, 1:4], np.roll(csv[:, 4:8], -1, axis=1))
    return {
        "V102": (tum("V102.txt"), v102),
        "KITTI_00": (kitti("KITTI_00_ORB.txt"), kitti("KITTI_00_gt.txt")),
        "freiburg1_xyz": (tum("freiburg1_xyz-rgbdslam_drift.txt"), tum("freiburg1_xyz-groundtruth.txt")),
    }


DATASETS = ("V102", "KITTI_00", "freiburg1_xyz")


def in_evo(trajectory):
    return PosePath3D(poses_se3=list(trajectory.T_world_body.copy()))


def evo_statistics(metric, reference, estimate):
    metric.process_data((reference, estimate))
    return metric.get_all_statistics()


@pytest.mark.parametrize("name", DATASETS)
def test_association_equals_evo(evo_data, name):
    estimate, reference = evo_data[name]
    ours, theirs = associate(estimate, reference)

    def timed(track):
        return PoseTrajectory3D(timestamps=track.t_s, poses_se3=list(track.T_world_body))

    expected_reference, expected = evo_sync.associate_trajectories(timed(reference), timed(estimate), max_diff=0.01)
    np.testing.assert_array_equal(ours.positions_m, expected.positions_xyz)
    np.testing.assert_array_equal(theirs.positions_m, expected_reference.positions_xyz)


@pytest.mark.parametrize("mode", ["none", "origin", "se3", "sim3"])
@pytest.mark.parametrize("name", DATASETS)
def test_ate_equals_evo(evo_data, name, mode):
    estimate, reference = associate(*evo_data[name])
    theirs, truth = in_evo(estimate), in_evo(reference)
    scale = 1.0
    if mode == "origin":
        theirs.align_origin(truth)
    elif mode != "none":
        scale = theirs.align(truth, correct_scale=mode == "sim3")[2]
    ours = ate(estimate, reference, mode)
    position = evo_statistics(evo_metrics.APE(evo_metrics.PoseRelation.translation_part), truth, theirs)
    rotation = evo_statistics(evo_metrics.APE(evo_metrics.PoseRelation.rotation_angle_rad), truth, theirs)
    for statistic in STATISTICS:
        assert getattr(ours, f"{statistic}_m") == pytest.approx(position[statistic], rel=1e-9)
    assert ours.rotation_rmse_rad == pytest.approx(rotation["rmse"], rel=1e-9)
    assert ours.scale == pytest.approx(scale, rel=1e-12)
    assert (ours.mode, ours.matched) == (mode, len(estimate))


@pytest.mark.parametrize("all_pairs", [False, True])
@pytest.mark.parametrize("name", DATASETS)
def test_rpe_equals_evo(evo_data, name, all_pairs):
    estimate, reference = associate(*evo_data[name])
    if all_pairs:  # evo's loops take their time
        estimate, reference = (track.select(np.arange(0, len(track), 3)) for track in (estimate, reference))
    theirs, truth = in_evo(estimate), in_evo(reference)
    lengths = [0.03 * reference.path_length_m, 0.21 * reference.path_length_m]
    ours = [rpe(estimate, reference, 1, all_pairs), rpe(estimate, reference, 7, all_pairs),
            *rpe_lengths(estimate, reference, lengths, all_pairs)]
    for result in ours:
        unit = evo_metrics.Unit.frames if result.unit == "frames" else evo_metrics.Unit.meters
        for suffix, prefix, relation in (("m", "", evo_metrics.PoseRelation.translation_part),
                                         ("rad", "rotation_", evo_metrics.PoseRelation.rotation_angle_rad)):
            oracle = evo_metrics.RPE(relation, result.delta, unit, all_pairs=all_pairs, pairs_from_reference=True)
            expected = evo_statistics(oracle, truth, theirs)
            assert result.pairs == len(oracle.error)
            for statistic in STATISTICS:
                assert getattr(result, f"{prefix}{statistic}_{suffix}") == pytest.approx(expected[statistic], rel=1e-9)


@pytest.mark.parametrize("all_pairs", [False, True])
def test_rpe_over_lengths_passes_over_rests(all_pairs):
    rng = np.random.default_rng(11)
    steps = 0.01 * rng.uniform(size=(300, 1)) * (rng.random((300, 1)) < 0.5) * [1.0, 0, 0]
    positions = np.cumsum(steps, axis=0)
    reference = Trajectory(np.arange(300.0), se3.transform(Rotation.random(300, rng).as_matrix(), positions))
    estimate = Trajectory(reference.t_s, reference.T_world_body @ se3.exp(1e-2 * rng.normal(size=(300, 6))))
    [ours] = rpe_lengths(estimate, reference, 0.1, all_pairs)
    oracle = evo_metrics.RPE(evo_metrics.PoseRelation.translation_part, 0.1, evo_metrics.Unit.meters,
                             all_pairs=all_pairs, pairs_from_reference=True)
    assert ours.rmse_m == pytest.approx(evo_statistics(oracle, in_evo(reference), in_evo(estimate))["rmse"], rel=1e-9)
    assert len(oracle.error) == ours.pairs
    # A length below every step, lost in rounding, must still advance from motion to motion.
    assert rpe_lengths(estimate, reference, 1e-300)[0].pairs == (np.diff(positions[:, 0]) > 0).sum()


def wander(rng, n=60, noise=0.0):
    T = se3.chain(se3.exp(np.hstack([0.2 * rng.normal(size=(n - 1, 3)), rng.normal(size=(n - 1, 3))])))
    return Trajectory(np.arange(n) / 3, T @ se3.exp(noise * rng.normal(size=(n, 6))))


def moved(trajectory, T, scale=1.0):
    poses = trajectory.T_world_body.copy()
    poses[:, :3, 3] *= scale
    return Trajectory(trajectory.t_s, T @ poses, trajectory.cov)


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from([0.0, 1e-9, 1e-3, 1.0]), st.floats(-2, 2), st.sampled_from([0.0, 1e-10, 1e-2, 3.0]))
def test_ate_ignores_exactly_the_freedom_its_alignment_grants(seed, noise, log_scale, turn):
    rng = np.random.default_rng(seed)
    reference = wander(rng)
    estimate = Trajectory(reference.t_s, reference.T_world_body @ se3.exp(noise * rng.normal(size=(60, 6))))
    free = se3.transform(se3.so3_exp(turn * rng.normal(size=3)), 10 * rng.normal(size=3))
    yaw = se3.transform(se3.so3_exp([0, 0, turn]), free[:3, 3])
    gauges = {"none": (np.eye(4), 1.0), "origin": (free, 1.0), "yaw4": (yaw, 1.0), "se3": (free, 1.0),
              "sim3": (free, 10**log_scale)}
    for mode in MODES:
        before, after = ate(estimate, reference, mode), ate(moved(estimate, *gauges[mode]), reference, mode)
        assert after.rmse_m == pytest.approx(before.rmse_m, rel=1e-6, abs=1e-11)
        assert after.rotation_rmse_rad == pytest.approx(before.rotation_rmse_rad, rel=1e-6, abs=1e-11)
    rmse = [ate(estimate, reference, mode).rmse_m for mode in ("yaw4", "se3", "sim3")]
    assert (np.diff(rmse) < 1e-6 * rmse[0] + 1e-12).all()  # more freedom, less error, but for rounding
    assert rpe(moved(estimate, free), reference, 4).rmse_m == pytest.approx(rpe(estimate, reference, 4).rmse_m,
                                                                           rel=1e-6, abs=1e-11)


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0.2, 5), st.booleans())
def test_scale_error_says_how_much_too_long_the_estimate_is(seed, factor, straight):
    rng = np.random.default_rng(seed)
    reference = wander(rng)
    if straight:
        reference = Trajectory(reference.t_s, se3.transform(reference.rotations, np.outer(reference.t_s, [1, 2, 3])))
    T = se3.exp(rng.normal(size=6))
    assert scale_error(moved(reference, T, factor), reference) == pytest.approx(factor - 1, abs=1e-9)


def test_scale_drift_follows_the_scale_along_the_path():
    rng = np.random.default_rng(21)
    truth = se3.exp(np.hstack([0.05 * rng.normal(size=(800, 3)), np.abs(rng.normal(size=(800, 3)))]))
    truth[400:450, :3, 3] = 0  # a rest holds no path and so changes no segment
    steps = truth.copy()
    along = np.cumsum(np.linalg.norm(truth[:, :3, 3], axis=1))
    steps[:, :3, 3] *= np.where(along <= along[-1] / 2, 1.1, 0.9)[:, None]
    t = np.arange(801.0)
    reference, estimate = Trajectory(t, se3.chain(truth)), Trajectory(t, se3.chain(steps))
    drift = scale_drift(estimate, reference, 4)
    np.testing.assert_allclose(drift, [0.1, 0.1, -0.1, -0.1], atol=5e-3)
    assert scale_drift(estimate, reference, 1)[0] == pytest.approx(scale_error(estimate, reference))
    still = Trajectory(t, np.broadcast_to(np.eye(4), (801, 4, 4)))
    assert np.isnan(scale_drift(still, reference, 3)).all()
    with pytest.raises(DegenerateAlignmentError, match="no path to divide"):
        scale_drift(reference, still)


def covariances(rng, n):
    """Positive definite, strongly correlated, 1e-6 rad beside 1 m."""
    root = np.eye(6) + 0.9 * rng.normal(size=(n, 6, 6))
    root *= np.array([1e-6, 3e-4, 1e-2, 1.0, 1e-3, 1e-5])[:, None]
    return root, root @ np.swapaxes(root, 1, 2)


def honest(rng, n, gauge):
    """An estimate whose error is drawn from its covariance, and the truth in another gauge."""
    root, cov = covariances(rng, n)
    T = se3.exp(np.hstack([rng.normal(size=(n, 3)), 10 * rng.normal(size=(n, 3))]))
    draws = rng.normal(size=(n, 6))
    xi = (root @ draws[:, :, None])[:, :, 0]
    # The first pose's error is roll and pitch about world axes only; position and yaw are chosen.
    xi[0] = 0
    xi[0, :3] = T[0, :3, :3].T @ [2e-3, -1e-3, 0.0]
    cov[0] = 1e-30
    return Trajectory(np.arange(n) / 3, T, cov), Trajectory(np.arange(n) / 3, gauge @ T @ se3.exp(xi)), draws


@settings(max_examples=20, deadline=None)
@given(seeds, st.sampled_from([0.0, 1e-9, 0.3, 3.0, np.pi]))
def test_nees_undoes_the_gauge_and_nothing_else(seed, yaw):
    rng = np.random.default_rng(seed)
    gauge = se3.transform(se3.so3_exp([0, 0, yaw]), 5 * rng.normal(size=3))
    estimate, reference, draws = honest(rng, 30, gauge)
    back = fix_gauge(estimate, reference)
    np.testing.assert_allclose(back.positions_m[0], estimate.positions_m[0], atol=1e-12)
    assert se3.so3_log(back.rotations[0] @ estimate.rotations[0].T)[2] == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(back.T_world_body, se3.inverse(gauge) @ reference.T_world_body, atol=1e-9)
    values = nees(estimate, reference)
    assert np.isnan(values[0])
    np.testing.assert_allclose(values[1:], (draws[1:] ** 2).sum(axis=1) / 6, rtol=1e-3)


def test_nees_tells_honest_covariances_from_overconfident_ones():
    rng = np.random.default_rng(31)
    n = 3000
    gauge = se3.transform(se3.so3_exp([0, 0, 2.1]), [1.0, -2.0, 0.5])
    estimate, reference, _ = honest(rng, n, gauge)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 6 * (n - 1)) / (6 * (n - 1))
    values = nees(estimate, reference)
    assert values.shape == (n,) and np.isnan(values[0]) and low < values[1:].mean() < high
    assert np.mean(values[1:] * 6 <= chi2.ppf(0.95, 6)) == pytest.approx(0.95, abs=0.015)
    bold = Trajectory(estimate.t_s, estimate.T_world_body, estimate.cov / 1.2)
    assert nees(bold, reference)[1:].mean() > high


def test_nees_needs_covariances_that_are_ones():
    estimate, reference, _ = honest(np.random.default_rng(32), 10, np.eye(4))
    with pytest.raises(TrajectoryError, match="no covariances"):
        nees(reference, reference)
    cov = estimate.cov.copy()
    cov[7, 2, 2] = -1e-9
    with pytest.raises(GeometryError, match=r"estimate covariance\[7\]"):
        nees(Trajectory(estimate.t_s, estimate.T_world_body, cov), reference)


def test_coverage_counts_what_lies_inside():
    rng = np.random.default_rng(33)
    sd = rng.uniform(0.1, 10, 20000)
    truth = rng.normal(size=20000)
    values = truth + sd * rng.normal(size=20000)
    for level in (0.5, 0.95):
        assert coverage(values, sd, truth, level) == pytest.approx(level, abs=0.012)
    assert coverage([0.0, 0.0], [1.0, 1.0], [1.95, 1.97]) == 0.5
    for bad in (([], [], []), ([1.0], [1.0, 2.0], [1.0]), ([1.0], [0.0], [1.0]), ([np.nan], [1.0], [1.0])):
        with pytest.raises(TrajectoryError, match="coverage"):
            coverage(*bad)
    with pytest.raises(TrajectoryError, match="level"):
        coverage([1.0], [1.0], [1.0], 95)


def test_accuracy_table_has_the_contracts_shape(evo_data):
    estimate, reference = evo_data["V102"]
    table = json.loads(json.dumps(accuracy_table(estimate, reference), allow_nan=False))
    assert list(table) == [*MODES, "scale_error"]
    matched = associate(estimate, reference)
    for mode in MODES:
        assert set(table[mode]) == {"ate_rmse_m", "rotation_rmse_rad", "matched"}
        assert table[mode]["ate_rmse_m"] == ate(*matched, mode).rmse_m
        assert table[mode]["matched"] == len(matched[0]) < len(estimate) + 1
    assert table["scale_error"] == pytest.approx(1 / align(*matched, "sim3").scale - 1)


@pytest.mark.parametrize("motionless", [False, True])
def test_accuracy_table_of_a_degenerate_track_misses_no_row(motionless):
    t = np.arange(50) / 3
    reference = Trajectory(t, se3.transform(np.eye(3), np.outer(t, [0.0, 0.0, 0.0] if motionless else [1.0, 2.0, 0.5])))
    table = json.loads(json.dumps(accuracy_table(moved(reference, np.eye(4), 1.05), reference), allow_nan=False))
    assert list(table) == [*MODES, "scale_error"]
    gone = {mode for mode in table if isinstance(table[mode], dict) and "unavailable" in table[mode]}
    assert gone == ({"yaw4", "se3", "sim3", "scale_error"} if motionless else {"se3", "sim3"})
    assert all(set(table[mode]) == {"unavailable"} and "limit" in table[mode]["unavailable"] for mode in gone)
    if not motionless:
        assert table["scale_error"] == pytest.approx(0.05)


def test_bad_pairs_are_refused_in_one_line():
    track = wander(np.random.default_rng(41), 10)
    late, short = Trajectory(track.t_s + 1, track.T_world_body), track.select(np.arange(9))
    track = Trajectory(track.t_s, track.T_world_body, np.broadcast_to(np.eye(6), (10, 6, 6)))
    for metric in (ate, rpe, scale_error, scale_drift, nees, fix_gauge, lambda a, b: rpe_lengths(a, b, [1.0])):
        for other, message in ((short, "10 estimated poses but 9"), (late, "limit 0.001 s")):
            with pytest.raises(TrajectoryError, match=message) as caught:
                metric(track, other)
            assert "\n" not in str(caught.value)
    calls = [
        (lambda: rpe(track, track, 10), "10 poses hold no pair 10 apart"),
        (lambda: rpe(track, track, 0), "delta_frames is 0"),
        (lambda: rpe_lengths(track, track, [1e9]), "use a shorter length"),
        (lambda: rpe_lengths(track, track, [-1.0]), "must be positive"),
        (lambda: scale_drift(track, track, 0), "0 segments"),
        (lambda: accuracy_table(track, Trajectory(track.t_s + 1e3, track.T_world_body)), "matched 0 of 10"),
    ]
    for call, message in calls:
        with pytest.raises(TrajectoryError, match=message):
            call()
