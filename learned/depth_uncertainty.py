"""How wrong a predicted depth is, per pixel: a standard deviation of its logarithm.

The error of a depth map has two parts. One is shared by the whole image, its scale: part of that is the scale of the
recording's motions, which depth follows and an IMU can measure, part is the image's own. The other differs from pixel
to pixel; its ln sd is linear in a few `PIXEL_SIGNALS`, fitted by Gaussian maximum likelihood to calibration
recordings, so that sd² is the mean square of the error. Errors have heavier tails than a Gaussian, so the factor from
sd to the 95 % interval is measured too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learned.errors import TrainingError, WeightsError
from learned.pixel_signals import PIXEL_SIGNALS
from learned.uncertainty import FARTHEST, fit_log_sd, standardised

Array = NDArray[np.float64]

WORTH = 0.005
"""Gain in log likelihood per pixel, on recordings left out, that one more signal has to bring."""
FOLDS = 5
LEVEL = 0.95


@dataclass(frozen=True)
class DepthUncertainty:
    """Pixel signals → standard deviation of ln depth.

    Raises:
        WeightsError: parts that do not fit together.
    """

    signals: tuple[str, ...]
    """Names of the signals it reads."""
    mean: Array
    """(S,) of the signals over the calibration pixels."""
    sd: Array
    """(S,) of the same."""
    log_sd: Array
    """(1 + S,) constant and coefficients of ln sd, once the image's scale is right."""
    interval_95: float
    """Half-width of the 95 % interval over sd, once the image's scale is right."""
    common_log_sd: float
    """Root mean square of what a whole image is off at the prior scale; its pixels share it, averaging keeps it."""
    prior_interval_95: float
    """Half-width of the 95 % interval at the prior scale over `sqrt(sd² + common_log_sd²)`."""
    image_log_sd: float | None = None
    """Root mean square of what a whole image is off once the scale of its recording's motions is right: what remains
    of `common_log_sd` where the scale was measured. None in cards that were calibrated before it was."""

    def __post_init__(self) -> None:
        count = len(self.signals)
        single = [self.interval_95, self.common_log_sd, self.prior_interval_95]
        single += [] if self.image_log_sd is None else [self.image_log_sd]
        numbers = np.concatenate([np.ravel(self.mean), np.ravel(self.sd), np.ravel(self.log_sd), single])
        shapes = (self.mean.shape, self.sd.shape, self.log_sd.shape)
        positive = min(*single, *self.sd) > 0
        unknown = set(self.signals) - set(PIXEL_SIGNALS)
        if shapes != ((count,), (count,), (1 + count,)) or unknown or not np.isfinite(numbers).all() or not positive:
            raise WeightsError(f"weights: the depth uncertainty for signals {', '.join(self.signals) or 'none'} has "
                               f"parts of shapes {shapes}, unknown signals, or values that are not finite and "
                               "positive; calibrate again")

    def deviations(self, signals: Tensor) -> Tensor:
        """(B, H, W) sd of ln depth for all `PIXEL_SIGNALS` (B, S, H, W)."""
        total = torch.full_like(signals[:, 0], float(self.log_sd[0]))
        for name, mean, sd, weight in zip(self.signals, self.mean, self.sd, self.log_sd[1:], strict=True):
            column = (signals[:, PIXEL_SIGNALS.index(name)] - float(mean)) / float(sd)
            total = total + float(weight) * column.clamp(-FARTHEST, FARTHEST)
        return total.exp()

    def of_rows(self, signals: Array) -> Array:
        """(N,) the same for rows (N, S) of all signals."""
        return np.asarray(np.exp(standardised(_columns(signals, self.signals), self.mean, self.sd) @ self.log_sd))

    def with_prior(self, sd: Array) -> Array:
        """Standard deviations at the prior scale."""
        return np.asarray(np.hypot(sd, self.common_log_sd))

    def to_dict(self) -> dict[str, Any]:
        """In values that JSON can hold."""
        return {"signals": list(self.signals), "mean": self.mean.tolist(), "sd": self.sd.tolist(),
                "log_sd": self.log_sd.tolist(), **self.intervals()}

    def intervals(self) -> dict[str, float]:
        """What whoever reads sd maps needs beside them; `image_log_sd` only where it is known."""
        known = {} if self.image_log_sd is None else {"image_log_sd": self.image_log_sd}
        return {"interval_95": self.interval_95, "common_log_sd": self.common_log_sd,
                "prior_interval_95": self.prior_interval_95, **known}


