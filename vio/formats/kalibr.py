"""Kalibr calibrations, in and out: `camchain.yaml` and `imu.yaml`.

    camchain.yaml   cam0: camera_model, intrinsics [fu, fv, pu, pv], distortion_model, distortion_coeffs,
                    resolution [w, h], T_cam_imu 4 x 4 (maps IMU coordinates to camera coordinates, metres),
                    timeshift_cam_imu [s] (t_imu = t_cam + shift); cam1 may give T_cn_cnm1 (from the camera before it)
    imu.yaml        accelerometer_noise_density [m/s²/√Hz], accelerometer_random_walk [m/s³/√Hz],
                    gyroscope_noise_density [rad/s/√Hz], gyroscope_random_walk [rad/s²/√Hz], update_rate [Hz];
                    flat, or under `imu0` as Kalibr writes results

`T_body_camera` is the inverse of `T_cam_imu`; `time_offset_s` is `timeshift_cam_imu` as it stands. The
`*_random_walk` are walks of the BIAS; a data sheet's "angle random walk" is the noise density. Pinhole with radtan,
equidistant or no distortion can be used; omni, ds, eucm and fov are refused, for no camera here is one of them.

Source: the Kalibr wiki, "yaml formats" and "IMU noise model".
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from vio import se3
from vio.atomic import atomic_folder
from vio.calibration import (
    IMU_KEYS,
    Calibration,
    T_body_sensor_from_asl,
    camera_from_asl,
    imu_from_asl,
    load_yaml,
    number,
    numbers,
    short_name,
)
from vio.camera import Camera
from vio.errors import CalibrationError, GeometryError, ImuError
from vio.imu import ImuNoise

Array = NDArray[np.float64]

CAMCHAIN, IMU = "camchain.yaml", "imu.yaml"
RATE_KEY = "update_rate"


def read_calibration(camera_path: str | Path, imu_path: str | Path | None = None, camera: str = "cam0") -> Calibration:
    """Read a calibration in Kalibr's or in ASL's files, told apart by their content.

    Args:
        camera_path: `camchain.yaml`, or an ASL `cam0/sensor.yaml`.
        imu_path: `imu.yaml`, or an ASL `imu0/sensor.yaml`; None leaves the default noise.
        camera: which camera of a chain.

    Raises:
        CalibrationError: a key is missing, of the wrong kind or impossible, naming file and key.
    """
    path = Path(camera_path)
    data, name = load_yaml(path), short_name(path)
    if "camera_model" in data:
        lens, T_body_camera, offset_s = camera_from_asl(data, name), T_body_sensor_from_asl(data, name), 0.0
    else:
        lens, T_body_camera, offset_s = _camera_of_chain(data, camera, name)
    if imu_path is None:
        return Calibration(lens, T_body_camera, time_offset_s=offset_s)
    noise, more_offset_s = _read_imu(Path(imu_path))
    return Calibration(lens, T_body_camera, noise, offset_s + more_offset_s)


def write_kalibr(calibration: Calibration, out: str | Path) -> None:
    """Write `camchain.yaml` and `imu.yaml` into a folder, whole or not at all.

    Raises:
        CalibrationError: there is no camera.
        OutputError: `out` exists and holds no `camchain.yaml`, or cannot be written.
    """
    lens = calibration.camera
    if lens is None:
        raise CalibrationError("calibration: no camera is known, so there is nothing to write for Kalibr")
    chain = {"cam0": {
        "camera_model": "pinhole",
        "intrinsics": [float(v) for v in (lens.fx, lens.fy, lens.cx, lens.cy)],
        "distortion_model": "radtan" if lens.model == "pinhole" else "equidistant",
        "distortion_coeffs": [float(v) for v in _four(lens)],
        "resolution": [lens.width, lens.height],
        "T_cam_imu": [[float(v) for v in row] for row in se3.inverse(calibration.T_body_camera)],
        "timeshift_cam_imu": float(calibration.time_offset_s),
    }}
    noise = calibration.imu_noise
    imu = {key: float(getattr(noise, ours)) for key, ours in IMU_KEYS.items() if key != "rate_hz"}
    with atomic_folder(out, CAMCHAIN) as folder:
        for name, data in ((CAMCHAIN, chain), (IMU, imu | {RATE_KEY: float(noise.rate_hz)})):
            text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None)
            (folder / name).write_text(text, encoding="utf-8")


def _four(lens: Camera) -> tuple[float, ...]:
    if len(lens.distortion) > 4 and lens.distortion[4] != 0:
        raise CalibrationError(f"camera: k3 = {lens.distortion[4]:g}, but Kalibr's radtan has no k3; fit the camera "
                               "with k1, k2, p1, p2 only")
    return lens.distortion[:4]


def _camera_of_chain(data: dict[str, Any], camera: str, name: str) -> tuple[Camera, Array, float]:
    """Camera, `T_body_camera` and time offset [s]; without `T_cam_imu` the body is the camera."""
    entry = data.get(camera)
    if not isinstance(entry, dict):
        raise CalibrationError(f"{name}: no camera {camera!r}; found {', '.join(map(str, data)) or 'nothing'}; a "
                               "Kalibr chain has cam0, an ASL file camera_model")
    where = f"{name}: {camera}"
    asl = {"resolution": entry.get("resolution"), "intrinsics": entry.get("intrinsics"),
           "camera_model": entry.get("camera_model"), "distortion_model": entry.get("distortion_model"),
           "distortion_coefficients": entry.get("distortion_coeffs")}
    lens = camera_from_asl({key: value for key, value in asl.items() if value is not None}, where)
    shift = number(entry, "timeshift_cam_imu", where) if entry.get("timeshift_cam_imu") is not None else 0.0
    T_cam_imu = _T_cam_imu(data, camera, name)
    return lens, np.eye(4) if T_cam_imu is None else se3.inverse(T_cam_imu), shift


def _T_cam_imu(data: dict[str, Any], camera: str, name: str) -> Array | None:
    """From IMU to camera coordinates, along the chain where the camera itself does not say."""
    entry = data.get(camera)
    if not isinstance(entry, dict):
        return None
    if entry.get("T_cam_imu") is not None:
        return _matrix(entry, "T_cam_imu", f"{name}: {camera}")
    before = f"cam{int(camera[3:]) - 1}" if camera[3:].isdigit() and camera != "cam0" else None
    if before is None or entry.get("T_cn_cnm1") is None:
        return None
    T_before_imu = _T_cam_imu(data, before, name)
    return None if T_before_imu is None else _matrix(entry, "T_cn_cnm1", f"{name}: {camera}") @ T_before_imu


def _matrix(data: dict[str, Any], key: str, where: str) -> Array:
    flat = numbers(data, key, where)
    if len(flat) != 16:
        raise CalibrationError(f"{where}: {key} holds {len(flat)} numbers, expected 4 rows of 4")
    try:
        return se3.check_transforms(flat.reshape(4, 4), key)
    except GeometryError as error:
        raise CalibrationError(f"{where}: {error}") from None


def _read_imu(path: Path) -> tuple[ImuNoise, float]:
    """Noise and a further time offset [s]."""
    data, name = load_yaml(path), short_name(path)
    if "rate_hz" in data:
        return imu_from_asl(data, name)
    if isinstance(data.get("imu0"), dict):
        data, name = data["imu0"], f"{name}: imu0"
    if data.get("T_i_b") is not None and np.abs(_matrix(data, "T_i_b", name) - np.eye(4)).max() > 1e-6:
        raise CalibrationError(f"{name}: T_i_b is not the identity, but the body is this IMU; use that IMU's chain")
    if data.get("time_offset") is not None and number(data, "time_offset", name) != 0:
        raise CalibrationError(f"{name}: time_offset is {data['time_offset']}, relative to another IMU; set it to 0 "
                               "and give the shift as timeshift_cam_imu")
    values = {ours: number(data, RATE_KEY if key == "rate_hz" else key, name) for key, ours in IMU_KEYS.items()}
    try:
        return ImuNoise(**values), 0.0
    except ImuError as error:
        raise CalibrationError(f"{name}: {error}") from None
