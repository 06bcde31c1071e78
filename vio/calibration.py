"""What is known about the sensors: camera, where it sits in the body, IMU noise, clock offset.

Files are the `sensor.yaml` of the ASL layout (Burri et al. 2016). Our additions, all optional and in SI units:
`gyroscope_range` [rad/s], `accelerometer_range` [m/s²] and `time_offset_s` [s] in imu0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from vio import se3
from vio.camera import Camera, CameraModel
from vio.errors import CalibrationError, CameraError, GeometryError, ImuError
from vio.imu import ImuNoise

Array = NDArray[np.float64]

DISTORTION_MODELS: dict[str, CameraModel] = {
    "radial-tangential": "pinhole", "radtan": "pinhole", "none": "pinhole", "equidistant": "equidistant",
}
IMU_KEYS = {
    "gyroscope_noise_density": "gyro_density_rad_s_rthz",
    "accelerometer_noise_density": "accel_density_m_s2_rthz",
    "gyroscope_random_walk": "gyro_walk_rad_s2_rthz",
    "accelerometer_random_walk": "accel_walk_m_s3_rthz",
    "rate_hz": "rate_hz",
}
IMU_RANGE_KEYS = {"gyroscope_range": "gyro_range_rad_s", "accelerometer_range": "accel_range_m_s2"}


@dataclass(frozen=True)
class Calibration:
    """Camera and IMU of one recording.

    Raises:
        CalibrationError: `T_body_camera` is no rigid transform, or the time offset is not finite.
    """

    camera: Camera | None = None
    """None when the recording brings motions but no images."""
    T_body_camera: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4) pose of the camera in the body (= IMU) frame, metres."""
    imu_noise: ImuNoise = field(default_factory=ImuNoise)
    time_offset_s: float = 0.0
    """Time on the IMU's clock = time on the camera's clock + this offset."""

    def __post_init__(self) -> None:
        try:
            T = se3.check_transforms(self.T_body_camera, "T_body_camera")
        except GeometryError as error:
            raise CalibrationError(f"calibration: {error}") from None
        if T.shape != (4, 4):
            raise CalibrationError(f"calibration: T_body_camera has shape {T.shape}, expected (4, 4)")
        if not np.isfinite(self.time_offset_s):
            raise CalibrationError(f"calibration: time_offset_s is {self.time_offset_s}; give seconds")
        object.__setattr__(self, "T_body_camera", T)


