"""A scene with known answers: the inside of a textured ball, ray-traced in numpy through the numpy cameras."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from learned.camera_rays import CameraBatch, camera_batch
from learned.losses.snippet import Snippet
from vio import se3
from vio.camera import Camera

PINHOLE = Camera("pinhole", 64, 64, 42, 44, 30.5, 33.0, (-0.1, 0.02, 0.004, -0.003))
FISHEYE = Camera("equidistant", 64, 64, 23, 23, 32.0, 30.5, (-0.02, 0.003, 0, 0))  # 77 degrees to the nearest edge
WAVES = np.random.default_rng(11).normal(0, 6, (12, 3))  # rad per motion unit: about 15 pixels per wave
PHASES = np.random.default_rng(12).uniform(0, 2 * np.pi, (12, 3))


def render(camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours (3, H, W) in 0..1 and range (H, W) from inside the unit ball; 0 where no ray reaches."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).astype(float)
    rays = camera.unproject(grid)
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
    cosine = np.nan_to_num(camera.unproject(np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)),
                                                     -1).astype(float)))[..., 2]
    z = np.where(cosine > 0.01, np.array(ranges) * cosine, 0)
    return Scene(camera, camera_batch([camera], torch.float64), torch.from_numpy(np.array(pictures)),
                 torch.from_numpy(np.array(ranges))[:, None], torch.from_numpy(z)[:, None], poses)


@pytest.fixture(params=["pinhole", "fisheye"])
def scene(request: pytest.FixtureRequest) -> Scene:
    return make_scene(PINHOLE if request.param == "pinhole" else FISHEYE)


@pytest.fixture
def rendered() -> Callable[[Camera, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    return render


@pytest.fixture
def scene_of() -> Callable[..., Scene]:
    return make_scene
