"""The simulator against finite differences, fine integration, an independent integrator, and statistics."""

import dataclasses
import hashlib
import itertools
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vio import se3
from vio.errors import SimulationError
from vio.formats.asl import read_asl, write_asl
from vio.imu import ImuNoise, split_at_frames
from vio.simulation import (
    KINDS,
    ORGANS,
    T_BODY_CAMERA,
    CapsuleMotion,
    ideal_imu,
    network_like_motions,
    simulate,
    simulate_recording,
)
from vio.simulation.anatomy import make_anatomy
from vio.simulation.contact import find_contacts
from vio.simulation.halts import Clock
from vio.simulation.imu_synthesis import ImuBiases, corrupt
from vio.simulation.path import moving_path
from vio.simulation.scenario import START_T_NS
from vio.simulation.vibration import make_vibration

SHAKING = [kind for kind in KINDS if kind != "none"]
NOISELESS = {"noise": ImuNoise(1e-12, 1e-12, 1e-12, 1e-12), "accel_bias_sd_m_s2": 0.0, "gyro_bias_sd_rad_s": 0.0}


def rms(vectors):
    return float(np.sqrt(np.mean(np.sum(np.square(vectors), axis=-1))))


def motion_of(organ, kind, level, duration_s, seed):
    anatomy = make_anatomy(organ, seed)
    path = moving_path(anatomy, "natural", duration_s, np.random.default_rng([seed, 1]))
    contacts = find_contacts(anatomy, path, duration_s) if kind == "collision" else None
    return CapsuleMotion(path, make_vibration(kind, level, duration_s, seed, contacts))


def digest(kind="collision", seed=7):
    recording = simulate_recording("small-bowel", kind, 3, 20.0, seed)
    network = network_like_motions(recording.truth, T_BODY_CAMERA, seed)
    parts = (recording.frame_t_ns, recording.imu.t_ns, recording.imu.gyro_rad_s, recording.imu.accel_m_s2,
             recording.truth.T_world_body, recording.truth_state.velocity_m_s,
             network.motions.T_i_j, network.motions.cov)
    return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()


# ---- reproducible ----------------------------------------------------------------------------

def test_same_seed_gives_the_same_bytes_in_another_process():
    code = "import test_simulation as t; print(t.digest())"
    environment = os.environ | {"PYTHONHASHSEED": "5", "PYTHONPATH": os.pathsep.join(sys.path)}
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                           cwd=Path(__file__).parent, env=environment)
    assert other.stdout.strip() == digest()
    assert digest(seed=8) != digest()


def test_levels_and_kinds_shake_the_same_route():
    t = np.linspace(-1, 21, 50)
    routes = [simulate("colon", kind, level, 20.0, 4).motion.nominal.position_m(t)
              for kind, level in (("none", 0), ("gaussian", 2), ("collision", 5))]
    np.testing.assert_array_equal(routes[0], routes[1])
    np.testing.assert_array_equal(routes[0], routes[2])


def test_written_and_read_recording_is_the_same(tmp_path):
    recording = simulate_recording("stomach", "peristalsis", 2, 5.0, 11)
    write_asl(recording, tmp_path / "rec")
    again = read_asl(tmp_path / "rec")
    np.testing.assert_array_equal(again.frame_t_ns, recording.frame_t_ns)
    np.testing.assert_array_equal(again.imu.t_ns, recording.imu.t_ns)
    np.testing.assert_allclose(again.imu.accel_m_s2, recording.imu.accel_m_s2, atol=1e-9)
    np.testing.assert_allclose(again.truth.T_world_body, recording.truth.T_world_body, atol=1e-9)
    np.testing.assert_allclose(again.calibration.T_body_camera, T_BODY_CAMERA, atol=1e-12)
    assert again.calibration.imu_noise == recording.calibration.imu_noise
    assert again.provenance == recording.provenance


# ---- vibration -------------------------------------------------------------------------------

