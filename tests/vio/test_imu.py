"""Cutting inertial samples at frames, and telling good samples from bad ones, on real and simulated data."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from vio import open_recording, se3
from vio.errors import ImuError
from vio.imu import ImuNoise, ImuSamples, find_gaps, preintegrate_rotation, split_at_frames
from vio.imu_checks import check_imu, find_saturation, gyro_in_degrees
from vio.simulation.scenario import simulate_recording


@st.composite
def cut_problems(draw):
    """Irregular samples and irregular frames inside them, some of which coincide."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n, m = draw(st.integers(2, 40)), draw(st.integers(1, 12))
    t = np.cumsum(rng.uniform(0.001, 0.1, n))
    frames = np.sort(rng.uniform(t[0], t[-1], m + 1))
    if draw(st.booleans()):
        candidates = np.concatenate([t, 0.5 * (t[1:] + t[:-1])])
        frames = np.sort(rng.choice(candidates, min(m + 1, len(candidates)), replace=False))
    frames = frames[np.diff(frames, prepend=-1.0) > 1e-6]
    if len(frames) < 2:
        frames = t[[0, -1]]
    samples = ImuSamples((t * 1e9).astype(np.int64), rng.normal(0, 2, (n, 3)), rng.normal(0, 9, (n, 3)))
    return samples, t, frames


@given(cut_problems(), st.lists(st.floats(-3, 3), min_size=12, max_size=12))
def test_signals_that_change_steadily_are_cut_exactly(problem, coefficients):
    # Whatever the stamps and the cuts: rates a + b t integrate exactly, forces are turned from piece centre to start,
    # and forces alone integrate exactly twice.
    samples, t, frames = problem
    a, b, c, d = np.reshape(coefficients, (4, 3))
    samples = replace(samples, gyro_rad_s=a + b * t[:, None], accel_m_s2=c + d * t[:, None])
    pieces = split_at_frames(samples, t, frames)
    assert pieces.first[0] == 0 and pieces.first[-1] == len(pieces.dt_s) and (pieces.dt_s > 0).all()
    centre = frames[0] + np.cumsum(pieces.dt_s) - 0.5 * pieces.dt_s
    half_turn = se3.so3_exp((a + b * centre[:, None]) * 0.5 * pieces.dt_s[:, None])
    turned_force = (half_turn @ (c + d * centre[:, None])[..., None])[..., 0]
    still = split_at_frames(replace(samples, gyro_rad_s=np.zeros_like(samples.gyro_rad_s)), t, frames)
    for k in range(len(frames) - 1):
        part, (lo, hi) = slice(pieces.first[k], pieces.first[k + 1]), frames[k:k + 2]
        h = pieces.dt_s[part]
        np.testing.assert_allclose(h.sum(), hi - lo, rtol=1e-12)
        np.testing.assert_allclose(h @ pieces.accel_m_s2[part], h @ turned_force[part], atol=1e-6)
        arm = hi - centre[part]
        if h @ (arm - (hi - lo) / 2) ** 2 > 0.021 * (hi - lo) ** 3:
            exact = c * (hi - lo) ** 2 / 2 + d * ((hi - lo) ** 3 / 6 + lo * (hi - lo) ** 2 / 2)
            np.testing.assert_allclose((h * arm) @ still.accel_m_s2[part], exact, atol=1e-6)
        turned = pieces.dt_s[part] @ pieces.gyro_rad_s[part]
        np.testing.assert_allclose(turned, a * (hi - lo) + b * (hi**2 - lo**2) / 2, atol=1e-7)


@given(cut_problems())
def test_a_sample_keeps_its_average_over_its_cell_however_it_is_cut(problem):
    samples, _, cuts = problem
    t = np.arange(len(samples)) * 0.025
    inside = np.interp(cuts, [cuts[0], cuts[-1]], [t[0], t[-1]])
    frames = np.union1d(inside, t[1:] - 0.0125)  # every cell edge, and cuts anywhere between
    frames = frames[np.diff(frames, prepend=-1.0) > 1e-6]
    pieces = split_at_frames(samples, t, frames)
    end = frames[0] + np.cumsum(pieces.dt_s)
    for k in range(1, len(t) - 1):
        cell = (end > t[k] - 0.0125 + 1e-6) & (end < t[k] + 0.0125 + 1e-6)
        turned = pieces.dt_s[cell] @ pieces.gyro_rad_s[cell]
        np.testing.assert_allclose(turned, 0.025 * samples.gyro_rad_s[k], atol=2e-5)


