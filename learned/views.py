"""Frames as they are compared across time: keypoints in the recorded image, distances from the predicted depth."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import torch

from learned.frames import resized_rgb
from learned.network_predictor import NetworkPredictor
from learned.windows import ImuWindows
from vio.errors import RecordingError
from vio.keypoints import find_keypoints
from vio.rays import rays_from_pixels
from vio.recording import Recording
from vio.revisit import View

HELD = 1000
"""Views kept in memory, half a megabyte each."""
LARGEST_PX = 480
"""Images wider or higher are made smaller first: finer detail does not last until a revisit."""
LEAST_FORWARD = 0.05
"""Forward component of a ray from which a z-depth says how far the point is."""


class Views:
    """Views of a recording's frames, made when asked for; the latest are kept.

    Args:
        recording: with images, a camera, and an IMU log if the weights look at vibration.
        predictor: weights ready for it.
    """

    def __init__(self, recording: Recording, predictor: NetworkPredictor) -> None:
        self._recording, self._predictor = recording, predictor
        self._windows = ImuWindows(recording.imu, recording.imu_t_s, recording.frame_t_s,
                                   predictor.imu_samples_per_item, predictor.imu_rate_hz)
        self._held: OrderedDict[int, View | None] = OrderedDict()

    def __getitem__(self, k: int) -> View | None:
        """The view of frame k; None where the frame cannot be read."""
        if k in self._held:
            self._held.move_to_end(k)
            return self._held[k]
        view = self._held[k] = self._made(k)
        if len(self._held) > HELD:
            self._held.popitem(last=False)
        return view

    def _made(self, k: int) -> View | None:
        try:
            image = self._recording.frame(k)
        except RecordingError:
            return None
        height, width = image.shape[:2]
        smaller = min(1.0, LARGEST_PX / max(height, width))
        size = (round(height * smaller), round(width * smaller))
        camera = self._recording.calibration.camera
        assert camera is not None  # `predictor_for` refuses a recording without one
        camera = camera.resized(size[1], size[0])
        keypoints = find_keypoints(resized_rgb(image, size))
        rays, valid = rays_from_pixels(camera, keypoints.pixel)
        keypoints, rays = keypoints.select(valid), rays.select(valid)
        z = self._depth_at(resized_rgb(image, self._predictor.image_size), k, keypoints.pixel, size)
        forward = rays.bearing[:, 2]
        known = np.isfinite(z) & (z > 0) & (forward > LEAST_FORWARD)
        return View(keypoints, rays, np.where(known, z, 0.0) / np.where(known, forward, 1.0), size[1])

    def _depth_at(self, image: np.ndarray, k: int, pixel: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """(K,) predicted z-depth at pixels of an image of the given (height, width)."""
        frames = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
        window = self._windows.at(self._recording.frame_t_s[[k]])
        with torch.inference_mode():
            depth = self._predictor.depth(frames, torch.from_numpy(window).float())[0].cpu().numpy()
        shape = np.array(depth.shape)
        row, column = np.round((pixel[:, ::-1] + 0.5) * shape / size - 0.5).astype(int).T
        return np.asarray(depth[row.clip(0, shape[0] - 1), column.clip(0, shape[1] - 1)], float)

