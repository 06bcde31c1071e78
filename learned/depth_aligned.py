"""Depth-aligned motions: tracked corners, lifted by predicted depth, laid over each other frame by frame.

A second source beside the pose network. It shares the depth network with it but not the pose network: KLT follows
corners from frame to frame, the predicted depth makes points of them, and `vio.depth_odometry` fits the rigid motion.
How far the corners and the depth are off, the scale, and the covariance given what a fit looks like are measured on
calibration recordings (`learned.aligned_calibration`) and come from the weights' card. Errors of depth are shared by
the points of a frame, which no residual shows: the fit's own covariance is far too small and serves as a signal only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from learned.errors import WeightsError
from learned.frames import resized_rgb
from learned.network_predictor import NetworkPredictor, predictor_for
from learned.uncertainty import UncertaintyModel, uncertainty_from_dict
from learned.weights import load_weights
from learned.windows import ImuWindows
from vio import se3
from vio.depth_odometry import DepthNoise, PairFits, fit_pairs
from vio.errors import ConfigError, RecordingError, TrackingError
from vio.motions import RelativeMotions
from vio.recording import Recording
from vio.tracking import TrackerSettings, track_images

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

TRACKING = TrackerSettings(corners=300, spacing_px=4.0, window_px=21, pyramid_levels=3, forward_backward_px=0.3)
"""For images of a network's size, about 130 pixels wide: of five settings, the best mean rotation and step on four
calibration recordings."""
ALIGNED_SIGNALS = ("rotation_sd", "translation_sd", "points", "length", "rotation", "distance")
"""Names of the signals, all as natural logarithms: the fit's own sds, number of points, step over their median
distance, rotation angle, median distance."""
LEAST = 1e-3
SECTION = "depth_aligned"


@dataclass(frozen=True)
class AlignedModel:
    """What calibration knows of depth-aligned motions."""

    noise: DepthNoise
    scale_log_mean: float
    """Mean of ln(metres per motion unit) of THESE motions: that of the depth, not of the pose network."""
    uncertainty: UncertaintyModel
    network_correlation: Mapping[str, Any]
    """Of its errors with the pose network's, both over their sds: "rotation", "translation", "per_axis" (6)."""

    def to_dict(self) -> dict[str, Any]:
        """In values that JSON can hold."""
        return {"pixel_px": self.noise.pixel_px, "depth_relative": self.noise.depth_relative,
                "scale_log_mean": self.scale_log_mean, "scale_log_sd": self.noise.scale_log_sd,
                "uncertainty": self.uncertainty.to_dict(), "network_correlation": dict(self.network_correlation)}


def aligned_model_from_dict(values: Mapping[str, Any]) -> AlignedModel:
    """What `to_dict` wrote; further keys are figures.

    Raises:
        WeightsError: a part is missing, of another kind, or not positive where it must be.
    """
    try:
        numbers = [float(values[key]) for key in ("pixel_px", "depth_relative", "scale_log_sd", "scale_log_mean")]
        correlation = dict(values["network_correlation"])
        uncertainty = values["uncertainty"]
    except (KeyError, TypeError, ValueError):
        raise WeightsError(f"weights: the card's {SECTION} is incomplete; calibrate again") from None
    if not np.isfinite(numbers).all() or min(numbers[:3]) <= 0:
        raise WeightsError(f"weights: the card's {SECTION} has noise {numbers}, must be finite and positive; calibrate "
                           "again")
    return AlignedModel(DepthNoise(*numbers[:3]), numbers[3], uncertainty_from_dict(uncertainty), correlation)


def aligned_signals(fits: PairFits) -> Array:
    """(N, S) the `ALIGNED_SIGNALS` of fits."""
    variance = np.diagonal(fits.cov, axis1=1, axis2=2)
    length = np.linalg.norm(fits.T_i_j[:, :3, 3], axis=1)
    rotation = np.linalg.norm(se3.so3_log(fits.T_i_j[:, :3, :3]), axis=1)
    return np.column_stack([
        0.5 * np.log(variance[:, :3].mean(axis=1)), 0.5 * np.log(variance[:, 3:].mean(axis=1)), np.log(fits.points),
        np.log(length / fits.middle + LEAST), np.log(rotation + LEAST), np.log(fits.middle)])


