"""Trained weights as a `Predictor`, bound to the camera of one recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch

from learned.camera_rays import CameraBatch, camera_batch
from learned.depth_uncertainty import DepthUncertainty, depth_uncertainty_from_dict
from learned.errors import WeightsError
from learned.frozen import frozen
from learned.inference import estimate_pairs
from learned.methods import Method
from learned.pixel_signals import off_axis_angle, pixel_signals
from learned.predictor import PairPrediction
from learned.uncertainty import UncertaintyModel, uncertainty_from_dict
from learned.warping import to_z_depth
from learned.weights import Weights
from vio.camera import Camera
from vio.errors import CameraError, ImuError
from vio.recording import Recording

FOCAL_SLACK = 1.25
"""How far a focal length, at the network's size, may lie outside those trained on."""
SQUARE_SLACK = 1.1
"""How far the two focal lengths may differ at the network's size, as a ratio."""


@dataclass(frozen=True)
class NetworkPredictor:
    """A trained method that measures neighbouring frames of one camera; made by `predictor_for`."""

    weights: Weights
    camera: Camera
    """At the network's size."""
    uncertainty: UncertaintyModel
    device: torch.device
    depth_uncertainty: DepthUncertainty | None = None
    """Of the depth per pixel; None for weights whose depth was never calibrated."""
    baselines: tuple[int, ...] = (1,)

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) that frames are resized to."""
        return self.weights.method.config.image_size

    @property
    def imu_samples_per_item(self) -> int:
        """Samples in the window around a frame; 0 for a vision-only method."""
        config = self.weights.method.config
        return config.branch.samples if config.vibration else 0

    @property
    def imu_rate_hz(self) -> float:
        """Rate of those samples."""
        return 40.0

    @property
    def scale_log_mean(self) -> float:
        """Mean of ln(metres per motion unit) over the calibration recordings."""
        return float(self.weights.card["scale_log_mean"])

    @property
    def scale_log_sd(self) -> float:
        """Standard deviation of the same."""
        return float(self.weights.card["scale_log_sd"])

    @property
    def said_of_itself(self) -> dict[str, float]:
        """What the card says of the motions' errors beyond their covariances, for `meta` of the motions.

        `scale_gain_sd`: how far the scale of single steps is off that of the path, in log; `error_correlation_s`: how
        long errors of translation last. Absent where the card does not say.
        """
        card = self.weights.card
        return {key: float(card[key]) for key in ("scale_gain_sd", "error_correlation_s") if card.get(key) is not None}

    @property
    def card(self) -> Mapping[str, Any]:
        """Method, digest and origin of the weights."""
        card = self.weights.card
        return {"method": card["method"]["name"], "sha256": card["sha256"],
                "data": card.get("data", {}).get("summary", "unknown")}

    def predict(self, frames_i: torch.Tensor, frames_j: torch.Tensor, imu_windows: torch.Tensor) -> PairPrediction:
        """Motions of B pairs, with covariances, SNR and depth; see `learned.Predictor`."""
        frames = torch.stack([frames_i, frames_j], 1).to(self.device)
        windows = self._windows(imu_windows)
        wanted = self.uncertainty.signals
        estimate = estimate_pairs(self.network, frames, windows, self._cameras(len(frames)),
                                  self.weights.card["depth_kind"], wanted)
        cov = self.uncertainty.covariance(estimate.signals.cpu().double().numpy(), wanted)
        return PairPrediction(estimate.T_i_j.double(), torch.from_numpy(cov), estimate.snr, estimate.z_depth_i[:, 0])

    def depth(self, frames: torch.Tensor, imu_windows: torch.Tensor) -> torch.Tensor:
        """z-depth (B, H, W) of frames (B, 3, H, W) in motion units, without any motion; 0 where nothing is seen."""
        with torch.no_grad():
            out = self.network(frames[:, None].to(self.device), self._windows(imu_windows), depth_frames=(0,),
                                      pairs=())
        depth = out.depth[0].depth[0].float()
        return to_z_depth(depth, self._cameras(len(frames)), self.weights.card["depth_kind"])[:, 0]

    def log_depth_sd(self, frames: torch.Tensor, z_depth: torch.Tensor) -> torch.Tensor | None:
        """Standard deviation (B, H, W) of ln depth, once an image's scale is right; None for weights without it.

        Args:
            frames: (B, 3, H, W) in 0..1.
            z_depth: (B, H, W) what was predicted for them.
        """
        if self.depth_uncertainty is None:
            return None
        depth = z_depth.float().cpu()
        return self.depth_uncertainty.deviations(pixel_signals(frames.cpu(), depth, self._angle))

    @property
    def depth_uncertainty_card(self) -> Mapping[str, Any] | None:
        """What is needed beside `log_depth_sd`; see `learned.predictor.JudgesDepth`."""
        model = self.depth_uncertainty
        return None if model is None else {**model.intervals(), "signals": list(model.signals)}

    @cached_property
    def network(self) -> Method:
        """What is run: the weights' method, frozen."""
        return frozen(self.weights.method)

    @cached_property
    def _angle(self) -> torch.Tensor:
        return torch.from_numpy(off_axis_angle(self.camera))

    @cached_property
    def _camera_batches(self) -> dict[int, CameraBatch]:
        """By their number: rays of pixels are the same for every batch."""
        return {}

    def _windows(self, imu_windows: torch.Tensor) -> torch.Tensor | None:
        return imu_windows.transpose(1, 2).to(self.device) if self.imu_samples_per_item else None

    def _cameras(self, count: int) -> CameraBatch:
        if count not in self._camera_batches:
            self._camera_batches[count] = camera_batch([self.camera]).to(self.device).repeated(count)
        return self._camera_batches[count]


