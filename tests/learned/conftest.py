"""A scene with known answers: the inside of a textured ball, ray-traced in numpy through the numpy cameras."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from learned.camera_rays import CameraBatch, camera_batch
from learned.losses.snippet import Snippet
from vio import se3
from vio.calibration import Calibration
from vio.camera import Camera
from vio.formats.asl import read_asl, write_asl
from vio.imu import ImuSamples
from vio.recording import Recording
from vio.trajectory import Trajectory

# One thread: torch 2.13 on two corrupts its heap in the backward pass of a tiny network at batch 1; with oneDNN off or
# at batch 2 it was not seen in 40 steps. The workers of a test run share the cores anyway.
torch.set_num_threads(1)

PINHOLE = Camera("pinhole", 64, 64, 42, 44, 30.5, 33.0, (-0.1, 0.02, 0.004, -0.003))
FISHEYE = Camera("equidistant", 64, 64, 23, 23, 32.0, 30.5, (-0.02, 0.003, 0, 0))  # 77 degrees to the nearest edge
WAVES = np.random.default_rng(11).normal(0, 6, (12, 3))  # rad per motion unit: about 15 pixels per wave
PHASES = np.random.default_rng(12).uniform(0, 2 * np.pi, (12, 3))


def render(camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours (3, H, W) in 0..1 and range (H, W) from inside the unit ball; 0 where no ray reaches."""
    rays = camera.unproject(pixel_grid(camera))
    reached = np.isfinite(rays).all(-1)
    direction = np.where(reached[..., None], rays, [0, 0, 1]) @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    along = direction @ origin
    distance = -along + np.sqrt(along**2 - origin @ origin + 1)
    points = origin + distance[..., None] * direction
    colour = 0.5 + 0.07 * np.sin((points @ WAVES.T)[..., None] + PHASES).sum(-2)
    return np.where(reached, np.moveaxis(np.clip(colour, 0.02, 0.98), -1, 0), 0), np.where(reached, distance, 0)


@dataclass
class Scene:
    """F views of the ball."""

    camera: Camera
    cameras: CameraBatch
    """One camera, float64."""
    images: torch.Tensor
    """(F, 3, H, W)"""
    range: torch.Tensor
    """(F, 1, H, W)"""
    z: torch.Tensor
    """(F, 1, H, W), 0 where a ray looks sideways or backwards."""
    T_world_camera: np.ndarray

    def T(self, i: int, j: int) -> torch.Tensor:
        """`T_i_j` (1, 4, 4)."""
        return torch.from_numpy(se3.inverse(self.T_world_camera[i]) @ self.T_world_camera[j])[None]

    def depth(self, kind: str) -> torch.Tensor:
        return self.z if kind == "z" else self.range

    def snippet(self, kind: str, motions: dict | None = None) -> Snippet:
        """One snippet of the first three views with all four true motions, or others."""
        pairs = [(1, 0), (1, 2), (0, 1), (2, 1)]
        return Snippet(self.images[None, :3], self.depth(kind)[None, :3],
                       {pair: self.T(*pair) for pair in pairs} if motions is None else motions, self.cameras)


def make_scene(camera: Camera, seed: int = 0, views: int = 3, step: float = 0.06) -> Scene:
    rng = np.random.default_rng(seed)
    motions = se3.exp(np.concatenate([rng.normal(0, 0.05, (views - 1, 3)), rng.normal(0, step, (views - 1, 3))], 1))
    start = se3.exp([*rng.normal(0, 1, 3), *rng.normal(0, 0.1, 3)])
    poses = start @ se3.chain(motions)
    pictures, ranges = zip(*(render(camera, T) for T in poses), strict=True)
    cosine = np.nan_to_num(camera.unproject(pixel_grid(camera)))[..., 2]
    z = np.where(cosine > 0.01, np.array(ranges) * cosine, 0)
    return Scene(camera, camera_batch([camera], torch.float64), torch.from_numpy(np.array(pictures)),
                 torch.from_numpy(np.array(ranges))[:, None], torch.from_numpy(z)[:, None], poses)


@pytest.fixture(params=["pinhole", "fisheye"])
def scene(request: pytest.FixtureRequest) -> Scene:
    return make_scene(PINHOLE if request.param == "pinhole" else FISHEYE)


T_BODY_CAMERA = se3.exp([0.4, -1.1, 0.3, 0.01, 0.0, -0.02])
AXIS = np.array([0.6, -0.64, 0.48])
FPS, FRAMES, IMU_HZ = 3.0, 15, 40.0


def body_pose(t: float) -> np.ndarray:
    """`T_world_body` of a body that rocks about one axis and wanders about the ball's middle."""
    turn = se3.so3_exp(AXIS * 0.25 * np.sin(0.9 * t))
    return se3.transform(turn @ se3.so3_exp([0.3, 0.2, -0.5]), 0.2 * np.sin(np.array([0.7, 0.9, 1.1]) * t + [0, 1, 2]))


def write_ball(folder: Path, camera: Camera, name: str = "ball", imu_gap: tuple[float, float] = (0, 0)) -> Recording:
    """A recording of the ball on disk, with truth, depth and an ideal IMU, read back."""
    images = folder / f"{name}_images"
    images.mkdir()
    t = np.arange(FRAMES) / FPS
    poses = np.array([body_pose(at) for at in t])
    for k, T in enumerate(poses @ T_BODY_CAMERA):
        colour, distance = render(camera, T)
        cv2.imwrite(str(images / f"{k}.png"), np.rint(255 * np.moveaxis(colour, 0, -1)[..., ::-1]).astype(np.uint8))
        z = distance * np.nan_to_num(camera.unproject(pixel_grid(camera)))[..., 2]
        cv2.imwrite(str(images / f"{k}_depth.png"), np.rint(np.maximum(z, 0) / 1e-4).astype(np.uint16))
    imu_t = np.arange(-1, t[-1] + 1, 1 / IMU_HZ)
    imu_t = imu_t[(imu_t < imu_gap[0]) | (imu_t >= imu_gap[1])]
    half = 0.5 / IMU_HZ
    rate = 0.25 * (np.sin(0.9 * (imu_t + half)) - np.sin(0.9 * (imu_t - half))) * IMU_HZ
    mount = se3.so3_exp([0.3, 0.2, -0.5])
    gyro = rate[:, None] * (mount.T @ AXIS)
    accel = np.array([body_pose(at)[:3, :3].T @ [0, 0, 9.81] for at in imu_t])
    to_ns = lambda seconds: np.rint((seconds + 10) * 1e9).astype(np.int64)  # noqa: E731
    paths = tuple(images / f"{k}.png" for k in range(FRAMES))
    write_asl(Recording(
        name, to_ns(t), ImuSamples(to_ns(imu_t), gyro, accel), Calibration(camera, T_BODY_CAMERA),
        Trajectory(t, poses), paths, tuple(images / f"{k}_depth.png" for k in range(FRAMES)), depth_unit_m=1e-4),
        folder / name)
    return read_asl(folder / name)


def pixel_grid(camera: Camera) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).astype(float)


@pytest.fixture(scope="session", params=["pinhole", "fisheye"])
def ball(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return write_ball(tmp_path_factory.mktemp("ball"), PINHOLE if request.param == "pinhole" else FISHEYE)


@pytest.fixture
def written() -> Callable[..., Recording]:
    return write_ball


@pytest.fixture
def rendered() -> Callable[[Camera, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    return render


@pytest.fixture
def scene_of() -> Callable[..., Scene]:
    return make_scene
