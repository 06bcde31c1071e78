"""Spectra against signals whose density is known."""

import numpy as np
import pytest

from vio.imu import ImuNoise, ImuSamples
from vio.spectrum import imu_spectrum


def samples_of(t, gyro, accel):
    return ImuSamples((t * 1e9).astype(np.int64), gyro, accel)


@pytest.mark.parametrize(("accel", "gyro", "rate"), [(1e-2, 1e-3, 25.0), (2e-3, 1e-4, 40.0), (5e-2, 3e-3, 200.0)])
def test_white_noise_lies_at_its_calibrated_density(accel, gyro, rate):
    """A density d sampled at a rate f has variance d² f per axis, spread evenly from 0 to f / 2."""
    rng, t = np.random.default_rng(0), np.arange(int(200 * rate)) / rate
    noise = ImuNoise(gyro, accel)
    found = imu_spectrum(samples_of(t, rng.normal(size=(len(t), 3)) * gyro * np.sqrt(rate),
                                    rng.normal(size=(len(t), 3)) * accel * np.sqrt(rate) + 9.81), t, noise)
    assert np.median(found.accel) == pytest.approx(6 * accel**2, rel=0.15)
    assert np.median(found.gyro) == pytest.approx(6 * gyro**2, rel=0.15)
    assert found.accel_over_noise == pytest.approx(1, abs=0.1) and found.gyro_over_noise == pytest.approx(1, abs=0.1)
    assert np.trapezoid(found.accel, found.frequency_hz) == pytest.approx(3 * accel**2 * rate, rel=0.05)


def test_a_tone_stands_where_it_is_and_only_the_longest_stretch_counts():
    t = np.concatenate([np.arange(400) / 40, 60 + np.arange(4000) / 40])
    tone = np.sin(2 * np.pi * 7.0 * t)[:, None] * [1.0, 0, 0]
    tone[:400] = np.sin(2 * np.pi * 3.0 * t[:400])[:, None]
    found = imu_spectrum(samples_of(t, tone, tone), t, ImuNoise())
    assert found.frequency_hz[np.argmax(found.accel)] == pytest.approx(7.0, abs=0.05)


def test_too_little_is_not_judged():
    t = np.arange(63) / 40
    assert imu_spectrum(samples_of(t, np.zeros((63, 3)), np.zeros((63, 3))), t, ImuNoise()) is None
    t = np.arange(200) / 40 + np.repeat(np.arange(4), 50)
    assert imu_spectrum(samples_of(t, np.zeros((200, 3)), np.zeros((200, 3))), t, ImuNoise()) is None