def predictor_for(recording: Recording, weights: Weights, device: str | None = None) -> NetworkPredictor:
    """Weights made ready for a recording: its camera brought to the network's size, intrinsics along with the images.

    Args:
        recording: whose frames will be shown.
        weights: from `learned.weights.load_weights`.
        device: "cpu" or "cuda"; None = cuda where there is one.

    Raises:
        CameraError: no camera, or one whose images would look too different from those trained on; says in what.
        ImuError: the weights look at vibration and the recording has no IMU log.
        WeightsError: the card's uncertainty model is broken, or was never fitted.
    """
    method, name = weights.method, weights.name
    if weights.card["uncertainty"] is None:
        raise WeightsError(f"weights {name}: their uncertainty was never calibrated; run `capsule-vio train` with "
                           "recordings that have truth")
    if method.config.vibration and len(recording.imu) < 2:
        raise ImuError(f"recording {recording.name}: {len(recording.imu)} inertial samples, but the weights {name} "
                       "look at vibration; add imu0/data.csv, give vision-only weights, or use --method classical")
    chosen = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    camera, of_depth = _fitting_camera(recording, weights), weights.card.get("depth_uncertainty")
    return NetworkPredictor(replace(weights, method=method.to(chosen)), camera,
                            uncertainty_from_dict(weights.card["uncertainty"]), chosen,
                            None if of_depth is None else depth_uncertainty_from_dict(of_depth))


def _fitting_camera(recording: Recording, weights: Weights) -> Camera:
    """The recording's camera at the network's size."""
    camera = recording.calibration.camera
    if camera is None:
        raise CameraError(f"recording {recording.name}: no camera is calibrated, and depth and motion depend on it; "
                          "add intrinsics to cam0/sensor.yaml")
    height, width = weights.method.config.image_size
    small = camera.resized(width, height)
    size = f"{camera.width} x {camera.height} pixels, at the network's {width} x {height}"
    if max(small.fx / small.fy, small.fy / small.fx) > SQUARE_SLACK:
        raise CameraError(f"recording {recording.name}: {size} the focal lengths are {small.fx:.0f} and "
                          f"{small.fy:.0f} (limit: a ratio of {SQUARE_SLACK:g}), so the image would be squeezed; crop "
                          "the frames to a square, or use --method classical")
    focal = weights.card.get("focal_px")
    if focal is not None:
        low, high = min(focal) / FOCAL_SLACK, max(focal) * FOCAL_SLACK
        if not low <= small.fx <= high:
            raise CameraError(f"recording {recording.name}: {size} the focal length is {small.fx:.0f} (limit: "
                              f"{low:.0f} to {high:.0f}, around what the weights {weights.name} were trained on); "
                              "train on such a camera, or use --method classical")
    return small