@given(cut_problems())
def test_longest_spacing_is_that_of_the_stamps_that_touch_an_interval(problem):
    samples, t, frames = problem
    longest = split_at_frames(samples, t, frames).longest_s
    for k in range(len(frames) - 1):
        touching = [b - a for a, b in pairwise(t) if b > frames[k] and a < frames[k + 1]]
        assert longest[k] == pytest.approx(max(touching))


def test_a_steady_turn_under_gravity_hardly_leaks():
    # At a constant rate every piece must point its force at the world's; turned by nothing it would be 0.28 m/s² off.
    rate, up = np.array([0.3, -2.0, 1.1]), np.array([0.0, 0.0, 9.81])
    t = np.arange(-0.1, 2.2, 0.025)
    force = np.stack([expm(-se3.skew(rate * time)) @ up for time in t])
    samples = ImuSamples((t * 1e9).astype(np.int64), np.tile(rate, (len(t), 1)), force)
    pieces = split_at_frames(samples, t, np.arange(0, 2.01, 0.333))
    start = np.cumsum(pieces.dt_s) - pieces.dt_s
    world = np.stack([expm(se3.skew(rate * time)) @ f for time, f in zip(start, pieces.accel_m_s2, strict=True)])
    np.testing.assert_allclose(world, np.broadcast_to(up, world.shape), atol=4e-3)


@given(cut_problems(), st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)))
@settings(max_examples=30)
def test_preintegrated_rotation_is_the_product_of_its_pieces(problem, bias):
    samples, t, frames = problem
    pieces = split_at_frames(samples, t, frames)
    R = preintegrate_rotation(pieces, bias)
    for k in range(len(frames) - 1):
        oracle = np.eye(3)
        for p in range(pieces.first[k], pieces.first[k + 1]):
            oracle = oracle @ expm(se3.skew((pieces.gyro_rad_s[p] - bias) * pieces.dt_s[p]))
        np.testing.assert_allclose(R[k], oracle, atol=1e-12)


def test_euroc_gyro_follows_the_truth_and_its_stamps_are_centres(shared_data):
    euroc = open_recording(shared_data / "euroc_v101")
    truth = euroc.truth.select(np.arange(1, len(euroc.truth) - 1))
    turned = np.swapaxes(truth.rotations[:-1], 1, 2) @ truth.rotations[1:]
    bias = np.median(euroc.truth_state.gyro_bias_rad_s, axis=0)

    def median_deg(R):
        return np.rad2deg(np.median(np.linalg.norm(se3.so3_log(R), axis=1)))

    def off_deg(shift_s):
        R = preintegrate_rotation(split_at_frames(euroc.imu, euroc.imu_t_s + shift_s, truth.t_s), bias)
        return median_deg(np.swapaxes(R, 1, 2) @ turned)

    assert median_deg(turned) > 0.5
    assert off_deg(0.0) < 0.01
    assert min(off_deg(0.0025), off_deg(-0.0025)) > 2 * off_deg(0.0)  # half a sample earlier or later


def test_samples_must_reach_over_all_frames():
    t = np.arange(0, 1, 0.01)
    samples = ImuSamples((t * 1e9).astype(np.int64), np.zeros((100, 3)), np.zeros((100, 3)))
    assert split_at_frames(samples, t, [-0.014, 0.5, 1.004]).dt_s.sum() == pytest.approx(1.018)
    for frames in ([-0.016, 0.5], [0.5, 1.006]):
        with pytest.raises(ImuError, match=r"imu covers 0\.000 to 0\.990 s but frames run from"):
            split_at_frames(samples, t, frames)
    empty = ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(ImuError, match="no samples"):
        split_at_frames(empty, np.zeros(0), [0.0, 1.0])


def test_gaps_are_the_holes_over_the_limit():
    gaps = find_gaps([0.0, 0.4, 0.9, 1.5, 1.6, 3.0])
    assert [(gap.start_s, gap.end_s) for gap in gaps] == [(0.9, 1.5), (1.6, 3.0)]


# --- check_imu -----------------------------------------------------------------------------------------------------


def resting(n: int = 400, seed: int = 0, step: float = 0.0) -> ImuSamples:
    """A still sensor at 40 Hz, optionally quantised."""
    rng = np.random.default_rng(seed)
    gyro, accel = rng.normal(0, 0.002, (n, 3)), rng.normal(0, 0.02, (n, 3)) + np.array([0.3, -0.2, 9.8])
    if step:
        gyro, accel = np.round(gyro / step) * step, np.round(accel / step) * step
    return ImuSamples(np.arange(n, dtype=np.int64) * 25_000_000, gyro, accel)


