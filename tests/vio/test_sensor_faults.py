"""Sensor faults: each does what its name says and nothing else, and the checks that should notice it do."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vio import sensor_faults as faults
from vio.errors import CorruptionError
from vio.imu import ImuNoise, ImuSamples, find_gaps
from vio.imu_checks import check_imu

FIRST_NS = 1_403_715_273_262_142_977


def stream(n=400, seed=0):
    rng = np.random.default_rng(seed)
    t = FIRST_NS + np.arange(n, dtype=np.int64) * 25_000_000
    return ImuSamples(t, rng.normal(0, 0.3, (n, 3)), rng.normal([0, 0, 9.81], 0.4, (n, 3)))


def rows(samples):
    return {int(t): (*w, *a) for t, w, a in zip(samples.t_ns, samples.gyro_rad_s, samples.accel_m_s2, strict=True)}


@given(st.floats(-1, 11), st.floats(0, 9))
def test_a_gap_removes_its_span_and_nothing_else(start_s, duration_s):
    whole = stream()
    holed = faults.with_gap(whole, start_s, duration_s) if duration_s < 9 else whole
    lost = [(t - FIRST_NS) * 1e-9 for t in rows(whole).keys() - rows(holed).keys()]
    assert rows(holed).items() <= rows(whole).items()
    assert all(start_s - 1e-9 <= t < start_s + duration_s for t in lost)
    if duration_s < 9:
        assert len(lost) == sum(start_s <= (t - FIRST_NS) * 1e-9 < start_s + duration_s for t in rows(whole))


def test_faults_are_seen_by_the_checks_of_the_imu():
    whole, noise = stream(), ImuNoise()
    assert check_imu(whole, noise).warnings == ()
    for broken, words in [
        (faults.with_gap(whole, 3.0, 1.2), "gap"),
        (faults.with_drops(whole, 0.6, np.random.default_rng(1)), "Hz"),
    ]:
        assert any(words in line for line in check_imu(broken, noise).warnings), words
    assert find_gaps((faults.with_gap(whole, 3.0, 1.2).t_ns - FIRST_NS) * 1e-9)[0].start_s == pytest.approx(2.975)
    clipped = faults.with_saturation(whole, gyro_range_rad_s=0.65)
    ranged = check_imu(clipped, replace(noise, gyro_range_rad_s=0.65))
    assert any("full scale" in line for line in ranged.warnings)
    assert (clipped.accel_m_s2 == whole.accel_m_s2).all() and np.abs(clipped.gyro_rad_s).max() == 0.65


def test_drops_keep_the_ends_and_their_share():
    whole = stream(4000)
    once, again = (faults.with_drops(whole, 0.3, np.random.default_rng(5)) for _ in range(2))
    assert rows(once) == rows(again) and rows(once).items() <= rows(whole).items()
    assert len(once) == pytest.approx(2800, abs=100)
    assert once.t_ns[0] == whole.t_ns[0] and once.t_ns[-1] == whole.t_ns[-1]
    assert len(faults.with_drops(whole, 1.0, np.random.default_rng(0))) == 2


@given(st.floats(-5, 5))
def test_a_time_shift_moves_stamps_to_the_nanosecond(shift_s):
    whole = stream(20)
    there = faults.with_time_shift(whole, shift_s)
    assert (there.t_ns - whole.t_ns == round(shift_s * 1e9)).all()
    assert rows(faults.with_time_shift(there, -shift_s)) == rows(whole)


def test_axes_and_biases_change_only_where_they_were_told_to():
    whole = stream()
    swapped = faults.with_swapped_axes(whole, "accel", 0, 2)
    np.testing.assert_array_equal(swapped.accel_m_s2, whole.accel_m_s2[:, [2, 1, 0]])
    assert rows(faults.with_swapped_axes(swapped, "accel", 2, 0)) == rows(whole)
    dead = faults.with_dead_axis(whole, "accel", 2, 9.81)
    assert (dead.accel_m_s2[:, 2] == 9.81).all() and (dead.accel_m_s2[:, :2] == whole.accel_m_s2[:, :2]).all()
    step = faults.with_bias_step(whole, 5.0, gyro_rad_s=[0.1, 0, -0.2])
    np.testing.assert_allclose(step.gyro_rad_s - whole.gyro_rad_s,
                               (np.arange(400) >= 200)[:, None] * np.array([0.1, 0, -0.2]), atol=1e-15)
    assert (step.accel_m_s2 == whole.accel_m_s2).all() and rows(whole) == rows(stream())


def test_lost_frames_leave_every_other_frame_with_its_image_truth_and_imu(recording):
    kept = np.array([False, True, True, False, True, True, True])
    less = faults.without_frames(recording, kept)
    assert (less.frame_t_ns == recording.frame_t_ns[kept]).all() and less.imu is recording.imu
    np.testing.assert_array_equal(less.frame(3), recording.frame(5))
    assert less.depth_m(1) is None and (less.depth_m(2) == recording.depth_m(4)).all()
    old, new = recording.truth_at_frames(), less.truth_at_frames()
    at = np.isin(np.round(old.t_s, 6), np.round(new.t_s + recording.frame_t_s[1], 6))
    np.testing.assert_allclose(new.T_world_body, old.T_world_body[at], atol=1e-6)
    assert len(new.t_s) == kept[:len(old.t_s)].sum()


@pytest.mark.parametrize(("fault", "words"), [
    (lambda s: faults.with_gap(s, 0.0, 100.0), "none of 400 samples"), (lambda s: faults.with_gap(s, 0.0, -1), "≥ 0"),
    (lambda s: faults.with_drops(s, 1.5, np.random.default_rng(0)), "between 0 and 1"),
    (lambda s: faults.with_time_shift(s, np.nan), "finite"), (lambda s: faults.with_saturation(s, 0.0), "positive"),
    (lambda s: faults.with_dead_axis(s, "gyro", 3), "use 0, 1 or 2"),
    (lambda s: faults.with_dead_axis(s, "compass", 0), "unknown"),
    (lambda s: faults.with_swapped_axes(s, "gyro", 1, 1), "two axes"),
    (lambda s: faults.with_bias_step(s, 1.0, [1, 2]), "three finite numbers"),
])
def test_impossible_faults_are_refused_in_one_line(fault, words):
    with pytest.raises(CorruptionError, match=words) as caught:
        fault(stream())
    assert "\n" not in str(caught.value)


def test_losing_all_frames_is_refused(recording):
    with pytest.raises(CorruptionError, match="at least one"):
        faults.without_frames(recording, np.zeros(7, bool))
    with pytest.raises(CorruptionError, match="one True or False per frame"):
        faults.without_frames(recording, [0, 1])