def depth_uncertainty_from_dict(values: Mapping[str, Any]) -> DepthUncertainty:
    """What `to_dict` wrote; further keys are figures.

    Raises:
        WeightsError: a part is missing or has another shape.
    """
    try:
        mean, sd, log_sd = (np.array(values[key], float) for key in ("mean", "sd", "log_sd"))
        return DepthUncertainty(tuple(values["signals"]), mean, sd, log_sd, float(values["interval_95"]),
                                float(values["common_log_sd"]), float(values["prior_interval_95"]),
                                float(values["image_log_sd"]) if "image_log_sd" in values else None)
    except (KeyError, TypeError, ValueError):
        raise WeightsError("weights: the card's depth uncertainty is incomplete; calibrate again") from None


@dataclass(frozen=True)
class PixelErrors:
    """P pixels of calibration images."""

    error: Array
    """(P,) ln(true / predicted) once the image's scale is right."""
    common: Array
    """(P,) ln of the image's scale over the prior's."""
    image: Array
    """(P,) ln of the image's scale over that of its recording's motions; NaN where nothing moved."""
    signals: Array
    """(P, S) all `PIXEL_SIGNALS`."""
    recording: NDArray[np.int64]
    """(P,) number of the recording."""

    def part(self, mask: NDArray[np.bool_]) -> PixelErrors:
        """Some of the pixels."""
        return PixelErrors(self.error[mask], self.common[mask], self.image[mask], self.signals[mask],
                           self.recording[mask])


def fit_depth_uncertainty(pixels: PixelErrors, chosen: Sequence[str]) -> DepthUncertainty:
    """The model that explains the errors best.

    Args:
        pixels: of calibration images.
        chosen: signals to use; none gives one sd for all.

    Raises:
        TrainingError: no pixels, or errors that are all zero.
    """
    if len(pixels.error) == 0 or not np.any(pixels.error):
        raise TrainingError(f"depth uncertainty: {len(pixels.error)} pixels with errors; give recordings with true "
                            "depth that were not made by the predictor")
    columns = _columns(pixels.signals, chosen)
    mean, spread = columns.mean(axis=0), np.maximum(columns.std(axis=0), 1e-6)
    design = standardised(columns, mean, spread)
    log_sd = fit_log_sd(np.abs(pixels.error[:, None]), design)
    sd, common = np.exp(design @ log_sd), float(np.sqrt(np.mean(pixels.common**2)))
    whole = np.abs(pixels.error + pixels.common) / np.hypot(sd, common)
    factors = np.quantile(np.abs(pixels.error) / sd, LEVEL), np.quantile(whole, LEVEL)
    image = pixels.image[np.isfinite(pixels.image)]
    return DepthUncertainty(tuple(chosen), mean, spread, log_sd, float(factors[0]), max(common, 1e-6),
                            float(factors[1]), max(float(np.sqrt(np.mean(image**2))), 1e-6) if len(image) else None)


def choose_pixel_signals(pixels: PixelErrors) -> tuple[list[str], dict[str, float]]:
    """Signals that pay on recordings left out of the fit, best first (greedy), and the gain of each one alone.

    With fewer than two recordings nothing can be left out, and none is chosen.
    """
    chosen: list[str] = []
    none = best = left_out_likelihood(pixels, chosen)
    alone: dict[str, float] = {}
    while np.isfinite(best) and len(chosen) < len(PIXEL_SIGNALS):
        scores = {name: left_out_likelihood(pixels, [*chosen, name]) for name in PIXEL_SIGNALS if name not in chosen}
        alone = alone or {name: score - none for name, score in scores.items()}
        name = max(scores, key=lambda key: scores[key])
        if scores[name] < best + WORTH:
            break
        chosen, best = [*chosen, name], scores[name]
    return chosen, alone


def left_out_likelihood(pixels: PixelErrors, chosen: Sequence[str]) -> float:
    """Mean Gaussian log likelihood per pixel, without the constant, on recordings left out of the fit."""
    numbers, scores = np.unique(pixels.recording), []
    if len(numbers) < 2:
        return -np.inf
    for fold in range(min(FOLDS, len(numbers))):
        out = np.isin(pixels.recording, numbers[fold::FOLDS])
        sd = fit_depth_uncertainty(pixels.part(~out), chosen).of_rows(pixels.signals[out])
        scores.append(np.sum(-np.log(sd) - 0.5 * (pixels.error[out] / sd) ** 2))
    return float(np.sum(scores) / len(pixels.error))


def _columns(signals: Array, names: Sequence[str]) -> Array:
    return np.asarray(signals, float)[:, [PIXEL_SIGNALS.index(name) for name in names]]