@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32), duration_s=st.floats(0.7, 30.0), kind=st.sampled_from(SHAKING))
def test_every_level_shakes_harder_than_the_one_below(seed, duration_s, kind):
    t = np.arange(0, duration_s, 1 / 400)
    signals = [make_vibration(kind, level, duration_s, seed)(t) for level in range(6)]
    acceleration = [rms(second[:, 3:]) for _, _, second in signals]
    assert acceleration[0] == 0
    assert (np.diff(acceleration) > 0).all()
    if kind != "gaussian":
        assert (np.diff([rms(first[:, :3]) for _, first, _ in signals]) > 0).all()


@pytest.mark.parametrize("kind", SHAKING)
def test_total_acceleration_grows_with_the_level_for_every_seed(kind):
    t = np.arange(0, 60, 1 / 50)
    for seed in range(10):
        base = motion_of("small-bowel", "none", 0, 60.0, seed)
        levels = [dataclasses.replace(base, vibration=make_vibration(kind, level, 60.0, seed)) for level in range(6)]
        total = [rms(motion.evaluate(t).acceleration_m_s2) for motion in levels]
        assert (np.diff(total) > 0).all(), (seed, total)


def test_collisions_of_a_level_are_among_those_of_the_next():
    for seed in range(20):
        onsets = [set(make_vibration("collision", level, 60.0, seed).kinks_s) for level in range(1, 6)]
        assert all(low <= high for low, high in itertools.pairwise(onsets))
        assert len(onsets[0]) < len(onsets[4])


def test_gaussian_vibration_has_the_documented_size_and_stays_below_the_imu_nyquist():
    t = np.arange(0, 600, 0.01)
    for level in (1, 5):
        value, rate, acceleration = make_vibration("gaussian", level, 600.0, 1)(t)
        assert rms(value) / level == pytest.approx(0.12e-3, rel=0.05)
        assert rms(rate) / level == pytest.approx(1.6e-3, rel=0.05)
        assert rms(acceleration) / level == pytest.approx(31e-3, rel=0.05)
        assert not value[:, :3].any()
    power = np.abs(np.fft.rfft(acceleration[:, 3])) ** 2
    assert power[np.fft.rfftfreq(len(t), 0.01) > 5].sum() < 0.01 * power.sum()
    knots = np.arange(0, 600, 1 / 8)
    assert np.abs(make_vibration("gaussian", 5, 600.0, 1)(knots)[0]).max() <= 0.5e-3 + 1e-12  # [-1, 1] × 5 × 0.1 mm


# ---- halts -----------------------------------------------------------------------------------

def test_a_capsule_that_halts_lies_still_and_then_goes_on_the_way_it_would_have_gone():
    halts = [(5.0, 9.0), (12.0, 20.0)]
    going = simulate("small-bowel", "collision", 3, 40.0, 4)
    halting = simulate("small-bowel", "collision", 3, 40.0, 4, halts=halts)
    for begin, end in halts:
        there = halting.motion.evaluate(np.linspace(begin, end, 50))
        assert np.ptp(there.T_world_body, axis=0).max() < 1e-12 and not there.gyro_rad_s.any()
        assert not there.velocity_m_s.any()
        t = halting.recording.imu_t_s
        samples = halting.recording.imu.gyro_rad_s[(t > begin + 0.02) & (t < end - 0.02)]
        assert samples.std(axis=0).max() < 1.2e-3  # the sensor's own noise is 0.8e-3
    own = Clock(halts)(np.array([1.0, 10.3, 30.0]))[0]
    np.testing.assert_allclose(halting.motion.evaluate(np.array([1.0, 10.3, 30.0])).T_world_body,
                               going.motion.evaluate(own).T_world_body, atol=1e-9)
    assert own[2] == pytest.approx(30 - 4 - 8 - 2 * 0.5)  # half a second more for each halt's slowing down
    assert halting.recording.provenance["halts"] == [[5.0, 9.0], [12.0, 20.0]]


