"""The gyro's bias from gravity and from seen rotations: found, and as surely as claimed, whatever lies."""

from dataclasses import replace

import numpy as np
import pytest

from vio import se3
from vio.gyro_bias import GYRO_BIAS_SD_RAD_S, SeenRotations, estimate_gyro_bias, gyro_noise_var
from vio.imu import ImuNoise, ImuSamples, preintegrate_rotation, split_at_frames
from vio.simulation.scenario import simulate_recording

NOISE = ImuNoise()
BIAS = np.array([0.009, -0.006, 0.004])


@pytest.fixture(scope="module")
def recordings():
    shaken = (("gaussian", 4), ("collision", 3), ("peristalsis", 5), ("none", 0))
    return [simulate_recording(organ, *shaken[k % 4], 20.0, 8100 + k, driving="operated")
            for k, organ in enumerate(("colon", "small-bowel", "stomach") * 3)]


def pieces_of(recording, samples=None):
    return split_at_frames(samples or recording.imu, recording.imu_t_s, recording.frame_t_s)


def estimate(recording, samples=None, seen=None, usable=None):
    dt = np.diff(recording.frame_t_s)
    return estimate_gyro_bias(pieces_of(recording, samples), dt, np.ones(len(dt), bool) if usable is None else usable,
                              NOISE, seen)


def true_bias(recording):
    return recording.truth_state.gyro_bias_rad_s.mean(axis=0)


def nees(found, truth):
    return (found.bias_rad_s - truth) @ np.linalg.solve(found.cov, found.bias_rad_s - truth) / 3


def test_gravity_tells_the_bias_as_surely_as_claimed(recordings):
    found = [estimate(recording) for recording in recordings]
    off = np.array([f.bias_rad_s - true_bias(r) for f, r in zip(found, recordings, strict=True)])
    assert np.degrees(np.median(np.linalg.norm(off, axis=1))) < 0.03  # of 0.87 by the prior
    assert np.degrees(np.linalg.norm(off, axis=1).max()) < 0.3
    assert 0.2 < np.mean([nees(f, true_bias(r)) for f, r in zip(found, recordings, strict=True)]) < 2.5


def seen_by(recording, rng, correlation, spread=1.0):
    """True rotations with errors of 0.5 deg, correlated from pair to pair, that claim `spread` times less."""
    R = recording.truth_at_frames().rotations
    relative = np.swapaxes(R[:-1], 1, 2) @ R[1:]
    error = rng.normal(size=(len(relative), 3))
    for k in range(1, len(error)):
        error[k] = correlation * error[k - 1] + np.sqrt(1 - correlation**2) * error[k]
    sd = np.deg2rad(0.5)
    cov = np.broadcast_to((sd / spread) ** 2 * np.eye(3), relative.shape)
    return SeenRotations(np.arange(len(relative)), relative @ se3.so3_exp(sd * error), cov)


@pytest.mark.parametrize(("correlation", "spread"), [(0.0, 1.0), (0.7, 1.0), (0.0, 4.0)])
def test_rotations_alone_are_believed_as_far_as_they_scatter(recordings, correlation, spread):
    # An accelerometer that says nothing; errors that repeat, or that are larger than claimed, widen the answer.
    rng = np.random.default_rng(3)
    rows = []
    for recording in recordings:
        dead = replace(recording.imu, accel_m_s2=np.zeros_like(recording.imu.accel_m_s2))
        for _ in range(2):
            found = estimate(recording, dead, seen_by(recording, rng, correlation, spread))
            rows.append((nees(found, true_bias(recording)), np.linalg.norm(found.bias_rad_s - true_bias(recording))))
    far, off = np.mean(rows, axis=0)
    assert 0.5 < far < 1.8
    assert np.degrees(off) < (0.6 if correlation else 0.4)


def test_nothing_to_go_by_gives_the_prior_back(recordings):
    recording = recordings[0]
    dead = replace(recording.imu, accel_m_s2=np.zeros_like(recording.imu.accel_m_s2))
    for found in (estimate(recording, dead), estimate(recording, usable=np.zeros(len(recording) - 1, bool))):
        np.testing.assert_allclose(found.bias_rad_s, 0, atol=1e-12)
        np.testing.assert_allclose(found.cov, GYRO_BIAS_SD_RAD_S**2 * np.eye(3), rtol=1e-3, atol=1e-12)


def test_wild_samples_and_wild_rotations_move_it_little(recordings):
    recording, rng = recordings[3], np.random.default_rng(5)
    clean = estimate(recording, seen=seen_by(recording, rng, 0.0))
    accel = recording.imu.accel_m_s2.copy()
    wild = rng.choice(len(accel), len(accel) // 50, replace=False)
    accel[wild] += rng.normal(0, 30, (len(wild), 3))
    seen = seen_by(recording, rng, 0.0)
    seen.R[::10] = se3.so3_exp(rng.normal(0, 1, (len(seen.R[::10]), 3)))
    found = estimate(recording, replace(recording.imu, accel_m_s2=accel), seen)
    assert np.linalg.norm(found.bias_rad_s - true_bias(recording)) < max(
        5 * np.linalg.norm(clean.bias_rad_s - true_bias(recording)), np.deg2rad(0.15))
    assert found.force_sd_m_s2 > clean.force_sd_m_s2


def test_holes_are_left_out(recordings):
    recording = recordings[0]
    samples = recording.imu
    gyro, accel = samples.gyro_rad_s.copy(), samples.accel_m_s2.copy()
    inside = (recording.imu_t_s > recording.frame_t_s[20]) & (recording.imu_t_s < recording.frame_t_s[24])
    gyro[inside], accel[inside] = 0.3, 40.0
    usable = np.ones(len(recording) - 1, bool)
    usable[19:25] = False
    spoilt = estimate(recording, ImuSamples(samples.t_ns, gyro, accel), usable=usable)
    honest = estimate(recording, usable=usable)
    np.testing.assert_allclose(spoilt.bias_rad_s, honest.bias_rad_s, atol=np.deg2rad(0.01))


def test_a_long_recording_never_claims_to_know_a_walking_bias():
    recording = simulate_recording("small-bowel", "gaussian", 3, 400.0, 8200)
    found = estimate(recording)
    walk = NOISE.gyro_walk_rad_s2_rthz * np.sqrt(recording.duration_s / 6)
    assert (found.sd_rad_s >= walk).all() and (found.sd_rad_s < 4 * walk + np.deg2rad(0.005)).all()
    assert np.degrees(np.linalg.norm(found.bias_rad_s - true_bias(recording))) < 0.03


def test_the_gyros_own_noise_is_as_large_as_its_errors(recordings):
    rows = []
    for recording in recordings:
        R = recording.truth_at_frames().rotations
        gyro = preintegrate_rotation(pieces_of(recording), true_bias(recording))
        error = se3.so3_log(np.swapaxes(gyro, 1, 2) @ np.swapaxes(R[:-1], 1, 2) @ R[1:])
        rows.append((error**2).mean(axis=1)
                    / gyro_noise_var(recording.imu, recording.imu_t_s, recording.frame_t_s, NOISE))
    assert 0.5 < np.mean(rows) < 1.5
