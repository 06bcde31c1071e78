"""Rest: found where it is, never where IMU or camera say otherwise, and worth no more than the tests exclude."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fusion.graph_estimator
from fusion import RefineConfig, refine
from fusion.chain_engine import ChainEngine
from fusion.config import RestConfig
from fusion.rest import FALSE_ALARM, MISSED, WHOLE, Rests, at_rest, claim
from fusion.scaled_motion import linearize, make_motions
from fusion.summary import sentences, summarize
from vio.simulation import T_BODY_CAMERA, network_like_motions
from vio.simulation.halts import Clock
from vio.trajectory import Trajectory

HALTS = [(30.0, 110.0), (140.0, 225.0)]
OFF = replace(RefineConfig(), rest=RestConfig("off"))
STATED = replace(RefineConfig(), rest=RestConfig(slowest_m_s=1e-4))


@pytest.fixture(scope="module")
def halting(examine):
    """Two halts of 80 s and 85 s."""
    return examine("small-bowel", "gaussian", 2, 240.0, 241, halts=HALTS)


@pytest.fixture(scope="module")
def without(halting):
    return refine(halting.recording, halting.motions, OFF)


@pytest.fixture(scope="module")
def found(halting):
    return refine(halting.recording, halting.motions)


def drift_m(refined, begin, end):
    """How far a track goes between two times."""
    t, p = refined.trajectory.t_s, refined.trajectory.positions_m
    first, last = np.searchsorted(t, [begin, end])
    return float(np.linalg.norm(p[last - 1] - p[first]))


def claimed(refined):
    """(M-1,) intervals that are called rest."""
    out = np.zeros(len(refined.trajectory) - 1, bool)
    for first, last in refined.rest.span:
        out[first:last] = True
    return out


def halted(t):
    return np.any([(t[:-1] >= begin) & (t[1:] <= end) for begin, end in HALTS], axis=0)


def test_halts_are_found_and_said(found, without):
    truth = halted(found.trajectory.t_s)
    assert claimed(found)[truth].mean() > 0.85
    assert np.count_nonzero(claimed(found) & ~truth) <= 4  # a clock that slows down is as quiet as one that stands
    assert summarize(found)["rest"]["duration_s"] == pytest.approx(claimed(found).sum() / 3, abs=1)
    assert "the capsule lay still" in sentences(summarize(found)) and len(without.rest.span) == 0
    assert "the capsule lay still" not in sentences(summarize(without))


def test_what_rest_accumulates_shrinks_and_stops_for_who_states_the_slowest_creep(examine):
    """With a source that has no outliers and knows its noise: what these leave is not for rest to say."""
    made = examine("small-bowel", "gaussian", 2, 240.0, 242, {"outliers": 0.0, "reported_sd": 0.01}, halts=HALTS)
    off, auto, stated = (refine(made.recording, made.motions, config) for config in (OFF, RefineConfig(), STATED))
    assert len(auto.rest.span) >= 2
    for halt in HALTS:
        assert drift_m(auto, *halt) < 0.8 * drift_m(off, *halt)
        assert drift_m(stated, *halt) < 0.5 * drift_m(off, *halt)
    assert (stated.rest.displacement_sd_m < 5e-4).all()  # for 80 s as for an hour
    grown = [np.trace(r.trajectory.cov[-1, 3:, 3:]) for r in (off, auto, stated)]
    assert grown[0] > grown[1] > grown[2]


@given(st.floats(1e-4, 1e-2), st.floats(20.0, 1e5), st.floats(1e-5, 1e-3))
def test_a_claim_never_exceeds_what_creep_of_the_stated_speed_may_pass_for(sd_m, duration_s, slowest):
    c = claim(sd_m, duration_s, slowest)
    assert 1.96 * c * sd_m == pytest.approx(min(MISSED * sd_m, (MISSED * sd_m) ** 2 / (slowest * duration_s)))


@pytest.mark.parametrize("missed", [0.0, 0.5, 1.0])
def test_regions_hold_every_creep_that_the_test_may_miss(missed):
    """Stretches of one motion of unit covariance, moved by as much as the whole stretch's test may miss, that pass."""
    rng = np.random.default_rng(1)
    moved = np.array([missed * MISSED, 0.0, 0.0])
    t = moved + rng.standard_normal((20_000, 3))
    passing = np.einsum("nk,nk->n", t, t) < WHOLE
    assert missed or passing.mean() == pytest.approx(1 - FALSE_ALARM, abs=0.01)
    n = int(passing.sum())
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, 3] = t[passing]
    motions = make_motions(np.arange(n), np.arange(n) + 1, T, np.tile(np.eye(6), (n, 1, 1)), T_BODY_CAMERA)
    c = claim(1.0, 1.0, 1e-9)
    rests = Rests(np.zeros((1, 2), int), np.arange(n), np.zeros(n, int), np.array([c**2 / (1 + c**2)]), np.array([c]))
    joined = at_rest(motions, rests, np.zeros(n))
    error = (joined.whiten[:, 3:, 3:] @ (joined.t - moved)[:, :, None])[:, :, 0]
    inside = np.mean(np.einsum("nk,nk->n", error, error) < 7.815)
    assert inside > 0.85
    naive = np.einsum("nk,nk->n", joined.t - moved, joined.t - moved) / 0.05 < 7.815
    assert missed == 0 or naive.mean() < 0.5  # an sd of a fifth, as if zero were sure, would not


