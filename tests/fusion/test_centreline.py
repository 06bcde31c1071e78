"""The travelled centreline: distance along the gut, not along the jitter."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.simulated_lesions import true_lumen
from fusion.lesions.centreline import ASIDE_M, arc_length, trace_centreline
from vio import se3
from vio.simulation import simulate

PITCH_M, RADIUS_M = 0.06, 0.03
PER_RAD_M = float(np.hypot(RADIUS_M, PITCH_M / (2 * np.pi)))


def helix(arc_m: np.ndarray) -> np.ndarray:
    """A coil of gut: position (n, 3) at arc lengths (n,)."""
    angle = arc_m / PER_RAD_M
    return np.column_stack([RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), PITCH_M * angle / (2 * np.pi)])


def course(rng: np.random.Generator, frames: int = 600) -> np.ndarray:
    """Arc length (n,) of a capsule that advances, retreats and rests, in phases of about ten frames."""
    speed = np.repeat(rng.choice([0.0, 1.5e-3, 2.5e-3, -1e-3], frames // 10 + 1, p=[0.2, 0.35, 0.25, 0.2]), 10)[:frames]
    speed[:20] = 2e-3
    return np.cumsum(speed) - speed[0]


@settings(max_examples=15)
@given(st.integers(0, 10**6))
def test_to_and_fro_rest_and_tremble_add_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    arc = course(rng)
    track = helix(arc) + 2e-4 * rng.standard_normal((len(arc), 3))
    found = trace_centreline(track).frame_arc_m
    assert np.abs(found - arc).max() < 2e-3 + 0.01 * np.ptp(arc)
    assert arc_length(track)[-1] > 1.1 * np.ptp(arc)  # the least of 1500 seeds: 1.145


@settings(max_examples=10)
@given(st.integers(0, 10**6))
def test_turning_and_shifting_the_world_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    track = helix(course(rng, 200)) + 2e-4 * rng.standard_normal((200, 3))
    R, t = se3.so3_exp(rng.standard_normal(3)), rng.standard_normal(3)
    np.testing.assert_allclose(trace_centreline(track @ R.T + t).frame_arc_m, trace_centreline(track).frame_arc_m,
                               atol=1e-7)


def test_a_straight_rest_and_two_frames_have_a_centreline() -> None:
    line = np.outer(np.linspace(0, 0.3, 200), [1.0, 0.0, 0.0])
    np.testing.assert_allclose(trace_centreline(line).frame_arc_m, line[:, 0], atol=1e-4)
    still = 1e-4 * np.random.default_rng(1).standard_normal((100, 3))
    assert np.ptp(trace_centreline(still).frame_arc_m) < 5e-3
    np.testing.assert_allclose(trace_centreline(line[[0, 100]]).frame_arc_m, [0, line[100, 0]], atol=1e-3)


def test_a_first_retreat_is_negative_and_the_way_ahead_positive() -> None:
    arc = np.r_[np.linspace(0, -0.02, 30), np.linspace(-0.02, 0.3, 300)]
    found = trace_centreline(helix(arc + 0.1)).frame_arc_m
    np.testing.assert_allclose(found, arc, atol=3e-3)


def test_a_sharp_corner_is_followed() -> None:
    leg = np.linspace(0, 0.1, 60)
    back = np.deg2rad(110)  # sharper ones cannot be told from a retreat within the lumen
    second = np.outer(leg[1:], [np.cos(back), np.sin(back), 0]) + np.array([0.1, 0, 0])
    track = np.concatenate([np.outer(leg, [1, 0, 0]), second])
    assert trace_centreline(track).frame_arc_m[-1] == pytest.approx(0.2, abs=0.02)


def test_a_drifting_track_is_recognised_where_it_was_before() -> None:
    """Back and forth once more, with sideways drift of twice the distance at which a position stops to count."""
    arc = np.r_[np.linspace(0, 0.3, 200), np.linspace(0.3, 0.05, 200), np.linspace(0.05, 0.5, 300)]
    track = np.outer(arc, [1.0, 0.0, 0.0]) + np.outer(np.linspace(0, 2 * ASIDE_M, len(arc)), [0.0, 1.0, 0.0])
    assert np.abs(trace_centreline(track).frame_arc_m - arc).max() < 0.02


def test_lines_of_other_trajectories_are_fitted_alike() -> None:
    track = helix(course(np.random.default_rng(2)))
    line = trace_centreline(track)
    same, longer = line.smooth(np.stack([track, 1.1 * track]))
    np.testing.assert_allclose(same, line.points_m, atol=1e-9)
    assert arc_length(longer)[-1] == pytest.approx(1.1 * arc_length(same)[-1], rel=1e-9)


@pytest.mark.parametrize(("organ", "driving"), [("small-bowel", "natural"), ("colon", "operated")])
def test_simulated_courses_are_measured_along_the_lumen(organ: str, driving: str) -> None:
    simulation = simulate(organ, "peristalsis", 3, 200.0, 31, driving=driving)
    lumen, truth = true_lumen(simulation), simulation.recording.truth
    arc = lumen.frame_arc_m - lumen.frame_arc_m[0]
    found = trace_centreline(truth.positions_m).frame_arc_m
    assert np.abs(found - arc).max() < 10e-3 + 0.03 * np.ptp(arc)  # it sways by millimetres from wall to wall
    assert truth.path_length_m > 1.5 * np.ptp(arc)
