"""Allan deviations against noise whose densities are known, against the formula, and on a real resting IMU."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vio.allan import allan_deviation, allan_noise, calibrate_noise
from vio.errors import ImuError
from vio.imu import ImuNoise, ImuSamples

RATE_HZ = 50.0


def white(rng: np.random.Generator, n: int, density: float) -> np.ndarray:
    return rng.normal(size=n) * density * np.sqrt(RATE_HZ)


def walk(rng: np.random.Generator, n: int, density: float) -> np.ndarray:
    return np.cumsum(rng.normal(size=n)) * density / np.sqrt(RATE_HZ)


@settings(max_examples=15)
@given(density=st.floats(1e-5, 1e-1), seed=st.integers(0, 2**16), offset=st.floats(-10, 10))
def test_the_density_of_white_noise_is_found_whatever_the_bias(density, seed, offset):
    signal = white(np.random.default_rng(seed), 40_000, density) + offset
    found = allan_noise(signal, RATE_HZ)
    assert found.density == pytest.approx(density, rel=0.06)
    assert found.instability < 0.4 * density and found.walk < 0.1 * density


@pytest.mark.parametrize(("density", "step"), [(1e-3, 1e-3), (1e-2, 2e-3)])
def test_white_noise_and_walk_are_told_apart(density, step):
    rng = np.random.default_rng(3)
    found = allan_noise(white(rng, 200_000, density) + walk(rng, 200_000, step), RATE_HZ)
    assert found.density == pytest.approx(density, rel=0.1) and found.walk == pytest.approx(step, rel=0.35)


def test_the_deviation_is_the_formula_written_out():
    signal = np.random.default_rng(1).normal(size=1200)
    tau, deviation = allan_deviation(signal, RATE_HZ)
    for t, expected in zip(tau[[0, 5, -1]], deviation[[0, 5, -1]], strict=True):
        m = round(t * RATE_HZ)
        means = np.convolve(signal, np.ones(m) / m, "valid")
        assert np.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2)) == pytest.approx(expected)
    assert tau[0] == 1 / RATE_HZ and tau[-1] <= 1200 / RATE_HZ / 9 + 1e-9


@given(factor=st.floats(1e-3, 1e3))
def test_units_scale_through(factor):
    signal = np.random.default_rng(2).normal(size=2000)
    one, other = allan_noise(signal, RATE_HZ), allan_noise(factor * signal, RATE_HZ)
    np.testing.assert_allclose(other.deviation, factor * one.deviation, rtol=1e-9)
    assert other.density == pytest.approx(factor * one.density, rel=1e-6)


def resting(n: int = 60_000) -> ImuSamples:
    rng = np.random.default_rng(4)
    gyro = np.column_stack([white(rng, n, d) for d in (1e-4, 3e-4, 2e-4)]) + 0.01
    accel = np.column_stack([white(rng, n, d) for d in (1e-3, 2e-3, 5e-3)]) + np.array([0, 0, 9.81])
    return ImuSamples((np.arange(n) * 20_000_000).astype(np.int64), gyro, accel)


def test_the_noisiest_axis_counts_and_ranges_stay():
    noise, axes = calibrate_noise(resting(), ImuNoise(gyro_range_rad_s=8.7))
    assert noise.gyro_density_rad_s_rthz == pytest.approx(3e-4, rel=0.06) and len(axes) == 6
    assert noise.accel_density_m_s2_rthz == pytest.approx(5e-3, rel=0.06)
    assert noise.rate_hz == pytest.approx(RATE_HZ) and noise.gyro_range_rad_s == 8.7


def test_what_cannot_be_judged_is_refused_in_one_line():
    samples = resting(2000)
    late = samples.t_ns.copy()
    late[1200:] += 10**9
    nan = samples.gyro_rad_s.copy()
    nan[77, 1] = np.nan
    for spoiled, words in (
        (ImuSamples(late, samples.gyro_rad_s, samples.accel_m_s2), "between samples 1199 and 1200"),
        (ImuSamples(samples.t_ns, nan, samples.accel_m_s2), "sample 77 is not finite"),
        (ImuSamples(samples.t_ns[:900], samples.gyro_rad_s[:900], samples.accel_m_s2[:900]), "900 samples, needed are"),
    ):
        with pytest.raises(ImuError, match=words):
            calibrate_noise(spoiled)
    with pytest.raises(ImuError, match="positive number"):
        allan_deviation(np.zeros(2000), 0.0)


def test_a_real_resting_imu_has_the_published_deviation(shared_data):
    """ADIS16405, 2.8 hours: figures that came with the data, and the data sheet's 2.0 °/√h within a factor of 1.5."""
    path = shared_data / "imu_static_adis16405" / "adis_16405_imu1.npz"
    if not path.is_file():
        pytest.skip("needs imu_static_adis16405")
    with np.load(path) as data:
        gyro_x = np.deg2rad(data["counts"][:, 0] * 0.05)
    found = allan_noise(gyro_x, 100.0)
    at = np.exp(np.interp(np.log([0.01, 1.0, 10.0, 100.0]), np.log(found.tau_s), np.log(found.deviation)))
    np.testing.assert_allclose(at, [0.0056, 7.1e-4, 2.3e-4, 1.26e-4], rtol=0.05)
    assert found.density == pytest.approx(7.2e-4, rel=0.05)
    assert found.density == pytest.approx(np.deg2rad(2.0) / 60, rel=0.5)
