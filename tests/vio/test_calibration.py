"""Calibration files: what is accepted, what is named when it is missing or impossible, and that nothing is lost."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from vio import se3
from vio.calibration import (
    Calibration,
    T_body_sensor_from_asl,
    camera_from_asl,
    camera_to_asl,
    imu_from_asl,
    imu_to_asl,
    load_yaml,
)
from vio.camera import Camera
from vio.errors import CalibrationError, ImuError
from vio.imu import ImuNoise

CAMERA = {
    "camera_model": "pinhole", "intrinsics": [458.654, 457.296, 367.215, 248.375], "resolution": [752, 480],
    "distortion_model": "radial-tangential", "distortion_coefficients": [-0.28, 0.07, 1e-4, 1e-5],
}
IMU = {
    "gyroscope_noise_density": 1.7e-4, "gyroscope_random_walk": 1.9e-5, "accelerometer_noise_density": 2e-3,
    "accelerometer_random_walk": 3e-3, "rate_hz": 200,
}
POSITIVE = st.floats(1e-9, 1e3)


def test_euroc_camera_and_imu(shared_data):
    folder = shared_data / "euroc_v101" / "mav0"
    data = load_yaml(folder / "cam0" / "sensor.yaml")
    camera = camera_from_asl(data, "cam0")
    assert (camera.model, camera.width, camera.height) == ("pinhole", 752, 480)
    assert (camera.fx, camera.cy, camera.distortion[0]) == (458.654, 248.375, -0.28340811)
    T = T_body_sensor_from_asl(data, "cam0")
    np.testing.assert_allclose(T[:3, 3], [-0.0216401454975, -0.064676986768, 0.00981073058949])
    np.testing.assert_allclose(T[0, :3], [0.0148655429818, -0.999880929698, 0.00414029679422], atol=1e-9)
    noise, offset_s = imu_from_asl(load_yaml(folder / "imu0" / "sensor.yaml"), "imu0")
    assert noise == ImuNoise(1.6968e-4, 2e-3, 1.9393e-5, 3e-3, 200.0)
    assert offset_s == 0


@given(st.builds(ImuNoise, *(POSITIVE,) * 5, st.none() | POSITIVE, st.none() | POSITIVE),
       st.floats(-1, 1), st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_calibration_survives_its_files(noise, offset_s, xi):
    camera = Camera("pinhole", 640, 480, 400.1, 410.2, 330, 235, (-0.2, 0.05, 0.01, -0.008, 0.003))
    before = Calibration(camera, se3.exp(xi), noise, offset_s)
    data = yaml.safe_load(yaml.safe_dump(camera_to_asl(before, 20.0)))
    assert camera_from_asl(data, "cam0") == camera
    np.testing.assert_allclose(T_body_sensor_from_asl(data, "cam0"), before.T_body_camera, atol=1e-15)
    assert imu_from_asl(yaml.safe_load(yaml.safe_dump(imu_to_asl(before))), "imu0") == (noise, offset_s)


def test_opencv_dialect_and_numbers_that_yaml_takes_for_text(tmp_path: Path):
    file = tmp_path / "sensor.yaml"
    file.write_text("%YAML:1.0\n---\nT_BS: !!opencv-matrix\n  rows: 4\n  cols: 4\n  dt: d\n"
                    "  data: [1, 0, 0, 1e-2, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\nrate_hz: 2e2\n")
    data = load_yaml(file)
    assert isinstance(data["rate_hz"], str)
    assert T_body_sensor_from_asl(data, "sensor.yaml")[0, 3] == 0.01
    noise, _ = imu_from_asl({**IMU, "rate_hz": data["rate_hz"]}, "sensor.yaml")
    assert noise.rate_hz == 200


def test_T_BS_as_rows_or_flat():
    T = se3.exp([0.1, 0.2, 0.3, 1, 2, 3])
    for value in (T.tolist(), T.ravel().tolist(), {"rows": 4, "cols": 4, "data": T.ravel().tolist()}):
        np.testing.assert_allclose(T_body_sensor_from_asl({"T_BS": value}, "cam0"), T, atol=1e-15)


@pytest.mark.parametrize(("distortion_model", "model"), [
    ("radtan", "pinhole"), ("radial-tangential", "pinhole"), ("none", "pinhole"), ("equidistant", "equidistant"),
])
def test_distortion_models(distortion_model, model):
    camera = camera_from_asl({**CAMERA, "distortion_model": distortion_model}, "cam0")
    assert camera.model == model
    assert any(camera.distortion) == (distortion_model != "none")


@pytest.mark.parametrize("key", CAMERA)
def test_a_missing_camera_key_is_named_with_its_file(key):
    with pytest.raises(CalibrationError, match=f"cam0/sensor.yaml: missing key '{key}'"):
        camera_from_asl({k: v for k, v in CAMERA.items() if k != key}, "cam0/sensor.yaml")


@pytest.mark.parametrize("key", IMU)
def test_a_missing_imu_key_is_named_with_its_file(key):
    with pytest.raises(CalibrationError, match=f"imu0/sensor.yaml: missing key '{key}'"):
        imu_from_asl({k: v for k, v in IMU.items() if k != key}, "imu0/sensor.yaml")


@pytest.mark.parametrize(("change", "words"), [
    ({"camera_model": "omni"}, "camera_model 'omni'"),
    ({"distortion_model": "fov"}, "distortion_model 'fov'.*equidistant"),
    ({"intrinsics": [1, 2, 3]}, "found 3 and 2 numbers"),
    ({"intrinsics": ["a", 2, 3, 4]}, "intrinsics.*expected numbers"),
    ({"intrinsics": [float("inf"), 2, 3, 4]}, "intrinsics.*not finite"),
    ({"resolution": [480]}, "found 4 and 1 numbers"),
    ({"resolution": [480, 752], "intrinsics": [458, 457, 367, -900]}, "cy is -900"),
    ({"distortion_coefficients": [0.1]}, "1 distortion coefficients"),
])
def test_impossible_cameras(change, words):
    with pytest.raises(CalibrationError, match=f"cam0: .*{words}"):
        camera_from_asl({**CAMERA, **change}, "cam0")


@pytest.mark.parametrize(("change", "words"), [
    ({"gyroscope_noise_density": 0}, "gyro_density_rad_s_rthz is 0"),
    ({"rate_hz": -1}, "rate_hz"),
    ({"accelerometer_random_walk": [1, 2]}, "holds 2 numbers"),
    ({"T_BS": np.diag([1.0, -1, -1, 1]).tolist()}, "T_BS is not the identity"),
    ({"T_BS": [1, 2, 3]}, "holds 3 numbers"),
    ({"T_BS": np.diag([1.0, 1, 2, 1]).tolist()}, "not a rigid transform"),
    ({"time_offset_s": "soon"}, "time_offset_s.*expected numbers"),
])
def test_impossible_imus(change, words):
    with pytest.raises(CalibrationError, match=f"imu0: .*{words}"):
        imu_from_asl({**IMU, **change}, "imu0")


@pytest.mark.parametrize(("content", "words"), [
    (None, "no such file"), (b"a: [1, 2\nb: 3\n", "not valid YAML in line"), (b"- 1\n- 2\n", "found list"),
    (b"", "found NoneType"), (b"\xff\xfe\x00", "cannot be read"), (b"date: 2020-13-45\n", "not valid YAML"),
])
def test_unreadable_yaml(tmp_path: Path, content, words):
    file = tmp_path / "imu0" / "sensor.yaml"
    file.parent.mkdir()
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(CalibrationError, match=f"^imu0/sensor.yaml: .*{words}"):
        load_yaml(file)


@pytest.mark.parametrize("values", [{"T_body_camera": np.ones((4, 4))}, {"T_body_camera": np.eye(4)[None]},
                                    {"time_offset_s": float("nan")}])
def test_calibration_checks_its_parts(values):
    with pytest.raises(CalibrationError):
        Calibration(**values)


def test_noise_must_be_positive():
    with pytest.raises(ImuError, match="accel_walk_m_s3_rthz is -1"):
        ImuNoise(accel_walk_m_s3_rthz=-1)
