"""The contract of whatever measures motion from images: frames in pairs go in, motions come out.

A network with its weights fulfils it, and so does a function of ten lines in a test: there is nothing to inherit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch


@dataclass(frozen=True)
class PairPrediction:
    """What a predictor says about B pairs of frames."""

    T_i_j: torch.Tensor
    """(B, 4, 4) pose of the camera at j in the camera at i, translation in motion units."""
    cov: torch.Tensor
    """(B, 6, 6) right-perturbation covariance, rotation first, rad and motion units."""
    snr: torch.Tensor | None = None
    """(B,) vibration signal-to-noise ratio at frame i."""
    depth_i: torch.Tensor | None = None
    """(B, h, w) z-depth of frame i in motion units; not finite or not positive where unknown."""


class Predictor(Protocol):
    """Anything that turns pairs of frames into motions; a network with its weights, usually."""

    @property
    def baselines(self) -> tuple[int, ...]:
        """Distances j - i of the pairs to measure, in frames; `(1,)` = neighbours only."""

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(height, width) that frames are resized to; None = as recorded."""

    @property
    def imu_samples_per_item(self) -> int:
        """Samples in the IMU window around frame i; 0 = none needed."""

    @property
    def imu_rate_hz(self) -> float:
        """Rate of those samples."""

    @property
    def scale_log_mean(self) -> float:
        """Mean of ln(metres per motion unit), known from training."""

    @property
    def scale_log_sd(self) -> float:
        """Standard deviation of ln(metres per motion unit)."""

    @property
    def card(self) -> Mapping[str, Any]:
        """What it is (method, sha256 of the weights, training data), in values that JSON can hold."""

    def predict(
        self, frames_i: torch.Tensor, frames_j: torch.Tensor, imu_windows: torch.Tensor
    ) -> PairPrediction:
        """Motions of B pairs.

        Args:
            frames_i: (B, 3, H, W) float32 in 0..1, channels R, G, B; on the CPU.
            frames_j: (B, 3, H, W) the later frames.
            imu_windows: (B, n, 6) float32, gyro [rad/s] then specific force [m/s²], centred at frames i.
        """


@runtime_checkable
class JudgesDepth(Protocol):
    """A `Predictor` that also says how wrong its depth is; asked only when depth maps are written."""

    @property
    def depth_uncertainty_card(self) -> Mapping[str, Any] | None:
        """None where it cannot say. Otherwise `interval_95` (half-width over sd, at the image's own scale),
        `common_log_sd` (of a whole image at the prior scale), `prior_interval_95` (over both together) and, where it
        is known, `image_log_sd` (of a whole image at the true scale of the recording's motions)."""

    def log_depth_sd(self, frames: torch.Tensor, z_depth: torch.Tensor) -> torch.Tensor | None:
        """Standard deviation (B, h, w) of ln depth, pixel by pixel, once an image's scale is right.

        Args:
            frames: (B, 3, H, W) float32 in 0..1.
            z_depth: (B, h, w) what `predict` said of them.
        """
