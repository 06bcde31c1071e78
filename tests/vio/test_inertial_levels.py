"""What the IMU felt along time, against signals whose levels are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vio.errors import ImuError
from vio.imu import ImuSamples
from vio.inertial_levels import MOST_SPANS, InertialLevels, inertial_levels


def samples_of(t: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> ImuSamples:
    return ImuSamples((t * 1e9).astype(np.int64), gyro, accel)


@settings(max_examples=30)
@given(amplitude=st.floats(0.01, 20), hz=st.floats(4, 18), seed=st.integers(0, 2**16))
def test_a_shake_has_its_own_rms_and_slow_turns_have_none(amplitude, hz, seed):
    t = np.arange(800) / 40
    direction = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0][0]
    shake = amplitude * np.sin(2 * np.pi * hz * t)[:, None] * direction
    slow = 9.81 * np.column_stack([np.sin(t), np.zeros_like(t), np.cos(t)])  # 57 deg/s
    levels = inertial_levels(samples_of(t, np.tile([0.3, 0.0, 0.4], (800, 1)), slow + shake), t)
    assert np.sqrt(np.mean(levels.vibration_m_s2[4:-4] ** 2)) == pytest.approx(amplitude / np.sqrt(2), rel=0.15)
    np.testing.assert_allclose(levels.rate_rad_s, 0.5)
    still = inertial_levels(samples_of(t, np.zeros((800, 3)), slow), t)
    assert still.vibration_m_s2.max() < 0.1 and np.allclose(still.force_m_s2, 9.81)


@given(n=st.integers(2, 5000), hz=st.floats(0.5, 200), gap_s=st.floats(0, 50))
def test_spans_are_few_cover_the_stream_and_are_empty_in_its_holes(n, hz, gap_s):
    t = np.arange(n) / hz
    t[n // 2:] += gap_s
    levels = inertial_levels(samples_of(t, np.ones((n, 3)), np.ones((n, 3))), t)
    span = levels.t_s[1] - levels.t_s[0] if len(levels.t_s) > 1 else 0.25
    assert len(levels.t_s) <= MOST_SPANS
    assert levels.t_s[0] - 0.51 * span <= t[0] and t[-1] <= levels.t_s[-1] + 0.51 * span
    filled = np.isfinite(levels.rate_rad_s)
    assert filled[0] and filled[-1] and np.allclose(levels.rate_rad_s[filled], np.sqrt(3))
    inside = (levels.t_s - 0.5 * span > t[n // 2 - 1]) & (levels.t_s + 0.5 * span < t[n // 2])
    assert not filled[inside].any()


def test_no_stream_has_no_levels_and_unequal_series_are_refused():
    assert inertial_levels(ImuSamples.none(), np.zeros(0)) is None
    with pytest.raises(ImuError, match="four series of one length"):
        InertialLevels(np.zeros(3), np.zeros(3), np.zeros(2), np.zeros(3))
