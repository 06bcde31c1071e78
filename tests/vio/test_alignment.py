"""Alignment recovers what was applied, agrees with independent solvers, and refuses what positions cannot tell."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from vio import se3
from vio.alignment import MODES, align, associate, sim3_scale
from vio.errors import DegenerateAlignmentError, TrajectoryError
from vio.trajectory import Trajectory

seeds = st.integers(0, 2**32 - 1)
angles = st.one_of(st.floats(0, np.pi), st.sampled_from([0.0, 1e-300, 1e-12, 1e-8, 1e-4, np.pi - 1e-9, np.pi]))


def from_positions(positions, rng=None, cov=None):
    n = len(positions)
    R = np.eye(3) if rng is None else Rotation.random(n, rng).as_matrix()
    return Trajectory(np.arange(n) / 3, se3.transform(np.broadcast_to(R, (n, 3, 3)), positions), cov)


def wander(rng, n=40):
    return from_positions(np.cumsum(rng.normal(size=(n, 3)), axis=0), rng)


def similarity(trajectory, T, scale):
    """The trajectory seen from a world that is turned, shifted and stretched, composed one pose at a time."""
    poses = []
    for pose in trajectory.T_world_body:
        stretched = pose.copy()
        stretched[:3, 3] *= scale
        poses.append(T @ stretched)
    return Trajectory(trajectory.t_s, np.array(poses), trajectory.cov)


@settings(max_examples=60, deadline=None)
@given(seeds, angles, st.floats(-2, 2), st.floats(-3, 4), st.booleans())
@example(0, np.pi, 0.0, 0.0, True)
@example(1, 0.0, 0.0, 0.0, True)
def test_every_mode_recovers_the_map_it_can_express(seed, angle, log_scale, log_offset, planar):
    rng = np.random.default_rng(seed)
    estimate = wander(rng)
    if planar:  # rank 2: the sign of the third axis must come out as a rotation, not a reflection
        estimate = from_positions(estimate.positions_m * [1, 1, 0] @ Rotation.random(random_state=rng).as_matrix(), rng)
    axis = rng.normal(size=3)
    T = se3.transform(se3.so3_exp(angle * axis / np.linalg.norm(axis)), 10**log_offset * rng.normal(size=3))
    T_yaw = se3.transform(se3.so3_exp([0, 0, angle]), T[:3, 3])
    cases = {"none": (np.eye(4), 1.0), "origin": (T, 1.0), "yaw4": (T_yaw, 1.0), "se3": (T, 1.0),
             "sim3": (T, 10**log_scale)}
    assert tuple(cases) == MODES
    for mode, (applied, scale) in cases.items():
        reference = similarity(estimate, applied, scale)
        found = align(estimate, reference, mode)
        size = np.abs(reference.positions_m).max()
        assert found.scale == pytest.approx(scale, rel=1e-9)
        np.testing.assert_allclose(found.T[:3, :3], applied[:3, :3], atol=1e-9 + 1e-14 * size)
        np.testing.assert_allclose(found.apply(estimate).T_world_body, reference.T_world_body, atol=1e-8 * max(1, size))


@settings(max_examples=25, deadline=None)
@given(seeds, st.floats(-3, 0))
def test_noisy_alignments_are_least_squares_optima(seed, log_noise):
    rng = np.random.default_rng(seed)
    reference = wander(rng)
    noisy = reference.positions_m + 10**log_noise * rng.normal(size=(len(reference), 3))
    estimate = similarity(from_positions(noisy, rng), se3.exp(rng.normal(size=6)), 1.0)
    x = estimate.positions_m - estimate.positions_m.mean(axis=0)
    y = reference.positions_m - reference.positions_m.mean(axis=0)

    oracle, _ = Rotation.align_vectors(y, x)
    np.testing.assert_allclose(align(estimate, reference, "se3").T[:3, :3], oracle.as_matrix(), atol=1e-7)

    def misfit(mode, T_scale):
        return np.sum((T_scale[1] * x @ T_scale[0].T - y) ** 2)

    yaw = align(estimate, reference, "yaw4").T[:3, :3]
    grid = [misfit("yaw4", (se3.so3_exp([0, 0, a]), 1.0)) for a in np.linspace(-np.pi, np.pi, 361)]
    assert misfit("yaw4", (yaw, 1.0)) <= min(grid) * (1 + 1e-12)
    np.testing.assert_allclose(yaw[2], [0, 0, 1], atol=1e-15)

    similar = align(estimate, reference, "sim3")
    best = minimize_scalar(lambda s: misfit("sim3", (similar.T[:3, :3], s)), bounds=(0, 5), method="bounded",
                           options={"xatol": 1e-10})
    assert similar.scale == pytest.approx(best.x, rel=1e-6)
    assert sim3_scale(estimate, reference) == similar.scale


def test_a_mirrored_track_is_met_with_a_rotation_never_a_reflection():
    rng = np.random.default_rng(3)
    estimate = wander(rng)
    mirrored = from_positions(estimate.positions_m * [1, 1, -1])
    found = align(estimate, mirrored, "sim3")
    assert np.linalg.det(found.T[:3, :3]) == pytest.approx(1, abs=1e-12)
    x, y = (track.positions_m - track.positions_m.mean(axis=0) for track in (estimate, mirrored))
    turned = x @ found.T[:3, :3].T
    assert found.scale == pytest.approx(np.sum(turned * y) / np.sum(turned**2), rel=1e-12)


def test_covariances_keep_their_meaning_under_scale():
    rng = np.random.default_rng(4)
    estimate = wander(rng, 12)
    applied, scale = se3.exp(rng.normal(size=6)), 3.7
    found = align(estimate, similarity(estimate, applied, scale), "sim3")
    # Sigma-point oracle: push perturbed poses through the map, and read their spread back in body axes.
    root = rng.normal(size=(12, 6, 6)) * 1e-6
    carried = Trajectory(estimate.t_s, estimate.T_world_body, root @ np.swapaxes(root, 1, 2))
    mapped = found.apply(carried)
    moved = np.stack([
        se3.log(se3.inverse(mapped.T_world_body) @ found.apply(
            Trajectory(estimate.t_s, estimate.T_world_body @ se3.exp(root[:, :, k]))).T_world_body)
        for k in range(6)
    ], axis=-1)
    expected = moved @ np.swapaxes(moved, 1, 2)
    np.testing.assert_allclose(mapped.cov, expected, atol=1e-4 * np.abs(expected).max())


def line(direction, n=200, length=1.0, decimals=None):
    points = np.linspace(0, length, n)[:, None] * np.asarray(direction, float) / np.linalg.norm(direction)
    return points if decimals is None else np.round(points, decimals)


DEGENERATE = {
    "straight": (line([1, 2, 0.5]), {"none", "origin", "yaw4"}, "straight line", "rank 1"),
    "straight, far from the origin": (line([1, 2, 0.5]) + 5e3, {"none", "origin", "yaw4"}, "straight line", "rank 1"),
    "straight, 6 decimals": (line([1, 2, 0.5], decimals=6), {"none", "origin", "yaw4"}, "straight line", "rank 1"),
    "vertical": (line([0, 0, 1]), {"none", "origin"}, "straight line", "rank 1"),
    "motionless": (np.full((50, 3), 0.3), {"none", "origin"}, "motionless", "rank 0"),
    "motionless, far": (np.full((50, 3), 1e6 / 3), {"none", "origin"}, "motionless", "rank 0"),
    "one pose": (np.ones((1, 3)), {"none", "origin"}, "motionless", "rank 0"),
}


@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("mode", MODES)
def test_degenerate_tracks_are_refused_and_the_message_names_what_works(name, mode):
    positions, works, what, rank = DEGENERATE[name]
    rng = np.random.default_rng(5)
    reference = from_positions(positions, rng)
    estimate = similarity(reference, se3.transform(se3.so3_exp([0, 0, 0.4]), [1.0, 2.0, 3.0]), 1.0)
    if mode in works:
        T = align(estimate, reference, mode).T
        assert np.isfinite(T).all()
        if mode == "yaw4":
            np.testing.assert_allclose(T[:3, :3], se3.so3_exp([0, 0, -0.4]), atol=1e-6)
        return
    with pytest.raises(DegenerateAlignmentError) as caught:
        align(estimate, reference, mode)
    message = str(caught.value)
    assert "\n" not in message and message.startswith(f"{mode} alignment: ") and rank in message and "limit" in message
    assert (what if mode != "yaw4" or rank == "rank 0" else "no horizontal motion") in message
    offered = message.rsplit("use ", 1)[1].replace(" or ", ", ").split(", ")
    assert set(offered) == works


def test_which_track_stands_still_is_named_and_unrelated_motion_is_no_alignment():
    rng = np.random.default_rng(6)
    moving, still = wander(rng, 60), from_positions(np.zeros((60, 3)))
    for estimate, reference, name in ((still, moving, "estimate"), (moving, still, "reference")):
        with pytest.raises(DegenerateAlignmentError, match=f"the {name} is motionless"):
            align(estimate, reference, "se3")
        with pytest.raises(DegenerateAlignmentError, match=f"the {name} is motionless"):
            sim3_scale(estimate, reference)
    phase = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    first = from_positions(np.column_stack([np.sin(phase), 0 * phase, 0 * phase]))
    second = from_positions(np.column_stack([np.cos(phase), 0 * phase, 0 * phase]))
    with pytest.raises(DegenerateAlignmentError, match="share no motion"):
        align(first, second, "sim3")
    with pytest.raises(DegenerateAlignmentError, match="share no motion"):
        sim3_scale(first, second)
    ring = np.column_stack([np.cos(phase), np.sin(phase), 2 * np.cos(2 * phase)])
    with pytest.raises(DegenerateAlignmentError, match=r"mirror image.*use origin or none"):  # any rotation is as bad
        align(from_positions(ring), from_positions(ring * [-1, 1, 1]), "se3")
    with pytest.raises(DegenerateAlignmentError, match=r"no horizontal motion.*use sim3, se3, origin or none"):
        align(from_positions(ring * [1, 1, 0]), from_positions(ring * [1, -1, 0]), "yaw4")


@pytest.mark.parametrize("length", [0.1, 1.0, 5.0])
def test_a_real_capsule_in_a_straight_lumen_can_be_aligned(length):
    rng = np.random.default_rng(7)
    positions = line([1, 0.3, -0.2], 3000, length) + 1e-4 * rng.normal(size=(3000, 3))
    reference = from_positions(positions, rng)
    applied = se3.exp([0.3, -2.0, 0.5, 1, 2, 3])
    estimate = similarity(reference, se3.inverse(applied), 1 / 1.7)
    found = align(estimate, reference, "sim3")
    np.testing.assert_allclose(found.T[:3, :3], applied[:3, :3], atol=1e-6)
    np.testing.assert_allclose(found.apply(estimate).positions_m, positions, atol=1e-9)
    assert found.scale == pytest.approx(1.7, rel=1e-9)


def test_a_line_whose_sideways_motion_is_unrelated_noise_is_still_called_a_line():
    rng = np.random.default_rng(0)
    straight = line([1, 0.3, -0.2], 3000, 5.0)
    estimate, reference = (from_positions(straight + 1e-5 * rng.normal(size=(3000, 3))) for _ in range(2))
    with pytest.raises(DegenerateAlignmentError, match=r"straight line .*rank 1.*use yaw4, origin or none"):
        align(estimate, reference, "se3")


def test_scale_is_known_on_a_straight_line():
    reference = from_positions(line([1, 2, 0.5]))
    estimate = similarity(reference, se3.exp([0.3, -2.0, 0.5, 1, 2, 3]), 0.8)
    assert sim3_scale(estimate, reference) == pytest.approx(1 / 0.8, rel=1e-12)


def test_pairs_that_are_not_pairs_are_refused():
    track = wander(np.random.default_rng(8), 10)
    for mode in MODES:
        with pytest.raises(TrajectoryError, match="10 estimated poses but 9 reference"):
            align(track, track.select(np.arange(9)), mode)
        with pytest.raises(TrajectoryError, match=r"pose 0 is at 0\.000000 s .* at 0\.002000 s"):
            align(track, Trajectory(track.t_s + 2e-3, track.T_world_body), mode)
    with pytest.raises(TrajectoryError, match="'Sim3' is unknown; use one of none, origin"):
        align(track, track, "Sim3")


@settings(max_examples=60, deadline=None)
@given(seeds, st.floats(0, 0.02), st.integers(1, 60), st.integers(1, 60))
def test_association_is_one_to_one_ordered_within_the_limit_and_maximal(seed, limit, n, m):
    rng = np.random.default_rng(seed)
    # Stamps on a 1 ms grid make exact ties common.
    ta, tb = (np.sort(rng.choice(400, k, replace=False)) * 1e-3 for k in (n, m))
    tag = lambda t: Trajectory(t, se3.transform(np.eye(3), np.column_stack([t, t, t])))  # noqa: E731
    try:
        a, b = associate(tag(ta), tag(tb), limit)
    except TrajectoryError as error:
        assert np.abs(ta[:, None] - tb).min() > limit
        assert f"matched 0 of {min(n, m)}" in str(error) and "\n" not in str(error)
        return
    original_a, original_b = a.positions_m[:, 0], b.positions_m[:, 0]
    np.testing.assert_array_equal(a.t_s, original_a)
    np.testing.assert_array_equal(b.t_s, a.t_s)
    assert (np.diff(original_a) > 0).all() and (np.diff(original_b) > 0).all()
    assert (np.abs(original_a - original_b) <= limit).all()
    gaps = np.abs(ta[:, None] - tb)
    closest = np.unravel_index(np.argmin(gaps), gaps.shape)
    assert np.abs(original_a - original_b).min() == gaps[closest]
    # Nothing is left over that its own nearest partner, also left over, could have matched.
    free_a, free_b = np.setdiff1d(ta, original_a), np.setdiff1d(tb, original_b)
    for t in free_a:
        nearest = tb[np.argmin(np.abs(tb - t))]
        assert not (nearest in free_b and abs(nearest - t) <= limit)


def test_association_pairs_frames_half_way_between_the_others():
    grid = np.arange(5.0)
    track = lambda t: Trajectory(t, np.broadcast_to(np.eye(4), (len(t), 4, 4)))  # noqa: E731
    a, _ = associate(track(grid + 0.5), track(grid), 0.5)
    assert len(a) == 5
    with pytest.raises(TrajectoryError, match="zero or more"):
        associate(track(grid), track(grid), -1.0)