def test_a_motion_at_rest_is_the_product_of_two_reports_and_says_nothing_of_scale():
    rng = np.random.default_rng(2)
    cov = np.diag(rng.uniform(1, 2, 6) ** 2 * 1e-4)[None]
    T = np.eye(4)[None].copy()
    T[0, :3, 3] = [0.01, -0.02, 0.005]
    motions = make_motions(np.array([0]), np.array([1]), T, cov, T_BODY_CAMERA)
    c2 = 1.5
    rests = Rests(np.array([[0, 1]]), np.array([0]), np.array([0]), np.array([c2 / (1 + c2)]), np.array([1.0]))
    joined = at_rest(motions, rests, np.array([0.3]))
    P = cov[0, 3:, 3:]
    fused = np.linalg.inv(np.linalg.inv(P) + np.linalg.inv(c2 * P))
    np.testing.assert_allclose(np.linalg.inv(joined.whiten[0].T @ joined.whiten[0])[3:, 3:], fused, rtol=1e-9)
    np.testing.assert_allclose(joined.t[0], fused @ np.linalg.inv(P) @ T[0, :3, 3], rtol=1e-9)
    poses = np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0, 0], [0.03, 0.01, 0]])
    here, there = (linearize(joined, *poses, np.array([s])) for s in (0.0, 1.0))
    assert not here.A_s.any() and (here.columns == there.columns).all()


def test_creep_at_the_stated_speed_is_not_called_rest(halting):
    """0.1 mm/s along the capsule's axis in place of the halts, without turning: the IMU stays quiet."""
    recording, clock, speed = halting.recording, Clock(HALTS), 1e-4
    truth = recording.truth
    T = truth.T_world_body.copy()
    gone = speed * np.diff(truth.t_s - clock(truth.t_s)[0])
    T[1:, :3, 3] += np.cumsum(gone[:, None] * T[1:, :3, 0], axis=0)
    accel = recording.imu.accel_m_s2.copy()
    accel[:, 0] -= speed * clock(recording.imu_t_s)[2]
    carried = replace(halting.with_imu(accel_m_s2=accel), truth=Trajectory(truth.t_s, T), truth_state=None)
    motions = network_like_motions(carried.truth, T_BODY_CAMERA, 1241).motions
    assert len(refine(carried, motions).rest.span) == 0


def test_neither_breathing_nor_a_wall_that_moves_nor_a_failing_source_is_rest(halting, examination):
    t = halting.recording.imu_t_s
    sway = np.stack([np.sin(0.5 * np.pi * t + phase) for phase in (0.0, 1.0, 2.0)], axis=1)
    felt = halting.with_imu(accel_m_s2=halting.recording.imu.accel_m_s2 + 5e-3 * (0.5 * np.pi) ** 2 * sway)
    assert len(refine(felt, halting.motions).rest.span) == 0  # 5 mm, four times in a quarter of a minute
    m = halting.motions
    waves = m.T_i_j.copy()
    waves[:, 2, 3] += 1e-3 * (np.sin(m.t_j_s) - np.sin(m.t_i_s))
    assert len(refine(halting.recording, replace(m, T_i_j=waves)).rest.span) == 0
    still = examination.motions.T_i_j.copy()
    still[100:200] = np.eye(4)
    assert len(refine(examination.recording, replace(examination.motions, T_i_j=still)).rest.span) == 0


def test_where_no_rest_is_found_nothing_changes(examination, refined):
    off = refine(examination.recording, examination.motions, OFF)
    assert len(refined.rest.span) == 0
    np.testing.assert_array_equal(off.trajectory.T_world_body, refined.trajectory.T_world_body)
    np.testing.assert_array_equal(off.trajectory.cov, refined.trajectory.cov)
    np.testing.assert_array_equal(off.joint.xi, refined.joint.xi)


def test_gtsam_and_the_chain_agree(halting, found, monkeypatch):
    monkeypatch.setattr(ChainEngine, "suits", staticmethod(lambda problem: False))
    other = refine(halting.recording, halting.motions)
    assert other.fallback_reason is None
    np.testing.assert_array_equal(other.rest.span, found.rest.span)
    np.testing.assert_allclose(other.trajectory.positions_m, found.trajectory.positions_m, atol=5e-5)
    sd = [np.sqrt(np.diagonal(r.trajectory.cov, axis1=1, axis2=2))[1:, 3:] for r in (other, found)]
    np.testing.assert_allclose(*sd, rtol=0.02)


def test_a_refinement_taken_up_again_has_the_same_bytes(halting, found, tmp_path, monkeypatch):
    refine(halting.recording, halting.motions, resume=tmp_path / "kept")

    def refuse(*_):
        raise AssertionError("computed again")

    for name in ("begin", "solve", "uncertainty"):
        monkeypatch.setattr(ChainEngine, name, refuse)
    again = refine(halting.recording, halting.motions, resume=tmp_path / "kept")
    np.testing.assert_array_equal(again.trajectory.T_world_body, found.trajectory.T_world_body)
    np.testing.assert_array_equal(again.trajectory.cov, found.trajectory.cov)
    np.testing.assert_array_equal(again.rest.span, found.rest.span)


def test_rest_that_the_graph_contradicts_is_refused(examination, refined, monkeypatch):
    """Claimed of a capsule that moves: the motions are then far from what the rest of the graph knows."""
    n = np.arange(100, 160)
    wrong = Rests(np.array([[100, 160]]), n, np.zeros(60, int), np.array([0.05]), np.array([1e-4]))
    monkeypatch.setattr(fusion.graph_estimator, "find_rests", lambda *_: wrong)
    again = refine(examination.recording, examination.motions)
    assert len(again.rest.span) == 0
    np.testing.assert_array_equal(again.trajectory.T_world_body, refined.trajectory.T_world_body)
