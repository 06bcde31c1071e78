"""What may lie beside one's own frames: `imu.csv` and a Kalibr calibration. Shared by folders of images and films.

    imu.csv         title line; time (t_ns, t_us, t_ms or t_s), gyro_{x,y,z}_{rad_s|deg_s}, accel_{x,y,z}_{m_s2|g}
    camchain.yaml   Kalibr: camera, T_cam_imu, timeshift_cam_imu
    imu.yaml        Kalibr: noise; needed when there is an imu.csv

Gyro and accelerometer are in the axes of the IMU, which is the body; the accelerometer measures specific force (at
rest +1 g upward); one g is 9.80665 m/s². The clock of imu.csv is the frames' clock, shifted by `timeshift_cam_imu`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vio.calibration import Calibration, load_yaml
from vio.errors import CalibrationError, ImuError
from vio.formats.declared import OPTIONS, Declared
from vio.formats.kalibr import CAMCHAIN, IMU, read_calibration
from vio.formats.named_table import NamedTable, read_named_table
from vio.imu import ImuSamples

IMU_TABLE = "imu.csv"
GYRO_UNITS = {"rad_s": 1.0, "deg_s": np.pi / 180}
ACCEL_UNITS = {"m_s2": 1.0, "g": 9.80665}


def read_sidecar(folder: Path, declared: Declared) -> tuple[ImuSamples, Calibration]:
    """Inertial samples (none without `imu.csv`) and calibration of a folder; a declared calibration wins.

    Raises:
        ImuError: an unusable row or missing column of `imu.csv`.
        CalibrationError: an unusable calibration, or none although there is an IMU.
    """
    has_imu = (folder / IMU_TABLE).is_file()
    samples = read_imu_table(folder / IMU_TABLE) if has_imu else ImuSamples.none()
    if declared.calibration is not None:
        return samples, declared.calibration
    chain, noise = folder / CAMCHAIN, folder / IMU
    if not chain.is_file():
        if has_imu:
            raise CalibrationError(f"{folder.name}: {IMU_TABLE} is there, but nothing says where the camera sits on "
                                   f"the IMU; add Kalibr's {CAMCHAIN} with T_cam_imu, or give {OPTIONS['calibration']}")
        return samples, Calibration()
    calibration = read_calibration(chain, noise if noise.is_file() else None)
    if has_imu and not noise.is_file():
        raise CalibrationError(f"{folder.name}: {IMU_TABLE} is there, but nothing says how noisy it is; add Kalibr's "
                               f"{IMU} (from a data sheet or an Allan deviation)")
    if has_imu and "T_cam_imu" not in (load_yaml(chain).get("cam0") or {}):
        raise CalibrationError(f"{folder.name}/{CAMCHAIN}: cam0 has no T_cam_imu, so nothing says where the camera "
                               "sits on the IMU; add it (4 rows of 4, from IMU to camera coordinates)")
    return samples, calibration


def read_imu_table(path: Path) -> ImuSamples:
    """Read `imu.csv`, with units taken from the names of its columns.

    Raises:
        ImuError: a missing column, or an unusable row, naming its line.
    """
    table = read_named_table(path, ImuError)
    return ImuSamples(table.times_ns(), _axes(table, "gyro", GYRO_UNITS), _axes(table, "accel", ACCEL_UNITS))


def _axes(table: NamedTable, sensor: str, units: dict[str, float]) -> np.ndarray:
    there = [unit for unit in units if f"{sensor}_x_{unit}" in table.columns]
    if len(there) != 1:
        choices = " or ".join(f"{sensor}_x_{unit}" for unit in units)
        raise ImuError(f"{table.table.name}: columns {choices} (and y, z) are needed, one unit only; found "
                       f"{', '.join(table.columns)}")
    return table.floats([f"{sensor}_{axis}_{there[0]}" for axis in "xyz"]) * units[there[0]]