def test_velocity_and_rates_of_a_halting_capsule_are_derivatives():
    motion = simulate("colon", "peristalsis", 3, 20.0, 5, halts=[(6.0, 10.0)]).motion
    t, h = np.linspace(5.3, 10.7, 200), 1e-4
    before, now, after = (motion.evaluate(t + shift) for shift in (-h, 0.0, h))
    moved = (after.T_world_body[:, :3, 3] - before.T_world_body[:, :3, 3]) / (2 * h)
    np.testing.assert_allclose(moved, now.velocity_m_s, atol=1e-6)
    np.testing.assert_allclose((after.velocity_m_s - before.velocity_m_s) / (2 * h), now.acceleration_m_s2, atol=1e-4)
    R = before.T_world_body[:, :3, :3]
    turned = se3.so3_log(np.swapaxes(R, 1, 2) @ after.T_world_body[:, :3, :3]) / (2 * h)
    np.testing.assert_allclose(turned, now.gyro_rad_s, atol=1e-5)


@pytest.mark.parametrize("halts", [[(5.0, 4.0)], [(5.0, 9.0), (9.5, 12.0)], [(12.0, 20.0), (5.0, 9.0)]])
def test_halts_out_of_order_are_refused(halts):
    with pytest.raises(SimulationError, match="halts"):
        simulate("colon", "none", 0, 30.0, 5, halts=halts)


# ---- motion and IMU --------------------------------------------------------------------------

@pytest.mark.parametrize("organ", ORGANS)
@pytest.mark.parametrize(("kind", "level"), [("none", 0), ("gaussian", 5), ("peristalsis", 5), ("collision", 5)])
def test_rates_and_forces_are_the_derivatives_of_the_pose(organ, kind, level):
    motion, h = motion_of(organ, kind, level, 60.0, 5), 2e-5
    t = np.random.default_rng(0).uniform(0, 60, 1500)
    onsets = np.append(motion.vibration.kinks_s, np.inf)  # where the third derivative jumps, differences say nothing
    t = t[np.abs(t[:, None] - onsets).min(axis=1) > 2 * h]
    before, now, after = (motion.evaluate(t + shift) for shift in (-h, 0, h))
    velocity = (after.T_world_body[:, :3, 3] - before.T_world_body[:, :3, 3]) / (2 * h)
    np.testing.assert_allclose(now.velocity_m_s, velocity, atol=1e-6)
    turn = np.swapaxes(before.T_world_body[:, :3, :3], 1, 2) @ after.T_world_body[:, :3, :3]
    np.testing.assert_allclose(now.gyro_rad_s, se3.so3_log(turn) / (2 * h), atol=4e-5)
    lifted = (after.velocity_m_s - before.velocity_m_s) / (2 * h) + [0, 0, 9.81]
    force = np.einsum("nji,nj->ni", now.T_world_body[:, :3, :3], lifted)
    np.testing.assert_allclose(now.specific_force_m_s2, force, atol=1e-3)


def test_motion_is_twice_differentiable_at_its_knots():
    motion = motion_of("stomach", "none", 0, 60.0, 2)
    knots = np.arange(0, 60, 0.5)
    before, after = motion.evaluate(knots - 1e-7), motion.evaluate(knots + 1e-7)
    assert rms(after.acceleration_m_s2) > 1e-3
    np.testing.assert_allclose(before.acceleration_m_s2, after.acceleration_m_s2, atol=1e-7)
    np.testing.assert_allclose(motion.nominal.body_rate(knots - 1e-7, 2), motion.nominal.body_rate(knots + 1e-7, 2),
                               atol=1e-4)


def test_imu_sample_is_the_mean_over_its_cell():
    rate_hz, parts = 40.0, 4000
    motion = motion_of("colon", "collision", 5, 20.0, 3)
    onsets = motion.vibration.kinks_s[:6]  # where averaging is hardest
    centre = np.sort(np.concatenate([onsets + 0.004, [8.0, 15.0]]))
    gyro, force = ideal_imu(motion, centre, rate_hz)
    fine = ((np.arange(parts) + 0.5) / parts - 0.5) / rate_hz
    for k, t in enumerate(centre):
        state = motion.evaluate(t + fine)
        np.testing.assert_allclose(gyro[k], state.gyro_rad_s.mean(axis=0), atol=2e-6)
        np.testing.assert_allclose(force[k], state.specific_force_m_s2.mean(axis=0), atol=2e-5)


