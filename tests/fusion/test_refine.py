"""The whole estimate on simulated examinations: what it gains, what it survives, and what it admits."""

from dataclasses import replace

import numpy as np
import pytest

from fusion import RefineConfig, refine
from fusion.config import ScaleConfig
from vio import se3
from vio.consistency import coverage, fix_gauge, nees
from vio.errors import EstimationError
from vio.metrics import ate
from vio.motion_sources import merge_motions
from vio.motions import RelativeMotions
from vio.simulation import T_BODY_CAMERA, network_like_motions

# Held out: no threshold of fusion was chosen on these seeds.
HELD_OUT = [("small-bowel", "gaussian", 3, 301), ("colon", "collision", 3, 302), ("stomach", "peristalsis", 4, 303),
            ("colon", "none", 0, 304), ("small-bowel", "collision", 5, 306)]


def error_m(refinement, mode="se3", which="trajectory"):
    return ate(getattr(refinement, which), refinement.truth, mode).rmse_m


def gain(refinement, mode="se3"):
    """Share of the error of the motions alone that is left."""
    return error_m(refinement, mode) / error_m(refinement, mode, "motions_only")


def only(motions, keep):
    return replace(motions, t_i_s=motions.t_i_s[keep], t_j_s=motions.t_j_s[keep], T_i_j=motions.T_i_j[keep],
                   cov=motions.cov[keep])


def joined(a, b):
    return RelativeMotions(np.r_[a.t_i_s, b.t_i_s], np.r_[a.t_j_s, b.t_j_s], np.concatenate([a.T_i_j, b.T_i_j]),
                           np.concatenate([a.cov, b.cov]), a.scale_log_mean, a.scale_log_sd)


def sd_of(trajectory):
    return np.sqrt(np.diagonal(trajectory.cov, axis1=1, axis2=2))


# ---- what it gains ---------------------------------------------------------------------------

@pytest.fixture(scope="module")
def held_out(examine):
    """Examinations with what the graph and the filter make of them."""
    cases = [examine(organ, vibration, level, 70.0, seed) for organ, vibration, level, seed in HELD_OUT]
    filtered = RefineConfig(estimator="ekf")
    return [(case, {"graph": refine(case.recording, case.motions),
                    "ekf": refine(case.recording, case.motions, filtered)}) for case in cases]


def test_graph_beats_the_motions_on_every_held_out_examination(held_out):
    for case, results in held_out:
        refined = results["graph"]
        assert refined.estimator == "graph" and refined.fallback_reason is None
        for mode in ("origin", "yaw4", "se3", "sim3"):
            # Measured: 0.04 to 0.19 of the error is left; 0.32 to 0.81 of 3 mm where scale is held at a wrong prior.
            assert gain(refined, mode) < (0.95 if refined.scale.policy == "prior" else 0.4), (case.recording.name, mode)
        assert abs(refined.scale.log_mean - case.network.true_log_scale.mean()) < 3 * refined.scale.log_sd


def test_ekf_beats_the_motions_up_to_the_scale_that_it_holds(held_out):
    """Where the scale is two prior sds off, 6 mm are left of 3 mm: a filter that holds scale cannot know better."""
    gains = []
    for case, results in held_out:
        refined = results["ekf"]
        assert refined.estimator == "ekf" and refined.scale.policy == "fixed"
        assert gain(refined, "sim3") < 0.6, case.recording.name
        gains.append(gain(refined))
    assert np.exp(np.mean(np.log(gains))) < 0.4
    assert max(gains) < 2.2  # measured 1.92, else at most 0.12
    assert sorted(gains)[-2] < 0.3


@pytest.mark.parametrize(("estimator", "highest"), [("graph", 2.6), ("ekf", 4.0)])
def test_claimed_covariances_are_honest(held_out, estimator, highest):
    """NEES 1 is perfect; the reported covariances of the motions are off by 20 % in sd, which alone makes 1.08.

    Measured for the graph: 0.9 to 2.3 (collisions in the colon), 1.4 in the mean.
    """
    values = [np.nanmean(nees(results[estimator].trajectory, results[estimator].truth)) for _, results in held_out]
    assert max(values) < highest, values
    assert 0.5 < np.exp(np.mean(np.log(values))) < highest / 1.3, values


def test_free_scale_intervals_cover_the_truth(held_out):
    inside = [coverage(results["graph"].log_scale[:-1], results["graph"].log_scale_sd[:-1],
                       case.network.true_log_scale) for case, results in held_out]
    assert np.mean(inside) > 0.75, inside