def in_degrees(samples: ImuSamples) -> ImuSamples:
    return replace(samples, gyro_rad_s=np.rad2deg(samples.gyro_rad_s))


def test_good_samples_pass_and_are_described(shared_data):
    report = check_imu(resting(), ImuNoise())
    assert report.rate_hz == pytest.approx(40) and report.gravity_m_s2 == pytest.approx(9.81, abs=0.01)
    assert (report.gaps, report.saturated, report.warnings) == ((), {}, ())
    euroc = open_recording(shared_data / "euroc_v101")
    report = check_imu(euroc.imu, euroc.calibration.imu_noise)
    assert report.rate_hz == pytest.approx(200, rel=1e-4) and report.gravity_m_s2 == pytest.approx(9.81, abs=0.01)
    assert (report.gaps, report.saturated, report.warnings) == ((), {}, ())


def test_no_part_of_euroc_looks_like_degrees_and_most_of_it_does_in_degrees(shared_data):
    # A drone is the hard case: its thrust, and so the measured force, keeps its place in the body as it tilts.
    imu = open_recording(shared_data / "euroc_v101").imu
    found = []
    for length in (400, 2000):
        for first in range(0, len(imu) - length, 1200):
            part = slice(first, first + length)
            cut = ImuSamples(imu.t_ns[part], imu.gyro_rad_s[part], imu.accel_m_s2[part])
            assert not gyro_in_degrees(cut)
            found.append(gyro_in_degrees(in_degrees(cut)))
    assert np.mean(found) > 0.8
    assert gyro_in_degrees(in_degrees(imu))
    with pytest.raises(ImuError, match="pi/180"):
        check_imu(in_degrees(imu), ImuNoise(rate_hz=200))


def test_a_real_resting_sensor_shows_degrees_by_its_bias(shared_data):
    counts = np.load(shared_data / "imu_static_adis16405" / "adis_16405_imu1.npz")
    counts = counts[counts.files[0]][:60_000].astype(float)
    t_ns = np.arange(len(counts), dtype=np.int64) * 10_000_000
    samples = ImuSamples(t_ns, np.deg2rad(counts[:, :3] * 0.05), counts[:, 3:] * 0.00333 * 9.80665)
    report = check_imu(samples, ImuNoise(rate_hz=100))
    assert report.saturated == {} and report.warnings == ()
    with pytest.raises(ImuError, match="scatters the direction of gravity"):
        check_imu(in_degrees(samples), ImuNoise(rate_hz=100))


@pytest.mark.parametrize("mode", ["moving", "rest"])
@pytest.mark.parametrize(("vibration", "level"), [("none", 0), ("gaussian", 5), ("peristalsis", 5), ("collision", 5)])
def test_simulated_capsules_are_judged_rightly(vibration, level, mode):
    recording = simulate_recording("small-bowel", vibration, level, 30.0, 3, mode=mode)
    noise = recording.calibration.imu_noise
    report = check_imu(recording.imu, noise)
    assert report.warnings == ()
    if mode == "moving":  # at rest a gyro with a small bias reads nothing that could betray its unit
        with pytest.raises(ImuError, match="pi/180"):
            check_imu(in_degrees(recording.imu), noise)


def test_forces_that_point_anywhere_decide_nothing():
    samples = resting()
    shaken = samples.accel_m_s2 + np.random.default_rng(1).normal(0, 20, (400, 3))
    assert not gyro_in_degrees(replace(samples, gyro_rad_s=samples.gyro_rad_s + 0.5, accel_m_s2=shaken))


def test_a_turn_about_gravity_alone_is_left_undecided():
    samples = resting()
    gyro = samples.gyro_rad_s + np.array([0.3, -0.2, 9.8]) / 9.81
    assert not gyro_in_degrees(replace(samples, gyro_rad_s=gyro))


@pytest.mark.parametrize(("factor", "words"), [
    (1 / 9.80665, r"median specific force is 0\.9997, which looks like g; multiply the accelerometer by 9\.80665"),
    (1000 / 9.80665, r"looks like mg; multiply the accelerometer by 0\.00980665"),
    (0.01, "no gravity in it.*not linear acceleration"),
    (1.4, "no gravity in it"),
])
def test_accelerometers_in_other_units_or_without_gravity(factor, words):
    samples = resting()
    with pytest.raises(ImuError, match=words):
        check_imu(replace(samples, accel_m_s2=samples.accel_m_s2 * factor), ImuNoise())