def load_yaml(path: str | Path) -> dict[str, Any]:
    """Read a YAML mapping; the `%YAML:1.0` line and matrix tags that OpenCV writes are accepted.

    Raises:
        CalibrationError: the file is missing, is no YAML, or holds no mapping.
    """
    path = Path(path)
    name = short_name(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        text = "\n".join("" if line.startswith("%") else line.replace("!!opencv-matrix", "") for line in lines)
        data = yaml.safe_load(text)
    except FileNotFoundError:
        raise CalibrationError(f"{name}: no such file; the calibration of this sensor is needed") from None
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{name}: cannot be read ({error})") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None) or "malformed"
        line = f" in line {mark.line + 1}" if mark is not None else ""
        raise CalibrationError(f"{name}: not valid YAML{line} ({problem}); repair it") from None
    if not isinstance(data, dict):
        raise CalibrationError(f"{name}: expected `key: value` lines, found {type(data).__name__}")
    return data


def short_name(path: Path) -> str:
    """Folder and file, which is how messages call a file: enough to find it, nothing of where the user keeps it."""
    return "/".join(path.parts[-2:])


def required(data: dict[str, Any], key: str, name: str) -> Any:
    """The value of `key`.

    Raises:
        CalibrationError: it is not there, naming the file `name` and the key.
    """
    if data.get(key) is None:
        raise CalibrationError(f"{name}: missing key {key!r}; add it (docs/conventions.md lists all keys)")
    return data[key]


def numbers(data: dict[str, Any], key: str, name: str) -> Array:
    """The value of `key` as a flat float array (N,); also from text such as `1e-3`, which YAML 1.1 takes for a string.

    Raises:
        CalibrationError: missing, not numeric, or not finite.
    """
    value = required(data, key, name)
    try:
        array = np.array(value, float).ravel()
    except (TypeError, ValueError):
        raise CalibrationError(f"{name}: {key} is {value!r}, expected numbers") from None
    if not np.isfinite(array).all():
        raise CalibrationError(f"{name}: {key} holds a value that is not finite")
    return array


def number(data: dict[str, Any], key: str, name: str) -> float:
    """The value of `key` as one number.

    Raises:
        CalibrationError: missing, not one number, or not finite.
    """
    array = numbers(data, key, name)
    if len(array) != 1:
        raise CalibrationError(f"{name}: {key} holds {len(array)} numbers, expected one")
    return float(array[0])


def camera_from_asl(data: dict[str, Any], name: str) -> Camera:
    """Camera of an ASL `cam0/sensor.yaml`; `name` is the file in messages.

    Raises:
        CalibrationError: a key is missing, the model is not supported, or the numbers are no camera.
    """
    camera_model = required(data, "camera_model", name)
    if camera_model != "pinhole":
        raise CalibrationError(f"{name}: camera_model {camera_model!r} is not supported; use 'pinhole' "
                               "(a fisheye is distortion_model 'equidistant')")
    distortion_model = str(required(data, "distortion_model", name))
    if distortion_model not in DISTORTION_MODELS:
        raise CalibrationError(f"{name}: distortion_model {distortion_model!r} is not supported; "
                               f"use one of {', '.join(DISTORTION_MODELS)}")
    intrinsics, size = numbers(data, "intrinsics", name), numbers(data, "resolution", name)
    if len(intrinsics) != 4 or len(size) != 2:
        raise CalibrationError(f"{name}: intrinsics must be fx, fy, cx, cy and resolution width, height; "
                               f"found {len(intrinsics)} and {len(size)} numbers")
    distortion = () if distortion_model == "none" else tuple(numbers(data, "distortion_coefficients", name).tolist())
    fx, fy, cx, cy = intrinsics.tolist()
    try:
        return Camera(DISTORTION_MODELS[distortion_model], size[0], size[1], fx, fy, cx, cy, distortion)
    except CameraError as error:
        raise CalibrationError(f"{name}: {error}") from None


def T_body_sensor_from_asl(data: dict[str, Any], name: str) -> Array:
    """`T_BS` (4, 4) of an ASL `sensor.yaml`: `{rows, cols, data}`, 16 numbers, or four rows.

    Raises:
        CalibrationError: missing, not 16 numbers, or no rigid transform.
    """
    value = required(data, "T_BS", name)
    if isinstance(value, dict):
        value = required(value, "data", f"{name}: T_BS")
    flat = numbers({"T_BS": value}, "T_BS", name)
    if len(flat) != 16:
        raise CalibrationError(f"{name}: T_BS holds {len(flat)} numbers, expected 16 (4 x 4, row by row)")
    try:
        return se3.check_transforms(flat.reshape(4, 4), "T_BS")
    except GeometryError as error:
        raise CalibrationError(f"{name}: {error}") from None


def imu_from_asl(data: dict[str, Any], name: str) -> tuple[ImuNoise, float]:
    """Noise and time offset [s] of an ASL `imu0/sensor.yaml`.

    Raises:
        CalibrationError: a key is missing or not positive, or `T_BS` is not the identity (body = IMU frame).
    """
    if "T_BS" in data and np.abs(T_body_sensor_from_asl(data, name) - np.eye(4)).max() > 1e-6:
        raise CalibrationError(f"{name}: T_BS is not the identity, but the body frame is the IMU frame; "
                               "express the camera's T_BS relative to the IMU and set this one to the identity")
    values = {ours: number(data, key, name) for key, ours in IMU_KEYS.items()}
    values |= {ours: number(data, key, name) for key, ours in IMU_RANGE_KEYS.items() if data.get(key) is not None}
    offset_s = number(data, "time_offset_s", name) if data.get("time_offset_s") is not None else 0.0
    try:
        return ImuNoise(**values), offset_s
    except ImuError as error:
        raise CalibrationError(f"{name}: {error}") from None


def camera_to_asl(calibration: Calibration, rate_hz: float | None = None) -> dict[str, Any]:
    """Content of `cam0/sensor.yaml`; without a camera only `T_BS`."""
    data: dict[str, Any] = {"sensor_type": "camera", "T_BS": _matrix(calibration.T_body_camera)}
    if rate_hz is not None:
        data["rate_hz"] = rate_hz
    camera = calibration.camera
    if camera is not None:
        data |= {
            "resolution": [camera.width, camera.height],
            "camera_model": "pinhole",
            "intrinsics": [float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)],
            "distortion_model": "radial-tangential" if camera.model == "pinhole" else "equidistant",
            "distortion_coefficients": list(camera.distortion),
        }
    return data


def imu_to_asl(calibration: Calibration) -> dict[str, Any]:
    """Content of `imu0/sensor.yaml`."""
    noise = calibration.imu_noise
    data: dict[str, Any] = {"sensor_type": "imu", "T_BS": _matrix(np.eye(4))}
    values = {key: getattr(noise, ours) for key, ours in (IMU_KEYS | IMU_RANGE_KEYS).items()}
    data |= {key: float(value) for key, value in values.items() if value is not None}
    return data | {"time_offset_s": float(calibration.time_offset_s)}


def _matrix(T: Array) -> dict[str, Any]:
    return {"cols": 4, "rows": 4, "data": [float(value) for value in T.ravel()]}
