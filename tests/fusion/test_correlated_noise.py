"""Errors that last: what is added is of the right size in the long run, and regions hold the truth again."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion import refine
from fusion.chain_engine import ChainEngine
from fusion.correlated_noise import lasting_errors, lasting_share, long_run
from fusion.engine import Begin
from fusion.graph import read_poses
from fusion.native_engine import NativeEngine
from fusion.problem import build_problem
from fusion.scaled_motion import linearize
from fusion.solve import MotionTerm
from vio import se3
from vio.errors import MotionsError
from vio.simulation import T_BODY_CAMERA

FRAME_S = 1 / 3


@given(st.floats(0.05, 0.9))
def test_what_is_added_makes_slow_errors_as_large_as_a_process_of_that_correlation(rho):
    """Σ over all lags of the sum's autocovariance: 1 + a (1 + ρ) / (1 - ρ) = (1 + ρ) / (1 - ρ)."""
    assert 1 + lasting_share(rho) * (1 + rho) / (1 - rho) == pytest.approx((1 + rho) / (1 - rho))


def test_draws_have_the_share_and_decay_with_time_across_uneven_frames():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.choice([1.0, 1.0, 3.0], 40)) * FRAME_S
    order = rng.permutation(len(t))
    errors = lasting_errors(t[order], 0.5, 4000, rng)[:, np.argsort(order)]
    share = lasting_share(np.exp(-FRAME_S / 0.5))
    assert not errors[:, :, :3].any()
    x = errors[:, :, 3:]
    np.testing.assert_allclose(np.einsum("snc,snc->n", x, x) / 12000, share, rtol=0.08)
    for k in (0, 7, 23):
        alike = np.einsum("sc,sc->", x[:, k], x[:, k + 1]) / 12000 / share
        assert alike == pytest.approx(np.exp(-(t[k + 1] - t[k]) / 0.5), abs=0.04)
    assert abs(np.mean(x[..., 0] * x[..., 1])) < 0.01


def lasting_noise(examination, correlation_s: float, seed: int):
    """True motions with translation noise of 10 % whose errors decay over `correlation_s`, said to be independent."""
    rng = np.random.default_rng(seed)
    T = examination.recording.truth.interpolate(examination.motions.t_i_s).T_world_body
    last = examination.recording.truth.interpolate(examination.motions.t_j_s[-1:]).T_world_body
    camera = np.concatenate([T, last]) @ T_BODY_CAMERA
    steps = se3.inverse(camera[:-1]) @ camera[1:]
    n = len(steps)
    sd = 0.1 * np.linalg.norm(steps[:, :3, 3], axis=1) + 1e-4
    rho, white = np.exp(-FRAME_S / correlation_s), rng.standard_normal((n, 3))
    process = white.copy()
    for k in range(1, n):
        process[k] = rho * process[k - 1] + np.sqrt(1 - rho**2) * white[k]
    steps[:, :3, 3] += sd[:, None] * process
    turn = 0.003
    steps[:, :3, :3] = steps[:, :3, :3] @ se3.so3_exp(turn * rng.standard_normal((n, 3)))
    cov = np.zeros((n, 6, 6))
    cov[:, :3, :3] = turn**2 * np.eye(3)
    cov[:, 3:, 3:] = sd[:, None, None]**2 * np.eye(3)
    return replace(examination.motions, T_i_j=steps, cov=cov, scale_log_mean=0.0, scale_log_sd=0.1)


def position_misses(refined) -> np.ndarray:
    """Squared position errors by claimed covariance, both in the axes of the first pose, yaw of the first aligned."""
    T, truth = refined.trajectory.T_world_body, refined.truth.T_world_body
    turn = T[0, :3, :3] @ truth[0, :3, :3].T
    yaw = np.arctan2(turn[1, 0], turn[0, 0])
    level = se3.so3_exp([0, 0, yaw])
    error = (T[:, :3, 3] - T[0, :3, 3]) - (truth[:, :3, 3] - truth[0, :3, 3]) @ level.T
    cov = T[:, :3, :3] @ refined.trajectory.cov[:, 3:, 3:] @ np.swapaxes(T[:, :3, :3], 1, 2)
    use = slice(20, None, 20)
    return np.einsum("ni,nij,nj->n", error[use], np.linalg.inv(cov[use]), error[use])


def test_regions_hold_the_truth_when_errors_last(examine):
    misses = {0.0: [], 1.0: []}
    for seed in range(6):
        made = examine("small-bowel", "gaussian", 2, 60.0, 5100 + seed)
        for told, found in misses.items():
            motions = replace(lasting_noise(made, 1.0, seed), meta={"error_correlation_s": told})
            found.append(position_misses(refine(made.recording, motions)))
    inside = {told: np.mean(np.concatenate(found) < 7.81) for told, found in misses.items()}
    assert inside[0.0] < 0.8 and inside[1.0] > 0.87, inside


def test_it_widens_and_hardly_moves_anything(examination, refined):
    told = refine(examination.recording, replace(examination.motions, meta={"error_correlation_s": 0.5}))
    assert np.abs(told.trajectory.T_world_body - refined.trajectory.T_world_body).max() < 0.02
    wider = np.diagonal(told.trajectory.cov - refined.trajectory.cov, axis1=1, axis2=2)
    assert (wider[:, 3:].sum(axis=1) > -1e-12).all() and wider[-1, 3:].sum() > 0
    draws = told.joint.position_errors(told.trajectory.T_world_body[:, :3, :3], np.array([299]))[:, 0]
    claimed = told.trajectory.cov[-1, 3:, 3:].trace()
    assert np.square(draws).sum(axis=1).mean() == pytest.approx(claimed, rel=0.35)
    for wrong in (-1, "long", float("inf")):
        with pytest.raises(MotionsError, match="error_correlation_s"):
            refine(examination.recording, replace(examination.motions, meta={"error_correlation_s": wrong}))


def test_both_engines_respond_alike(short, configured):
    problem = build_problem(short.recording, short.motions)
    rng = np.random.default_rng(4)
    term = MotionTerm(problem.motions, None, problem.scale_log_mean, None, np.ones(len(problem.motions)))
    errors = rng.standard_normal((3, len(problem.motions), 6))
    found = []
    for engine in (ChainEngine(), NativeEngine()):
        begin = engine.begin(problem, configured(), problem.scale_log_mean, 1.0)
        solved = engine.solve(begin, term, 30, 1e-10)
        begin = Begin(begin.model, solved.values)
        blocks = linearize(term.motions, *read_poses(begin.values), term.log_scale(begin.values))
        together = engine.responses(begin, term, blocks, errors)
        alone = [engine.response(begin, term, blocks, error) for error in errors]
        for one, other in zip(together, alone, strict=True):
            np.testing.assert_allclose(one.pose, other.pose, rtol=1e-7, atol=1e-12)
        found.append(np.array([step.pose for step in together]))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-2, atol=1e-6)


def test_fallbacks_take_the_long_run(examination):
    told = replace(examination.motions, meta={"error_correlation_s": 0.5})
    plain, longer = (build_problem(examination.recording, m) for m in (examination.motions, told))
    assert long_run(plain) is plain
    rho = np.exp(-FRAME_S / 0.5)
    ratio = plain.motions.whiten[:, 3, 3] / long_run(longer).motions.whiten[:, 3, 3]
    np.testing.assert_allclose(ratio**2, (1 + rho) / (1 - rho), rtol=1e-3)
    np.testing.assert_array_equal(plain.motions.whiten[:, :3], long_run(longer).motions.whiten[:, :3])