@pytest.mark.parametrize(("name", "axis", "words"), [
    ("gyro_rad_s", 1, "imu row 17 at 0.425 s: gyro y is not finite"),
    ("accel_m_s2", 2, "imu row 17 at 0.425 s: accelerometer z is not finite"),
])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite(name, axis, words, value):
    samples = resting()
    getattr(samples, name)[17, axis] = value
    with pytest.raises(ImuError, match=words):
        check_imu(samples, ImuNoise())


@pytest.mark.parametrize(("copied", "word"), [(19, "repeats"), (18, "is earlier than")])
def test_stamps_that_do_not_increase(copied, word):
    samples = resting()
    samples.t_ns[20] = samples.t_ns[copied]
    with pytest.raises(ImuError, match=f"row 20: stamp .* {word}.*drop duplicates"):
        check_imu(samples, ImuNoise())


def test_a_peak_beyond_any_gyro():
    samples = resting()
    samples.gyro_rad_s[30, 2] = -40
    with pytest.raises(ImuError, match=r"imu row 30 at 0\.750 s: gyro z is 40 rad/s \(limit 35 = 2000 deg/s\)"):
        check_imu(samples, ImuNoise())


def test_shapes_and_empty_streams():
    samples = resting()
    with pytest.raises(ImuError, match="0 samples"):
        check_imu(ImuSamples(samples.t_ns[:0], samples.gyro_rad_s[:0], samples.accel_m_s2[:0]), ImuNoise())
    with pytest.raises(ImuError, match=r"400 stamps but accel_m_s2 of shape \(399, 3\)"):
        check_imu(replace(samples, accel_m_s2=samples.accel_m_s2[1:]), ImuNoise())


def tumbling(full_scale: float = np.inf) -> ImuSamples:
    """Still, but for a second of violent shaking, cut at a full scale [rad/s]."""
    samples = resting(2000)
    samples.gyro_rad_s[1000:1040, 0] += 9 * np.sin(np.arange(40) * 0.3)
    return replace(samples, gyro_rad_s=np.clip(samples.gyro_rad_s, -full_scale, full_scale))


def test_saturation_with_and_without_a_known_range():
    clipped = tumbling(4.36)
    at_limit = int((np.abs(clipped.gyro_rad_s[:, 0]) == 4.36).sum())
    assert at_limit > 10
    for noise in (ImuNoise(), ImuNoise(gyro_range_rad_s=4.36)):
        report = check_imu(clipped, noise)
        assert report.saturated == {"gyro x": at_limit}
        assert f"gyro x sits at full scale in {at_limit} samples" in report.warnings[0]
    assert check_imu(tumbling(), ImuNoise()).saturated == {}


@pytest.mark.parametrize("step", [0.0, 1e-3, 0.02, 0.2])
def test_a_resting_quantised_sensor_is_not_saturated(step):
    assert check_imu(resting(4000, step=step), ImuNoise(gyro_range_rad_s=34.9)).saturated == {}


def test_a_slow_swing_that_dwells_at_its_ends_is_not_saturated():
    samples = resting(4000)
    swing = np.round(3 * np.sin(2 * np.pi * 0.02 * np.arange(4000) * 0.025), 1)
    assert (swing == 3).sum() > 100
    samples.gyro_rad_s[:, 0] = swing
    assert find_saturation(samples, ImuNoise()) == {}


def test_oddities_are_warnings():
    samples = resting()
    samples.gyro_rad_s[:, 2] = 0.0
    samples.t_ns[200:] += 700_000_000
    report = check_imu(samples, ImuNoise(rate_hz=100))
    assert [(round(gap.start_s, 3), round(gap.end_s, 3)) for gap in report.gaps] == [(4.975, 5.7)]
    words = ("40 Hz but the calibration says 100 Hz", "gyro z reads 0 in every sample", "1 gaps over 0.5 s")
    assert len(report.warnings) == 3
    assert all(word in line for word, line in zip(words, report.warnings, strict=True))


def test_an_axis_lost_in_saturation_is_refused_by_name():
    samples = resting(2000)
    samples.gyro_rad_s[:, 1] = np.clip(9 * np.sin(np.arange(2000) * 0.3), -2.18, 2.18)
    with pytest.raises(ImuError, match=r"gyro y sits at full scale in \d+ of 2000 samples .*limit 5 %"):
        check_imu(samples, ImuNoise(gyro_range_rad_s=2.18))