def depth_aligned_motions(recording: Recording, predictor: NetworkPredictor | str | Path | None = None, *,
                          batch_size: int = 8, progress: Progress | None = None) -> RelativeMotions:
    """Measure the camera's motion between neighbouring frames by tracks and predicted depth.

    Frames are read twice, once to be tracked and once to be shown to the depth network; one batch of maps is held.

    Args:
        recording: with images, camera, and an IMU log if the weights look at vibration.
        predictor: weights ready for this recording; a path = weights of `capsule-vio train`, None = those that come
            along.
        batch_size: frames per call of the network; changes speed, not results.
        progress: called with (frames shown, frames in all) after every batch.

    Returns:
        One motion per neighbouring pair that the points determine; others are left out and counted in
        `meta["pairs_left_out"]`. The motion unit is the depth's. `meta["network_correlation"]` says how the errors hang
        together with those of `learned.predict` by the same weights.

    Raises:
        WeightsError: weights that are missing, damaged, or not calibrated for this.
        CameraError, ImuError: a recording that the weights do not fit.
        RecordingError: fewer than two frames, or an image that is absent or cannot be read.
        TrackingError: no pair of frames shares enough points with depth.
        ConfigError: a batch size below 1.
    """
    if batch_size < 1:
        raise ConfigError(f"batch_size is {batch_size}, must be at least 1")
    if not isinstance(predictor, NetworkPredictor):
        predictor = predictor_for(recording, load_weights(predictor))
    if len(recording) < 2 or not recording.has_any_image:
        raise RecordingError(f"recording {recording.name}: {len(recording)} frame(s), images "
                             f"{'there' if recording.has_any_image else 'missing'}; depth-aligned motions need two "
                             "frames and all images")
    model = _model(predictor)
    frames = (resized_rgb(recording.frame(k), predictor.image_size) for k in range(len(recording)))
    tracks = track_images(frames, TRACKING)
    maps = _depth_maps(recording, predictor, batch_size, progress)
    fits = fit_pairs(tracks, predictor.camera, lambda k: next(maps), model.noise)
    if len(fits.frame) == 0:
        raise TrackingError(f"recording {recording.name}: no two of {len(recording)} frames share three points with "
                            "depth that determine a motion; use --method learned")
    t, k = recording.frame_t_s, fits.frame
    meta = {"source": "learned", "method": "depth-aligned: tracks and predicted depth, 3D-3D", "rotation": "network",
            "predictor": dict(predictor.card), "pairs_left_out": len(recording) - 1 - len(k),
            "network_correlation": dict(model.network_correlation)}
    return RelativeMotions(t[k], t[k + 1], fits.T_i_j,
                           model.uncertainty.covariance(aligned_signals(fits), ALIGNED_SIGNALS),
                           model.scale_log_mean, model.noise.scale_log_sd, meta=meta)


def _model(predictor: NetworkPredictor) -> AlignedModel:
    values = predictor.weights.card.get(SECTION)
    if values is None:
        raise WeightsError(f"weights {predictor.weights.name}: never calibrated for depth-aligned motions (no "
                           f"{SECTION} in the card); extend the card by `learned.calibration.extend_card`, or use "
                           "--method learned")
    return aligned_model_from_dict(values)


def _depth_maps(recording: Recording, predictor: NetworkPredictor, batch_size: int, progress: Progress | None
                ) -> Iterator[NDArray[np.float32]]:
    """Predicted z-depth (H, W) of every frame, in order, motion units."""
    t = recording.frame_t_s
    windows = ImuWindows(recording.imu, recording.imu_t_s, t, predictor.imu_samples_per_item, predictor.imu_rate_hz)
    for start in range(0, len(recording), batch_size):
        index = np.arange(start, min(start + batch_size, len(recording)))
        images = np.stack([resized_rgb(recording.frame(int(k)), predictor.image_size) for k in index])
        frames = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255
        with torch.inference_mode():
            depth = predictor.depth(frames, torch.from_numpy(windows.at(t[index])).float())
        if progress is not None:
            progress(int(index[-1]) + 1, len(recording))
        yield from depth.cpu().numpy()