def integrate_intervals(simulation):
    """Rotation [deg], position [mm] and velocity [mm/s] error of every interval by plain zero-order hold."""
    recording = simulation.recording
    pieces = split_at_frames(recording.imu, recording.imu_t_s, recording.frame_t_s)
    T, v_true = recording.truth.T_world_body, recording.truth_state.velocity_m_s
    rows = []
    for k in range(len(T) - 1):
        R, p, v = T[k, :3, :3], T[k, :3, 3], v_true[k]
        for i in range(pieces.first[k], pieces.first[k + 1]):
            dt, acceleration = pieces.dt_s[i], R @ pieces.accel_m_s2[i] + [0, 0, -9.81]
            p, v = p + v * dt + 0.5 * acceleration * dt**2, v + acceleration * dt
            R = R @ se3.so3_exp(pieces.gyro_rad_s[i] * dt)
        rows.append([np.rad2deg(np.linalg.norm(se3.so3_log(T[k + 1, :3, :3].T @ R))),
                     1e3 * np.linalg.norm(p - T[k + 1, :3, 3]), 1e3 * np.linalg.norm(v - v_true[k + 1])])
    return np.array(rows)


@pytest.mark.parametrize("organ", ORGANS)
def test_ideal_imu_reproduces_every_frame_interval(organ):
    # The largest single errors belong to intervals within tumbles of up to 150 deg/s.
    error = integrate_intervals(simulate(organ, "none", 0, 60.0, 3, **NOISELESS))
    rotation_deg, position_mm, velocity_mm_s = np.sqrt(np.mean(error**2, axis=0))
    assert rotation_deg < 0.001
    assert position_mm < 0.02
    assert velocity_mm_s < 0.15
    assert error[:, 0].max() < 0.005
    assert error[:, 1].max() < 0.15


def test_imu_covers_all_frames_and_its_phase_is_not_tied_to_them():
    for seed in (0, 1):
        recording = simulate_recording("colon", "none", 0, 10.0, seed)
        assert recording.imu_t_s[0] < 0 < recording.frame_t_s[-1] < recording.imu_t_s[-1]
        assert set(np.diff(recording.imu.t_ns)) == {25_000_000}
        assert recording.imu_t_s[0] % 0.025 > 1e-6
    assert len(recording.frame_t_ns) == 30
    np.testing.assert_array_equal(recording.frame_t_ns[:4] - START_T_NS, [0, 333_333_333, 666_666_667, 1_000_000_000])


def test_noise_biases_and_walks_have_their_densities():
    noise = ImuNoise(gyro_walk_rad_s2_rthz=2e-4, accel_walk_m_s3_rthz=3e-3)
    quiet, loud = (simulate("colon", "none", 0, 600.0, 2, mode="rest", noise=noise, **extra)
                   for extra in ({}, {"accel_bias_sd_m_s2": 0.4, "gyro_bias_sd_rad_s": 0.1}))
    gravity = quiet.motion.evaluate([300.0]).specific_force_m_s2[0]
    assert np.linalg.norm(gravity) == pytest.approx(9.81)
    samples, biases = quiet.recording.imu, quiet.biases
    white_g, white_a = samples.gyro_rad_s - biases.gyro_rad_s, samples.accel_m_s2 - gravity - biases.accel_m_s2
    assert white_g.std() == pytest.approx(noise.gyro_density_rad_s_rthz * np.sqrt(40), rel=0.02)
    assert white_a.std() == pytest.approx(noise.accel_density_m_s2_rthz * np.sqrt(40), rel=0.02)
    assert np.diff(biases.gyro_rad_s, axis=0).std() == pytest.approx(2e-4 / np.sqrt(40), rel=0.02)
    assert np.diff(biases.accel_m_s2, axis=0).std() == pytest.approx(3e-3 / np.sqrt(40), rel=0.02)
    first = loud.biases.accel_m_s2[0] - quiet.biases.accel_m_s2[0]
    np.testing.assert_allclose(first, quiet.biases.accel_m_s2[0], atol=3e-3)  # twice the deviation, same draw
    assert quiet.recording.truth.path_length_m < 1e-12
    state = quiet.recording.truth_state
    np.testing.assert_allclose(state.accel_bias_m_s2[0], biases.accel_m_s2[np.searchsorted(samples.t_ns, START_T_NS)],
                               atol=3e-3)


