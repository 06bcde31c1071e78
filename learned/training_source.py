"""One recording, made ready to be trained on: its frames at the network's size, its IMU cut, its vignette found."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learned.frames import resized_rgb
from learned.windows import ImuWindows
from vio.camera import Camera
from vio.errors import ConfigError, ImuError, RecordingError, TrajectoryError
from vio.imu import GAP_LIMIT_S, preintegrate_rotation, split_at_frames
from vio.recording import Recording
from vio.tracking import DARK_LEVEL, connected_to_border
from vio.trajectory import Trajectory

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

FRAMES_FOR_VIGNETTE = 8
TIME_SLACK_S = 1e-4  # files of trajectories round their times
LEAST_USABLE = 0.1  # share of the image; with less there is nothing to train on


@dataclass(frozen=True)
class SourceSettings:
    """How recordings are read for training."""

    height: int = 128
    """Of the images [pixels]; frames are resized, and the intrinsics with them."""
    width: int = 128
    imu: bool = True
    """Whether items carry vibration windows and gyro rotations; False trains on recordings without an IMU log."""
    imu_samples: int = 40
    """Samples per window."""
    imu_rate_hz: float = 40.0
    step: int = 1
    """Frames from one frame of a triplet to the next: 10 makes 3 FPS of 30."""
    longest_step_s: float | None = None
    """Triplets with a longer time between frames are left out; None = any."""
    preload: bool = False
    """Hold all frames in memory (uint8, at the network's size) instead of decoding them again in every epoch."""

    def __post_init__(self) -> None:
        for name in ("height", "width", "step", "imu_samples"):
            if getattr(self, name) < 1:
                raise ConfigError(f"training data: {name} is {getattr(self, name)}, must be at least 1")
        if not self.imu_rate_hz > 0:
            raise ConfigError(f"training data: imu_rate_hz is {self.imu_rate_hz}, must be positive")


class TrainingSource:
    """One recording at the size of the network.

    Args:
        recording: with images and a calibrated camera.
        settings: how it is read.
        trajectory: of the body, metres, such as a refinement of this recording; None = how far the camera moved is not
            known.

    Raises:
        RecordingError: no camera, no images, or nearly all of the image is black.
        ImuError: items with an IMU are asked for and it is absent or does not cover the frames.
        TrajectoryError: the trajectory is of another time.
    """

    def __init__(self, recording: Recording, settings: SourceSettings, trajectory: Trajectory | None = None) -> None:
        camera = recording.calibration.camera
        if camera is None:
            raise RecordingError(f"recording {recording.name}: no camera is calibrated, and views are warped through "
                                 "it; add intrinsics to cam0/sensor.yaml")
        if not recording.has_any_image:
            raise RecordingError(f"recording {recording.name}: images are missing; restore cam0/data")
        self.recording, self.settings = recording, settings
        self.camera: Camera = camera.resized(settings.width, settings.height)
        self.R_body_camera: Array = recording.calibration.T_body_camera[:3, :3]
        self.R_i_j_gyro, self._seen_by_imu = self._gyro()
        self._windows = self._imu_windows()
        self._position_m = None if trajectory is None else self._positions(trajectory)
        self._frames: Tensor | None = None
        if settings.preload:
            self._frames = torch.stack([self._decode(k) for k in range(len(recording))])
            self._frames.share_memory_()  # type: ignore[no-untyped-call]
        self.usable = torch.from_numpy(self._usable())[None]

    def triplets(self, first: int, end: int) -> tuple[NDArray[np.int64], dict[str, int]]:
        """Middle frames of the triplets within frames first..end - 1, and how many were left out for which reason."""
        step = self.settings.step
        middle = np.arange(first + step, end - step, dtype=np.int64)
        t = self.recording.frame_t_s
        longest = np.maximum(t[middle] - t[middle - step], t[middle + step] - t[middle])
        slow = longest > (np.inf if self.settings.longest_step_s is None else self.settings.longest_step_s)
        blind = np.zeros(len(middle), bool)
        if self._windows is not None:
            stale = self._windows.over_gap(t)
            lost = np.concatenate([[0], np.cumsum(~self._seen_by_imu)])
            blind = (lost[middle + step] > lost[middle - step]) | stale[middle - step] | stale[middle] | stale[
                middle + step]
        left_out = {"too long a step": int(slow.sum()), "hole in the imu": int((blind & ~slow).sum())}
        return middle[~(slow | blind)], {reason: count for reason, count in left_out.items() if count}

    def frames(self, index: NDArray[np.int64]) -> Tensor:
        """Frames (F, 3, H, W) uint8, R, G, B.

        Raises:
            RecordingError: an image that cannot be read, naming the frame.
        """
        if self._frames is not None:
            return self._frames[torch.from_numpy(index)]
        return torch.stack([self._decode(int(k)) for k in index])

    def rotations(self, index: NDArray[np.int64]) -> Array:
        """Gyro rotations (F - 1, 3, 3) from each of the frames to the next, `R_i_j` in camera axes."""
        out = []
        for i, j in pairwise(index):
            R = np.eye(3)
            for step in self.R_i_j_gyro[i:j]:
                R = R @ step
            out.append(R)
        return np.array(out)

    def vibration(self, index: NDArray[np.int64]) -> Array:
        """IMU windows (F, n, 6) centred at the frames: gyro [rad/s], then specific force [m/s²], body axes.

        Raises:
            ConfigError: the source was made without an IMU.
        """
        if self._windows is None:
            raise ConfigError("training data: without an IMU (imu = False) there are no vibration windows")
        return self._windows.at(self.recording.frame_t_s[index])

    def lengths(self, index: NDArray[np.int64]) -> Array | None:
        """How far the camera moved (F - 1,) from each of the frames to the next [m]; NaN where the trajectory does not
        reach, None without a trajectory."""
        if self._position_m is None:
            return None
        return np.asarray(np.linalg.norm(np.diff(self._position_m[index], axis=0), axis=1))

    def _positions(self, trajectory: Trajectory) -> Array:
        """Of the camera at each frame (N, 3) [m], NaN outside the trajectory's time."""
        t = self.recording.frame_t_s
        there = (t >= trajectory.t_s[0] - TIME_SLACK_S) & (t <= trajectory.t_s[-1] + TIME_SLACK_S)
        if not there.any():
            raise TrajectoryError(
                f"recording {self.recording.name}: the trajectory given for it spans {trajectory.t_s[0]:.3f} to "
                f"{trajectory.t_s[-1]:.3f} s, the frames {t[0]:.3f} to {t[-1]:.3f} s; give its own refinement")
        inside = np.clip(t[there], trajectory.t_s[0], trajectory.t_s[-1])
        T_world_camera = trajectory.interpolate(inside).T_world_body @ self.recording.calibration.T_body_camera
        positions = np.full((len(t), 3), np.nan)
        positions[there] = T_world_camera[:, :3, 3]
        return positions

    def _decode(self, k: int) -> Tensor:
        image = resized_rgb(self.recording.frame(k), (self.settings.height, self.settings.width))
        return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))

    def _gyro(self) -> tuple[Array, Bools]:
        """Rotations (M, 3, 3) from frame to frame in camera axes, and which of them no hole of the IMU spoils."""
        recording = self.recording
        if not self.settings.imu:
            return np.zeros((0, 3, 3)), np.zeros(0, bool)
        if len(recording.imu) < 2:
            raise ImuError(f"recording {recording.name}: {len(recording.imu)} inertial samples, but vibration is asked "
                           "for; add imu0/data.csv, or train a vision-only method (imu = False)")
        pieces = split_at_frames(recording.imu, recording.imu_t_s, recording.frame_t_s)
        R_body = preintegrate_rotation(pieces, np.zeros(3))
        return self.R_body_camera.T @ R_body @ self.R_body_camera, pieces.longest_s <= GAP_LIMIT_S

    def _imu_windows(self) -> ImuWindows | None:
        s, recording = self.settings, self.recording
        if not s.imu:
            return None
        return ImuWindows(recording.imu, recording.imu_t_s, recording.frame_t_s, s.imu_samples, s.imu_rate_hz)

    def _usable(self) -> Bools:
        """Pixels (H, W) that the lens reaches and that are no vignette.

        Vignette is what stays dark in some frames of the whole recording and hangs together with the border; one
        pixel at its edge is left out too, for it mixes with the image.
        """
        spread = np.unique(np.linspace(0, len(self.recording) - 1, FRAMES_FOR_VIGNETTE).astype(np.int64))
        brightest = self.frames(spread).amax((0, 1)).numpy()
        vignette = connected_to_border(brightest <= DARK_LEVEL)
        grid = np.stack(np.meshgrid(np.arange(self.camera.width), np.arange(self.camera.height)), axis=-1)
        reached = np.isfinite(self.camera.unproject(grid)).all(axis=-1)
        edge = cv2.dilate(vignette.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        usable = np.asarray(reached & ~edge)
        if usable.mean() < LEAST_USABLE:
            raise RecordingError(
                f"recording {self.recording.name}: {100 * usable.mean():.0f} % of the image are usable (limit "
                f"{100 * LEAST_USABLE:.0f} %), the rest is black or beyond the lens; look at the frames and at the "
                "calibration")
        return usable
