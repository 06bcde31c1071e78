"""Trained weights at work on a recording whose truth is known: predictions beside truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from learned.camera_rays import camera_batch
from learned.gyro_update import FEWEST_SAMPLES, GyroRotations
from learned.inference import estimate_pairs
from learned.methods import Method
from learned.training_source import SourceSettings, TrainingSource
from learned.truth import truth_of
from learned.warping import DepthKind
from vio import se3
from vio.camera import Camera
from vio.errors import RecordingError
from vio.recording import Recording

Array = NDArray[np.float64]
Maps = NDArray[np.float32]

MOVING_M = 0.5e-3
"""Steps shorter than this say nothing about direction and scale."""
BATCH = 8


@dataclass(frozen=True)
class Measured:
    """N pairs of neighbouring frames of one recording."""

    name: str
    images: NDArray[np.uint8]
    """(N, H, W, 3) of the earlier frames, at the network's size."""
    usable: NDArray[np.bool_]
    """(H, W) that the lens reaches and that are no vignette."""
    depth: Maps
    """(N, H, W) predicted z-depth of the earlier frames [motion units]; 0 unknown."""
    depth_true_m: Maps | None
    """(N, H, W), 0 unknown; None without depth truth."""
    T_i_j: Array
    """(N, 4, 4) predicted [motion units]."""
    T_true_m: Array
    """(N, 4, 4) [m]."""
    gyro: GyroRotations | None
    """Between the same frames; None without an IMU, or where pairs were picked out."""
    signals: Array
    """(N, S) of `learned.inference.SIGNALS`."""
    step_s: Array
    """(N,) between the frames."""
    camera: Camera
    """At the network's size."""

    def __len__(self) -> int:
        return len(self.T_i_j)

    @property
    def moving(self) -> NDArray[np.bool_]:
        """(N,) whether the camera truly moved by more than half a millimetre."""
        return np.asarray(np.linalg.norm(self.T_true_m[:, :3, 3], axis=1) > MOVING_M)

    @property
    def log_scale(self) -> float:
        """ln(metres per motion unit) that brings the lengths of the moving steps to their truth, by their median.

        NaN where nothing moved.
        """
        if not self.moving.any():
            return float("nan")
        true, found = (np.linalg.norm(T[self.moving, :3, 3], axis=1) for T in (self.T_true_m, self.T_i_j))
        return float(np.median(np.log(true / np.maximum(found, 1e-9))))

    def errors(self, log_scale: float) -> Array:
        """(N, 6) `Log(T_predicted⁻¹ T_true)`, truth brought to motion units."""
        true = self.T_true_m.copy()
        true[:, :3, 3] *= np.exp(-log_scale)
        return np.asarray(se3.log(se3.inverse(self.T_i_j) @ true))


def measure(method: Method, depth_kind: DepthKind, recording: Recording, first: int = 0,
            end: int | None = None) -> Measured:
    """Predictions for frames first..end - 1 of a recording, beside its truth.

    Args:
        method: in eval mode.
        depth_kind: what the depth network's numbers mean.
        recording: with images, camera, truth, and an IMU if there is one.
        first: first frame.
        end: end, exclusive; None = the recording's.

    Raises:
        RecordingError: fewer than two frames, no images, camera or truth.
        ImuError: the method looks at vibration and there is none.
    """
    height, width = method.config.image_size
    imu = len(recording.imu) >= FEWEST_SAMPLES
    settings = SourceSettings(height=height, width=width, imu=imu or method.config.vibration,
                              imu_samples=method.config.branch.samples)
    source = TrainingSource(recording, settings)
    index = np.arange(first, len(recording) if end is None else end)
    if len(index) < 2:
        raise RecordingError(f"recording {recording.name}: {len(index)} frame(s) to measure, at least 2 are needed")
    truth = truth_of(recording, index, source.camera)
    parts, frames = [], source.frames(index)
    for start in range(0, len(index) - 1, BATCH):
        rows = np.arange(start, min(start + BATCH, len(index) - 1))
        pairs = torch.stack([frames[rows], frames[rows + 1]], 1).float() / 255
        windows = None
        if method.config.vibration:
            windows = torch.from_numpy(source.vibration(index[rows])).float().transpose(1, 2).contiguous()
        parts.append(estimate_pairs(method, pairs, windows, camera_batch([source.camera] * len(rows)), depth_kind))
    depth_true = None if truth.depth_m is None else truth.depth_m[:-1, 0].numpy()
    return Measured(
        recording.name, frames[:-1].permute(0, 2, 3, 1).numpy(), source.usable[0].numpy(),
        torch.cat([part.z_depth_i[:, 0] for part in parts]).numpy(), depth_true,
        torch.cat([part.T_i_j for part in parts]).double().numpy(), truth.T_i_j.numpy(),
        GyroRotations(recording, first, end) if imu else None,
        torch.cat([part.signals for part in parts]).double().numpy(), np.diff(recording.frame_t_s[index]),
        source.camera)