def test_saturation_clips_at_the_full_scale():
    noise = ImuNoise(gyro_range_rad_s=0.5, accel_range_m_s2=2 * 9.81)
    ideal = np.array([[0.2, -0.7, 3.0]])
    still = ImuBiases(np.zeros((1, 3)), np.zeros((1, 3)))
    samples = corrupt(np.array([0]), ideal, 10 * ideal, still, noise, np.random.default_rng(0))
    assert samples.gyro_rad_s[0, 0] == pytest.approx(0.2, abs=0.01)
    np.testing.assert_array_equal(samples.gyro_rad_s[0, 1:], [-0.5, 0.5])
    np.testing.assert_array_equal(samples.accel_m_s2[0, 2], 2 * 9.81)
    hit = simulate_recording("colon", "collision", 5, 60.0, 0, noise=ImuNoise(accel_range_m_s2=9.9))
    assert np.abs(hit.imu.accel_m_s2).max() == 9.9


def test_memory_of_the_imu_synthesis_grows_only_with_its_result():
    motion = motion_of("colon", "collision", 3, 300.0, 0)

    def working_bytes(count):
        tracemalloc.start()
        result = ideal_imu(motion, 0.025 * np.arange(count), 40.0)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return peak - sum(part.nbytes for part in result)

    assert working_bytes(12_000) < 1.1 * working_bytes(4_000)


@pytest.mark.parametrize("organ", ORGANS)
def test_capsule_stays_in_the_abdomen_and_tumbles(organ):
    recording = simulate_recording(organ, "none", 0, 600.0, 9)
    assert recording.truth.path_length_m > 0.5
    assert np.abs(recording.truth.positions_m).max() < 0.25
    turns = np.linalg.norm(se3.log(se3.inverse(recording.truth.T_world_body[:-1]) @ recording.truth.T_world_body[1:])
                           [:, :3], axis=1)
    assert np.rad2deg(turns.max()) > 15


# ---- bad input -------------------------------------------------------------------------------

@pytest.mark.parametrize(("changes", "words"), [
    ({"organ": "heart"}, "unknown organ 'heart'; choose one of colon"),
    ({"vibration": "music"}, "unknown vibration 'music'"),
    ({"driving": "drunk"}, "unknown driving"),
    ({"mode": "still"}, "unknown mode"),
    ({"level": 6}, "level is 6; give a whole number from 0 to 5"),
    ({"level": -1}, "level is -1"),
    ({"level": 2.5}, "level is 2.5"),
    ({"seed": "one"}, "seed is 'one'; give a whole number"),
    ({"seed": 1.0}, "seed is 1.0"),
    ({"seed": -3}, "seed is -3"),
    ({"duration_s": 0.0}, "duration_s is 0.0; give a number above 0"),
    ({"duration_s": float("nan")}, "duration_s is nan"),
    ({"duration_s": 0.3}, "at least 2 frames"),
    ({"frame_rate_hz": -3.0}, "frame_rate_hz is -3.0"),
    ({"accel_bias_sd_m_s2": -1.0}, "accel_bias_sd_m_s2 is -1.0"),
    ({"noise": ImuNoise(rate_hz=2.0)}, "IMU rate is 2.0 Hz"),
])
def test_the_impossible_is_refused_in_one_line(changes, words):
    arguments = {"organ": "colon", "vibration": "none", "level": 0, "duration_s": 5.0, "seed": 0} | changes
    with pytest.raises(SimulationError, match=words) as caught:
        simulate_recording(**arguments)
    assert caught.value.exit_code == 3
    assert "\n" not in str(caught.value)