def test_the_world_is_level_and_starts_at_the_origin(refined):
    first = refined.trajectory.T_world_body[0]
    np.testing.assert_allclose(first[:3, 3], 0, atol=1e-4)
    up_in_body = refined.trajectory.rotations[:, 2], refined.truth.rotations[:, 2]
    tilt = np.arccos(np.clip(np.einsum("nk,nk->n", *up_in_body), -1, 1))
    assert np.rad2deg(tilt).max() < 0.5
    cov = refined.trajectory.cov[0]
    R = first[:3, :3]
    world = R @ cov[:3, :3] @ R.T
    assert np.sqrt(world[2, 2]) < 2e-5 and np.sqrt(np.trace(cov[3:, 3:])) < 2e-5  # the gauge: exact yaw and position


def test_biases_and_velocities_are_found(refined, examination):
    state = examination.recording.truth_state
    np.testing.assert_allclose(refined.gyro_bias_rad_s, state.gyro_bias_rad_s, atol=5e-4)
    np.testing.assert_allclose(refined.accel_bias_m_s2, state.accel_bias_m_s2, atol=0.02)
    moved = fix_gauge(refined.trajectory, refined.truth)
    turn = moved.rotations[0] @ refined.truth.rotations[0].T
    assert np.sqrt(np.mean(np.square(refined.velocity_m_s - state.velocity_m_s @ turn.T))) < 1e-3


def test_outliers_are_found(refined, examination):
    outliers = np.flatnonzero(examination.network.is_outlier)
    assert len(outliers) >= 4 and np.isin(outliers, refined.rejected).all()
    assert len(refined.rejected) <= 2 * len(outliers)
    assert refined.motions_used == len(examination.motions) - len(refined.rejected)


def test_motions_alone_are_the_chain_at_the_prior_scale(refined, examination):
    scale = np.exp(examination.motions.scale_log_mean)
    T = refined.trajectory.T_world_body[0] @ T_BODY_CAMERA
    for step in examination.motions.T_i_j:
        metric = step.copy()
        metric[:3, 3] *= scale
        T = T @ metric
    np.testing.assert_allclose(refined.motions_only.T_world_body[-1], T @ np.linalg.inv(T_BODY_CAMERA), atol=1e-9)


# ---- the same every time ---------------------------------------------------------------------

