from pathlib import Path

import cv2
import numpy as np
import pytest

from vio import se3
from vio.calibration import Calibration
from vio.camera import Camera
from vio.imu import ImuNoise, ImuSamples
from vio.recording import Recording, TruthState
from vio.trajectory import Trajectory

FIRST_NS = 1_403_715_273_262_142_977  # odd, and beyond what float64 holds exactly
WIDTH, HEIGHT = 32, 24
COLOUR_BGR = (10, 100, 200)


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    """Seven colour frames in 2 s with depth for all but the third, an IMU at 40 Hz, truth with velocity and biases."""
    rng = np.random.default_rng(7)
    images, depths = tmp_path / "images", tmp_path / "depths"
    images.mkdir()
    depths.mkdir()
    frame_t_ns = FIRST_NS + np.arange(7, dtype=np.int64) * 333_333_333
    frame_paths, depth_paths = [], []
    for k in range(7):
        image = np.full((HEIGHT, WIDTH, 3), COLOUR_BGR, np.uint8)
        image[0, 0] = k
        cv2.imwrite(str(images / f"{k}.png"), image)
        cv2.imwrite(str(depths / f"{k}.png"), np.full((HEIGHT, WIDTH), 1000 * k, np.uint16))
        frame_paths.append(images / f"{k}.png")
        depth_paths.append(depths / f"{k}.png" if k != 2 else None)
    imu_t_ns = FIRST_NS - 50_000_000 + np.arange(100, dtype=np.int64) * 25_000_000
    accel = rng.normal([0, 0, 9.81], 0.05, (100, 3))
    truth_t_s = np.arange(0, 2.01, 0.1)
    truth = Trajectory(truth_t_s, se3.chain(se3.exp(rng.normal(0, 0.1, (len(truth_t_s) - 1, 6)))))
    state = TruthState(*(rng.normal(size=(len(truth_t_s), 3)) for _ in range(3)))
    noise = ImuNoise(gyro_range_rad_s=8.7, accel_range_m_s2=39.2)
    T_body_camera = se3.exp([0.1, -1.2, 0.3, 0.01, 0.0, -0.002])
    camera = Camera("equidistant", WIDTH, HEIGHT, 11, 11.5, 15.5, 11.75, (0.01, 0, -0.002, 0))
    return Recording(
        name="seven", frame_t_ns=frame_t_ns, imu=ImuSamples(imu_t_ns, rng.normal(0, 0.1, (100, 3)), accel),
        calibration=Calibration(camera, T_body_camera, noise, 0.0125), truth=truth, frame_paths=tuple(frame_paths),
        depth_paths=tuple(depth_paths), provenance={"organ": "colon", "seed": 7, "vibration": {"type": "none"}},
        depth_unit_m=1e-5, truth_state=state,
    )
