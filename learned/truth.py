"""What is true of a few frames, at the size of the network: for evaluation only."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learned.dihedral import Symmetry
from vio import se3
from vio.camera import Camera
from vio.errors import RecordingError
from vio.recording import Recording

Array = NDArray[np.float64]

WHOLE = 0.999  # share of a shrunk pixel that must have known depth
FARTHEST_M = 1e4


@dataclass(frozen=True)
class Truth:
    """Of F frames."""

    T_i_j: Tensor
    """(F - 1, 4, 4) float64 pose of the camera at each frame in the camera at the frame before, metres."""
    depth_m: Tensor | None
    """(F, 1, H, W) float32 z-depth, 0 where unknown; None when one of the frames has none."""

    def changed(self, symmetry: Symmetry) -> Truth:
        """The same for changed images."""
        T = torch.from_numpy(symmetry.transform(self.T_i_j.numpy()))
        return Truth(T, None if self.depth_m is None else symmetry.image(self.depth_m).contiguous())


def truth_of(recording: Recording, index: NDArray[np.int64], camera: Camera) -> Truth:
    """Truth of the frames `index` (F,), depth at the size of `camera`.

    Raises:
        RecordingError: the recording has no truth, or a depth image cannot be read.
        TrajectoryError: the truth does not cover the frames.
    """
    if recording.truth is None:
        raise RecordingError(f"recording {recording.name} has no truth; add state_groundtruth_estimate0/data.csv")
    T_world_body = recording.truth.interpolate(recording.frame_t_s[index]).T_world_body
    T_world_camera = T_world_body @ recording.calibration.T_body_camera
    T_i_j = se3.inverse(T_world_camera[:-1]) @ T_world_camera[1:]
    maps = [recording.depth_m(int(k)) for k in index]
    known = [shrunk_depth(depth, camera.height, camera.width) for depth in maps if depth is not None]
    depth_m = torch.from_numpy(np.stack(known))[:, None] if len(known) == len(maps) else None
    return Truth(torch.from_numpy(T_i_j), depth_m)


def shrunk_depth(depth_m: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Depth (H, W) at another size: area average of the inverse; 0 where any part of a pixel is unknown.

    The inverse, because that is what moves in the image, and because near things cover far ones.
    """
    known = depth_m > 0
    inverse = np.where(known, 1 / np.where(known, depth_m, 1), 0).astype(np.float32)
    size = (width, height)
    inverse = cv2.resize(inverse, size, interpolation=cv2.INTER_AREA)
    cover = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    whole = (cover > WHOLE) & (inverse > 1 / FARTHEST_M)
    return np.where(whole, 1 / np.where(whole, inverse, 1), 0).astype(np.float32)