@pytest.mark.parametrize("estimator", ["graph", "ekf"])
def test_two_runs_give_the_same_bytes(short, configured, estimator):
    a, b = (refine(short.recording, short.motions, configured(estimator=estimator)) for _ in range(2))
    for name in ("velocity_m_s", "gyro_bias_rad_s", "accel_bias_m_s2", "log_scale", "log_scale_sd", "rejected"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name
    assert a.trajectory.T_world_body.tobytes() == b.trajectory.T_world_body.tobytes()
    assert a.trajectory.cov.tobytes() == b.trajectory.cov.tobytes()
    assert a.scale == b.scale and a.imu == b.imu


def test_inputs_are_not_changed(short):
    imu, motions = short.recording.imu, short.motions
    before = [x.copy() for x in (imu.t_ns, imu.gyro_rad_s, imu.accel_m_s2, motions.T_i_j, motions.cov)]
    refine(short.recording, short.motions)
    for old, new in zip(before, (imu.t_ns, imu.gyro_rad_s, imu.accel_m_s2, motions.T_i_j, motions.cov), strict=True):
        np.testing.assert_array_equal(old, new)


def test_stages_are_announced_as_they_begin(short):
    heard = []
    refined = refine(short.recording, short.motions, announce=heard.append)
    assert heard[0] == "checks" and heard[-1] == "covariances"
    assert set(heard) == set(refined.timing_s)


# ---- rest, gaps, sparse motions --------------------------------------------------------------

def test_half_an_hour_at_rest_stays_where_it_is(examine):
    still = examine("small-bowel", "none", 0, 1800.0, 311, mode="rest", frame_rate_hz=0.5)
    refined = refine(still.recording, still.motions)
    assert refined.estimator == "graph" and len(refined.trajectory) == 900
    assert refined.scale.policy == "prior" and "hardly moved" in refined.scale.reason
    assert refined.scale.log_mean == still.motions.scale_log_mean
    # A chain of 900 motions with 0.05 mm of noise per axis, a lever arm and 18 outliers wanders 8 mm.
    off = refined.trajectory.positions_m
    assert np.abs(off).max() < 0.04
    assert np.abs(off[1:] / sd_of(refined.trajectory)[1:, 3:]).max() < 4
    assert np.linalg.norm(refined.velocity_m_s, axis=1).max() < 0.01  # 2 s of accelerometer noise: 2 mm/s per axis
    np.testing.assert_allclose(refined.gyro_bias_rad_s, still.recording.truth_state.gyro_bias_rad_s, atol=1e-3)
    assert np.nanmean(nees(refined.trajectory, refined.truth)) < 3


@pytest.fixture(scope="module")
def filtered_rest(examine, configured):
    still = examine("small-bowel", "none", 0, 100.0, 313, mode="rest")
    return refine(still.recording, still.motions, configured(estimator="ekf"))


def test_the_filter_stays_at_rest_too(filtered_rest):
    off = filtered_rest.trajectory.positions_m
    assert np.abs(off).max() < 0.01
    assert np.abs(off[1:] / sd_of(filtered_rest.trajectory)[1:, 3:]).max() < 4


@pytest.mark.xfail(strict=True, reason="at rest the filter believes to tell tilt from accelerometer bias: 3 mrad "
                                       "claimed, 30 mrad off; the known inconsistency of an EKF's linearisation")
def test_the_filter_is_honest_at_rest(filtered_rest):
    assert np.nanmean(nees(filtered_rest.trajectory, filtered_rest.truth)) < 4


@pytest.mark.parametrize("estimator", ["graph", "ekf"])
def test_a_gap_in_the_imu_is_listed_and_widens_what_was_not_seen(examination, configured, refined, estimator):
    imu_t = examination.recording.imu_t_s
    gapped = examination.with_samples((imu_t < 50) | (imu_t > 52))
    config = configured(estimator=estimator)
    result = refine(gapped, examination.motions, config)
    assert result.estimator == estimator
    gap, = result.imu.gaps
    assert (gap.start_s, gap.end_s) == (pytest.approx(50, abs=0.03), pytest.approx(52, abs=0.03))
    assert gain(result) < 0.95  # the filter holds its prior scale
    before, after = 149, 157  # 49.67 s and 52.33 s
    def turn_sd(trajectory):
        """Uncertainty that a stretch adds to the attitude."""
        total = np.sqrt((sd_of(trajectory)[:, :3] ** 2).sum(axis=1))
        return np.sqrt(max(total[after] ** 2 - total[before] ** 2, 0.0))  # gravity may make it smaller

    whole = refine(examination.recording, examination.motions, config)
    assert turn_sd(result.trajectory) > max(5 * turn_sd(whole.trajectory), 1e-3)
    # The motions bridge it: their rotations are known to 0.3 degrees each, within a factor for the reported sd.
    assert np.deg2rad(0.3) < turn_sd(result.trajectory) < np.deg2rad(5)


def test_lost_radio_takes_imu_and_motions_together(examination):
    imu_t, motions = examination.recording.imu_t_s, examination.motions
    gapped = examination.with_samples((imu_t < 50) | (imu_t > 52))
    heard = only(motions, (motions.t_i_s < 49.5) | (motions.t_i_s > 52))
    refined = refine(gapped, heard)
    assert refined.estimator == "graph" and refined.bridged == len(motions) - len(heard) == 8
    assert gain(refined) < 1
    along = np.sqrt((sd_of(refined.trajectory)[:, 3:] ** 2).sum(axis=1))
    assert along[160] > 5 * along[148]  # nothing was seen: so it says


@pytest.mark.parametrize("estimator", ["graph", "ekf"])
def test_pairs_without_a_motion_are_counted_and_bridged_by_the_imu(examination, configured, estimator):
    keep = np.ones(len(examination.motions), bool)
    keep[[40, 41, 42, 150, 200]] = False
    refined = refine(examination.recording, only(examination.motions, keep), configured(estimator=estimator))
    assert refined.bridged == 5
    assert len(refined.trajectory) == 300
    assert gain(refined) < 0.95


def test_only_the_frames_that_the_motions_span_are_placed(examination):
    refined = refine(examination.recording, only(examination.motions, slice(100, 160)))
    assert len(refined.trajectory) == 61
    np.testing.assert_array_equal(refined.trajectory.t_s, examination.recording.frame_t_s[100:161])
    assert gain(refined) < 0.95


@pytest.mark.parametrize("count", [1, 2, 3, 5, 10])
def test_a_few_frames_are_enough(examination, count):
    refined = refine(examination.recording, only(examination.motions, slice(0, count)))
    assert refined.estimator == "graph" and len(refined.trajectory) == count + 1
    assert error_m(refined, "origin") < 3e-3


def wide_motions(examination, span, every=1):
    """Motions from frame k to k + span, measured independently with the noise of the others."""
    rng = np.random.default_rng(5)
    camera = examination.recording.truth.T_world_body @ T_BODY_CAMERA
    k = np.arange(0, len(camera) - span, every)
    T = se3.inverse(camera[k]) @ camera[k + span]
    units = np.exp(-examination.network.true_log_scale[k])
    step = np.linalg.norm(T[:, :3, 3], axis=1)
    sd = np.repeat([[np.deg2rad(0.3), 1.0]], 3, axis=1) * np.ones((len(k), 6))
    sd[:, 3:] *= ((0.03 * step + 5e-5) * units)[:, None]
    T[:, :3, 3] *= units[:, None]
    cov = np.zeros((len(k), 6, 6))
    cov[:, np.arange(6), np.arange(6)] = sd**2
    t = examination.recording.truth.t_s
    prior = examination.motions
    return RelativeMotions(t[k], t[k + span], T @ se3.exp(sd * rng.standard_normal(sd.shape)), cov,
                           prior.scale_log_mean, prior.scale_log_sd)


def test_wide_baselines_help_the_graph(examination, refined, configured):
    both = joined(examination.motions, wide_motions(examination, 2))
    wider = refine(examination.recording, both)
    assert wider.estimator == "graph" and wider.motions_used + len(wider.rejected) == 597
    assert error_m(wider) < 1.02 * error_m(refined)  # of one recording; what is claimed must shrink
    assert sd_of(wider.trajectory)[-1, 3:].max() < sd_of(refined.trajectory)[-1, 3:].max()
    np.testing.assert_array_equal(wider.motions_only.positions_m[0], wider.trajectory.positions_m[0])
    assert error_m(wider, which="motions_only") == pytest.approx(error_m(refined, which="motions_only"), rel=1e-6)


def test_key_frames_alone_are_enough_for_the_graph_but_not_for_the_filter(examination, configured):
    motions = wide_motions(examination, 3, every=3)
    refined = refine(examination.recording, motions)
    assert refined.estimator == "graph" and error_m(refined) < 0.01
    assert refined.bridged == 0
    with pytest.raises(EstimationError, match="no motion joins two neighbouring frames"):
        refine(examination.recording, motions, configured(estimator="ekf"))


# ---- scale -----------------------------------------------------------------------------------

def test_a_metric_source_keeps_its_scale(examination, configured):
    exact = replace(examination.motions, scale_log_sd=0.0)
    refined = refine(examination.recording, exact)
    assert refined.estimator == "graph"
    assert refined.scale.policy == "fixed" and refined.scale.log_sd == 0
    assert (refined.log_scale == exact.scale_log_mean).all() and (refined.log_scale_sd == 0).all()


@pytest.mark.parametrize("policy", ["free", "prior", "fixed"])
def test_a_policy_that_was_asked_for_is_followed(examination, configured, policy):
    refined = refine(examination.recording, examination.motions, configured(scale=ScaleConfig(policy=policy)))
    assert refined.scale.policy == policy and "asked for" in refined.scale.reason
    assert gain(refined) < 0.95


@pytest.mark.parametrize(("off", "sd"), [(1.0, 1.0), (-4.0, 2.0)])
def test_a_vague_prior_is_searched(examination, off, sd):
    """From a scale 50 times too small Gauss-Newton alone does not find home."""
    vague = replace(examination.motions, scale_log_mean=examination.motions.scale_log_mean + off, scale_log_sd=sd)
    refined = refine(examination.recording, vague)
    assert refined.scale.policy == "free"
    assert abs(refined.scale.log_mean - examination.network.true_log_scale.mean()) < 0.1
    assert gain(refined) < 0.3


def test_two_sources_beat_either_and_one_given_twice_gains_nothing(examination, refined):
    """A second network with noise of its own, in a unit of its own."""
    truth = examination.recording.truth_at_frames()
    other = network_like_motions(truth, T_BODY_CAMERA, 77, scale_log_mean=np.log(2.0)).motions
    merged = merge_motions([examination.motions, other])
    both = refine(examination.recording, merged.motions)
    alone = refine(examination.recording, other)
    assert (merged.correlation[0, 1] < 0.15).all()
    sd = [np.sqrt(r.trajectory.cov[-1, 3:, 3:].trace()) for r in (both, refined, alone)]
    assert sd[0] < 0.9 * min(sd[1:]) and np.nanmean(nees(both.trajectory, both.truth)) < 3
    twice = refine(examination.recording, merge_motions([examination.motions] * 2).motions)
    assert np.sqrt(twice.trajectory.cov[-1, 3:, 3:].trace()) == pytest.approx(sd[1], rel=0.1)
