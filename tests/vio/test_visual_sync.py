"""Camera against gyro: turns by rays, and clocks and axes that are off are found on turning recordings."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vio import se3
from vio.calibration import Calibration
from vio.camera import Camera
from vio.imu import ImuSamples
from vio.inspection import inspect_recording
from vio.recording import Recording
from vio.sensor_verdicts import sync_check
from vio.visual_sync import axis_rotations, sync_quality, turn_between


@given(seed=st.integers(0, 2**32 - 1), angle=st.floats(0, 0.6), wrong=st.integers(0, 12))
def test_the_turn_between_rays_is_found_among_wrong_ones(seed, angle, wrong):
    rng = np.random.default_rng(seed)
    after = rng.normal(size=(60, 3)) * [0.4, 0.4, 0.1] + [0, 0, 1]
    after /= np.linalg.norm(after, axis=1, keepdims=True)
    axis = rng.normal(size=3)
    turn = angle * axis / np.linalg.norm(axis)
    before = after @ se3.so3_exp(turn).T
    before[:wrong] = rng.normal(size=(wrong, 3))
    before /= np.linalg.norm(before, axis=1, keepdims=True)
    np.testing.assert_allclose(turn_between(before, after), turn, atol=2e-3)


def test_the_axis_rotations_are_the_24_of_a_cube():
    found = axis_rotations()
    assert len(found) == 24 and np.array_equal(found["x y z"], np.eye(3))
    np.testing.assert_array_equal(found["y -x z"] @ [1, 2, 3], [2, -1, 3])
    for axes in found.values():
        assert np.linalg.det(axes) == pytest.approx(1) and np.allclose(axes @ axes.T, np.eye(3))


SIZE, FRAME_HZ, IMU_HZ, SECONDS = 96, 10.0, 100.0, 12.0
T_BODY_CAMERA = se3.transform(se3.so3_exp([0.4, -0.9, 0.3]), [0.0, 0.0, 0.005])


def rate_of(t: np.ndarray) -> np.ndarray:
    """(N, 3) angular rate of the body."""
    return 0.6 * np.column_stack([np.sin(2.1 * t), np.sin(3.3 * t + 1), np.cos(1.4 * t)])


@pytest.fixture(scope="module")
def turning(tmp_path_factory) -> Recording:
    """A camera that only turns, inside a painted sphere: what it and its gyro see is exact."""
    folder = tmp_path_factory.mktemp("sync")
    fine = np.arange(0, SECONDS + 0.5, 1e-3)
    steps = se3.transform(se3.so3_exp(rate_of(fine[:-1] + 5e-4) * 1e-3), np.zeros(3))
    R_world_body = se3.chain(steps)[:, :3, :3]
    coarse = np.random.default_rng(0).integers(0, 200, (60, 120), dtype=np.uint8)
    sphere = cv2.resize(coarse, (960, 480), interpolation=cv2.INTER_CUBIC)
    camera = Camera("pinhole", SIZE, SIZE, 60.0, 60.0, (SIZE - 1) / 2, (SIZE - 1) / 2)
    v, u = np.mgrid[:SIZE, :SIZE]
    rays = camera.unproject(np.stack([u, v], -1).reshape(-1, 2).astype(float))
    t, paths = np.arange(0, SECONDS, 1 / FRAME_HZ), []
    for k, at in enumerate(t):
        ray = rays @ (R_world_body[round(at * 1000)] @ T_BODY_CAMERA[:3, :3]).T
        column = (np.arctan2(ray[:, 1], ray[:, 0]) / (2 * np.pi) + 0.5) * 959
        row = np.arccos(np.clip(ray[:, 2], -1, 1)) / np.pi * 479
        image = cv2.remap(sphere, column.reshape(SIZE, SIZE).astype(np.float32),
                          row.reshape(SIZE, SIZE).astype(np.float32), cv2.INTER_LINEAR)
        paths.append(folder / f"{k}.png")
        cv2.imwrite(str(paths[-1]), 30 + image)
    imu_t = np.arange(0, SECONDS + 0.4, 1 / IMU_HZ)
    force = np.swapaxes(R_world_body[np.round(imu_t * 1000).astype(int)], 1, 2) @ [0, 0, 9.81]
    imu = ImuSamples(np.round(imu_t * 1e9).astype(np.int64), rate_of(imu_t) + np.array([0.02, -0.01, 0.03]), force)
    return Recording("turning", np.round(t * 1e9).astype(np.int64), imu, Calibration(camera, T_BODY_CAMERA), None,
                     tuple(paths))


def late(recording: Recording, seconds: float) -> Recording:
    return replace(recording, imu=replace(recording.imu, t_ns=recording.imu.t_ns + int(1e9 * seconds)))


def test_what_is_in_step_is_found_so(turning):
    sync = sync_quality(turning)
    assert sync.best_correlation > 0.95 and abs(sync.best_offset_s) < 0.01 and sync.swapped is None
    np.testing.assert_allclose(sync.visual_rad, sync.gyro_rad, atol=0.02)
    assert sync_check(sync, 0.0).level == "ok"


@pytest.mark.parametrize("offset_s", [0.12, -0.08])
def test_a_late_clock_is_found_and_said(turning, offset_s):
    sync = sync_quality(late(turning, offset_s))
    assert sync.best_offset_s == pytest.approx(offset_s, abs=0.01) and sync.offset_is_seen
    check = sync_check(sync, 0.005)
    assert check.level == "warning" and f"time_offset_s: {0.005 + sync.best_offset_s:.3f} in" in check.remedy
    declared = replace(turning.calibration, time_offset_s=offset_s)
    again = sync_quality(replace(late(turning, offset_s), calibration=declared))
    assert abs(again.best_offset_s) < 0.01 and sync_check(again, offset_s).level == "ok"


def test_swapped_axes_are_named(turning):
    turned = np.eye(4)
    turned[:3, :3] = axis_rotations()["y -x z"]
    calibration = replace(turning.calibration, T_body_camera=turned @ turning.calibration.T_body_camera)
    sync = sync_quality(replace(turning, calibration=calibration))
    assert sync.swapped is not None
    np.testing.assert_array_equal(axis_rotations()[sync.swapped] @ turned[:3, :3], np.eye(3))  # it undoes the mistake
    assert "T_BS" in sync_check(sync, 0.0).remedy


def test_what_cannot_be_compared_is_not_judged(turning):
    assert sync_quality(replace(turning, calibration=replace(turning.calibration, camera=None))) is None
    checks = inspect_recording(replace(turning, frame_paths=()), pixels=True).checks
    assert next(c for c in checks if c.name == "sync").text.startswith("not judged")
    black = replace(turning, frame_paths=(turning.frame_paths[0],) * len(turning))
    assert sync_quality(black) is not None  # a still picture has texture: it is compared, and does not agree
    assert sync_check(sync_quality(black), 0.0).level == "warning"
