"""Kalibr files: there and back, chains of cameras, and every way they can be unusable."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.vio.samples import T_BODY_CAMERA
from vio import se3
from vio.calibration import Calibration
from vio.camera import Camera
from vio.errors import CalibrationError, OutputError
from vio.formats.kalibr import read_calibration, write_kalibr
from vio.imu import ImuNoise

SMALL = st.floats(-0.05, 0.05)
POSITIVE = st.floats(1e-7, 10)

CAM0 = {"camera_model": "pinhole", "intrinsics": [200.0, 201.0, 160.0, 120.0], "distortion_model": "equidistant",
        "distortion_coeffs": [0.01, 0.0, 0.0, 0.0], "resolution": [320, 240], "T_cam_imu": np.eye(4).tolist()}
IMU = {"accelerometer_noise_density": 2e-3, "accelerometer_random_walk": 3e-4, "gyroscope_noise_density": 1.5e-4,
       "gyroscope_random_walk": 2e-6, "update_rate": 40.0}


def save(path: Path, data: object) -> Path:
    path.write_text(yaml.safe_dump(data))
    return path


@settings(max_examples=25)
@given(st.sampled_from(["pinhole", "equidistant"]), st.tuples(SMALL, SMALL, SMALL, SMALL),
       st.lists(st.floats(-3, 3), min_size=6, max_size=6), SMALL, st.tuples(*[POSITIVE] * 5))
def test_there_and_back(tmp_path_factory, model, distortion, xi, offset_s, noise):
    before = Calibration(Camera(model, 320, 240, 200.5, 199.25, 160.125, 119, distortion), se3.exp(xi),
                         ImuNoise(*noise), offset_s)
    folder = tmp_path_factory.mktemp("kalibr") / "out"
    write_kalibr(before, folder)
    after = read_calibration(folder / "camchain.yaml", folder / "imu.yaml")
    assert (after.camera, after.imu_noise, after.time_offset_s) == (before.camera, before.imu_noise, offset_s)
    np.testing.assert_allclose(after.T_body_camera, before.T_body_camera, atol=1e-12)
    # Kalibr's matrix takes points of the IMU to the camera (its wiki), whatever ours is called.
    stored = np.array(yaml.safe_load((folder / "camchain.yaml").read_text())["cam0"]["T_cam_imu"])
    point_camera = np.array([0.1, -0.2, 0.5, 1])
    np.testing.assert_allclose(stored @ (before.T_body_camera @ point_camera), point_camera, atol=1e-12)


def test_the_time_shift_is_added_to_the_cameras_clock(tmp_path: Path):
    shifted = save(tmp_path / "c.yaml", {"cam0": CAM0 | {"timeshift_cam_imu": 0.02}})
    assert read_calibration(shifted).time_offset_s == 0.02  # t_imu = t_cam + shift, as in vio.calibration


def test_a_second_camera_hangs_on_the_first(tmp_path: Path):
    T_cam0_imu, T_cam1_cam0 = np.linalg.inv(T_BODY_CAMERA), se3.exp([0.1, 0, 0.2, 0.05, 0, 0])
    second = {key: value for key, value in CAM0.items() if key != "T_cam_imu"}
    chain = {"cam0": CAM0 | {"T_cam_imu": T_cam0_imu.tolist()}, "cam1": second | {"T_cn_cnm1": T_cam1_cam0.tolist()}}
    file = save(tmp_path / "c.yaml", chain)
    expected = np.linalg.inv(T_cam1_cam0 @ T_cam0_imu)
    np.testing.assert_allclose(read_calibration(file, camera="cam1").T_body_camera, expected, atol=1e-12)


def test_noise_as_kalibr_writes_its_results(tmp_path: Path):
    camera = save(tmp_path / "c.yaml", {"cam0": CAM0})
    flat = read_calibration(camera, save(tmp_path / "a.yaml", IMU)).imu_noise
    nested = {"imu0": IMU | {"T_i_b": np.eye(4).tolist(), "time_offset": 0.0, "model": "calibrated"}}
    assert read_calibration(camera, save(tmp_path / "b.yaml", nested)).imu_noise == flat
    assert (flat.gyro_density_rad_s_rthz, flat.accel_walk_m_s3_rthz, flat.rate_hz) == (1.5e-4, 3e-4, 40)


@pytest.mark.parametrize(("cam0", "words"), [
    ({"camera_model": "omni", "intrinsics": [0.8, 1, 1, 1, 1]}, "cam0: camera_model 'omni' is not supported"),
    ({"distortion_model": "fov"}, "cam0: distortion_model 'fov' is not supported"),
    ({"intrinsics": None}, "cam0: missing key 'intrinsics'"),
    ({"intrinsics": [1, 2, 3]}, "cam0: intrinsics must be"),
    ({"resolution": ["a", "b"]}, "cam0: resolution is"),
    ({"T_cam_imu": [[1, 2], [3, 4]]}, "cam0: T_cam_imu holds 4 numbers"),
    ({"T_cam_imu": (2 * np.eye(4)).tolist()}, r"cam0: T_cam_imu\[0\]: not a rigid transform"),
    ({"timeshift_cam_imu": "soon"}, "cam0: timeshift_cam_imu is 'soon', expected numbers"),
])
def test_unusable_cameras(tmp_path: Path, cam0, words):
    file = save(tmp_path / "c.yaml", {"cam0": {k: v for k, v in (CAM0 | cam0).items() if v is not None}})
    with pytest.raises(CalibrationError, match=rf"c\.yaml: {words}") as caught:
        read_calibration(file)
    assert "\n" not in str(caught.value) and str(tmp_path) not in str(caught.value)


@pytest.mark.parametrize(("imu", "words"), [
    ({"update_rate": None}, "missing key 'update_rate'"),
    ({"gyroscope_noise_density": 0.0}, "must be a positive number"),
    ({"T_i_b": (np.diag([1, -1, -1, 1])).tolist()}, "T_i_b is not the identity"),
    ({"time_offset": 0.1}, r"time_offset is 0\.1, relative to another IMU"),
])
def test_unusable_noise(tmp_path: Path, imu, words):
    noise = save(tmp_path / "i.yaml", {k: v for k, v in (IMU | imu).items() if v is not None})
    with pytest.raises(CalibrationError, match=rf"i\.yaml: .*{words}"):
        read_calibration(save(tmp_path / "c.yaml", {"cam0": CAM0}), noise)


def test_what_cannot_be_written_for_kalibr(tmp_path: Path):
    with pytest.raises(CalibrationError, match="no camera is known"):
        write_kalibr(Calibration(), tmp_path / "out")
    with pytest.raises(CalibrationError, match=r"k3 = 0\.1, but Kalibr's radtan has no k3"):
        write_kalibr(Calibration(Camera("pinhole", 8, 8, 9, 9, 4, 4, (0, 0, 0, 0, 0.1))), tmp_path / "out")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("x")
    with pytest.raises(OutputError, match="was not written by"):
        write_kalibr(Calibration(Camera("pinhole", 8, 8, 9, 9, 4, 4)), tmp_path / "out")
    with pytest.raises(CalibrationError, match="no camera 'cam2'; found cam0"):
        read_calibration(save(tmp_path / "c.yaml", {"cam0": CAM0}), camera="cam2")
