"""Preintegrated intervals against exact truth, and their covariance against the textbook."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from fusion.preintegration import make_bias, preintegrate
from fusion.problem import build_problem
from fusion.vibration import vibration_inflation
from vio import se3
from vio.imu import ImuNoise, ImuPieces, split_at_frames
from vio.simulation import SIMULATED_IMU, simulate_recording

NO_BIAS = (np.zeros(3), np.zeros(3))


def errors_of(recording, bias=NO_BIAS, linearised_at=NO_BIAS):
    """Rms over all intervals of the predicted position [mm], rotation [deg] and velocity [mm/s]."""
    pieces = split_at_frames(recording.imu, recording.imu_t_s, recording.frame_t_s, bias[1])
    m = len(recording) - 1
    measurements = preintegrate(pieces, recording.calibration.imu_noise, *linearised_at, np.ones(m), np.ones(m), (0, m))
    T, v = recording.truth.T_world_body, recording.truth_state.velocity_m_s
    rows = []
    for k, measurement in enumerate(measurements):
        state = measurement.predict(gtsam.NavState(gtsam.Pose3(T[k]), v[k]), make_bias(*bias))
        turn = T[k + 1, :3, :3].T @ state.attitude().matrix()
        rows.append([1e3 * np.linalg.norm(state.position() - T[k + 1, :3, 3]),
                     np.rad2deg(np.linalg.norm(se3.so3_log(turn))), 1e3 * np.linalg.norm(state.velocity() - v[k + 1])])
    return np.sqrt(np.mean(np.square(rows), axis=0))


# Measured: 0.007 to 0.017 mm without vibration (tumbles cost most), 0.012 to 0.019 mm at gaussian level 5,
# 0.033 mm at peristalsis level 5. Collisions hide motion inside a sample: 2 mm, what `vibration.py` is for.
@pytest.mark.parametrize(("organ", "vibration", "level", "seed", "limit_mm"), [
    ("colon", "none", 0, 11, 0.012), ("small-bowel", "none", 0, 11, 0.012), ("stomach", "none", 0, 12, 0.02),
    ("colon", "gaussian", 5, 11, 0.02), ("small-bowel", "peristalsis", 5, 11, 0.04)])
def test_ideal_imu_predicts_the_next_frame(noiseless, organ, vibration, level, seed, limit_mm):
    position_mm, rotation_deg, velocity_mm_s = errors_of(
        simulate_recording(organ, vibration, level, 40.0, seed, **noiseless))
    assert position_mm < limit_mm
    assert rotation_deg < 0.001
    assert velocity_mm_s < 8 * limit_mm


@pytest.mark.parametrize("share", [0.0, 0.8, 1.0])
def test_known_biases_are_removed_wherever_the_measurement_was_linearised(noiseless, share):
    recording = simulate_recording("colon", "none", 0, 40.0, 16, **noiseless)
    accel_bias, gyro_bias = np.array([0.2, -0.1, 0.3]), np.array([0.005, -0.01, 0.0025])
    imu = replace(recording.imu, accel_m_s2=recording.imu.accel_m_s2 + accel_bias,
                  gyro_rad_s=recording.imu.gyro_rad_s + gyro_bias)
    biased = replace(recording, imu=imu)
    position_mm, rotation_deg, _ = errors_of(biased, (accel_bias, gyro_bias), (share * accel_bias, share * gyro_bias))
    # Not zero: forces are turned into the axes at their piece's start, the accelerometer's bias with them.
    assert position_mm < 0.06  # measured 0.051; three times that where the gyro's bias takes part in that turn
    assert rotation_deg < 0.001
    assert errors_of(biased)[0] > 10  # what ignoring the biases costs


def resting_pieces(seconds, rate_hz=40):
    """One interval of a motionless, level IMU."""
    n = round(seconds * rate_hz)
    return ImuPieces(np.zeros((n, 3)), np.tile([0.0, 0.0, 9.81], (n, 1)), np.full(n, seconds / n), np.array([0, n]),
                     np.array([1 / rate_hz]))


def covariance_of(noise, seconds=2.0, accel_inflation=1.0, gyro_inflation=1.0):
    measurement, = preintegrate(resting_pieces(seconds), noise, *NO_BIAS, np.array([accel_inflation]),
                                np.array([gyro_inflation]), (0, 1))
    return measurement.preintMeasCov()


def test_covariance_is_the_integral_of_the_continuous_densities():
    noise, seconds = ImuNoise(2e-3, 5e-3, 1e-5, 3e-4), 2.0
    sd = np.sqrt(np.diagonal(covariance_of(noise, seconds)))
    gyro, accel = noise.gyro_density_rad_s_rthz, noise.accel_density_m_s2_rthz
    np.testing.assert_allclose(sd[:3], gyro * np.sqrt(seconds), rtol=0.01)
    # Vertical: white noise integrated once and twice; horizontal besides: tilt noise that gravity turns into force.
    assert sd[8] == pytest.approx(accel * np.sqrt(seconds), rel=0.01)
    assert sd[5] == pytest.approx(accel * np.sqrt(seconds**3 / 3), rel=0.02)
    leak = 9.81 * gyro * np.sqrt(seconds**3 / 3)
    np.testing.assert_allclose(sd[6:8], np.hypot(sd[8], leak), rtol=0.05)
    walks = noise.accel_walk_m_s3_rthz, noise.gyro_walk_rad_s2_rthz
    np.testing.assert_allclose(sd[9:], np.repeat(walks, 3) * np.sqrt(seconds), rtol=0.01)


@pytest.mark.parametrize(("accel", "gyro"), [(4.0, 1.0), (1.0, 4.0), (16.0, 2.0)])
def test_inflation_widens_what_it_says(accel, gyro):
    noise = ImuNoise()
    plain, wide = (np.diagonal(covariance_of(noise, 0.33, *factors)) for factors in ((1.0, 1.0), (accel, gyro)))
    np.testing.assert_allclose(wide[:3] / plain[:3], gyro**2, rtol=1e-4)  # rotation
    assert wide[8] / plain[8] == pytest.approx(accel**2, rel=1e-3)  # vertical velocity
    np.testing.assert_allclose(wide[9:], plain[9:], rtol=1e-6)  # bias walks
    below = np.diagonal(covariance_of(noise, 0.33, 0.5, 0.0))
    np.testing.assert_array_equal(below, plain)  # an inflation is never a reward


def motion_of(measurement):
    return np.r_[measurement.deltaRij().matrix().ravel(), measurement.deltaPij(), measurement.deltaVij()]


def test_inflation_of_one_interval_leaves_the_others():
    recording = simulate_recording("colon", "none", 0, 4.0, 11)
    pieces = split_at_frames(recording.imu, recording.imu_t_s, recording.frame_t_s)
    one, some = np.ones(11), np.ones(11)
    some[6] = 3.0
    plain, inflated = (preintegrate(pieces, recording.calibration.imu_noise, *NO_BIAS, factor, one, (4, 9))
                       for factor in (one, some))
    changed = [not np.array_equal(a.preintMeasCov(), b.preintMeasCov()) for a, b in zip(plain, inflated, strict=True)]
    assert changed == [False, False, True, False, False]
    for a, b in zip(plain, inflated, strict=True):
        np.testing.assert_array_equal(motion_of(a), motion_of(b))
    whole = preintegrate(pieces, recording.calibration.imu_noise, *NO_BIAS, one, one, (0, 11))
    np.testing.assert_array_equal(motion_of(whole[5]), motion_of(plain[1]))


def inflation_of(recording):
    return vibration_inflation(recording.imu, recording.imu_t_s, recording.frame_t_s, SIMULATED_IMU)


def test_quiet_data_are_not_inflated():
    for mode in ("rest", "moving"):
        for inflation in inflation_of(simulate_recording("stomach", "none", 0, 60.0, 13, mode=mode)):
            assert len(inflation) == 179
            assert inflation.min() == 1.0
            assert inflation.mean() < 1.004 and np.quantile(inflation, 0.98) < 1.05


def test_inflation_grows_with_every_level_of_collisions():
    levels = [inflation_of(simulate_recording("colon", "collision", level, 60.0, 13)) for level in range(6)]
    for sensor in (0, 1):
        means = [inflation[sensor].mean() for inflation in levels]
        assert (np.diff(means) > 0.01).all(), means
    assert levels[5][0].mean() > 1.5


def test_collisions_are_inflated_where_the_prediction_fails(noiseless):
    """The worst intervals are among those with much inflation: it follows the error, not the calendar."""
    recording = simulate_recording("colon", "collision", 3, 60.0, 13, **noiseless)
    accel, _ = inflation_of(recording)
    pieces = split_at_frames(recording.imu, recording.imu_t_s, recording.frame_t_s)
    m = len(recording) - 1
    T, v = recording.truth.T_world_body, recording.truth_state.velocity_m_s
    measured = preintegrate(pieces, recording.calibration.imu_noise, *NO_BIAS, np.ones(m), np.ones(m), (0, m))
    error = np.array([np.linalg.norm(p.predict(gtsam.NavState(gtsam.Pose3(T[k]), v[k]), make_bias(*NO_BIAS)).velocity()
                                     - v[k + 1]) for k, p in enumerate(measured)])
    worst = np.argsort(error)[-m // 20:]
    assert np.median(accel[worst]) > 1.4 * np.median(accel)  # measured 1.94: most contacts are soft
    assert np.corrcoef(np.log(error), np.log(accel))[0, 1] > 0.5  # measured 0.64


def test_missing_samples_inflate_their_interval_only(examination):
    imu_t = examination.recording.imu_t_s
    lost = np.abs(imu_t - 50.17) < 0.06  # 5 of the 13 samples of one interval: below the limit of a gap
    assert lost.sum() == 5
    whole = build_problem(examination.recording, examination.motions)
    holed = build_problem(examination.with_samples(np.flatnonzero(~lost)), examination.motions)
    assert holed.gaps == () and holed.imu_usable.all()
    ratio = holed.gyro_inflation / whole.gyro_inflation
    inflated = np.flatnonzero(ratio > 1.5)
    assert inflated.tolist() == [150]
    assert ratio[150] >= 5.9  # as many times the sample period as it takes to bridge the hole, or more
    assert (holed.accel_inflation[150] >= 5.9).all()
    np.testing.assert_allclose(np.delete(ratio, 150), 1.0)
