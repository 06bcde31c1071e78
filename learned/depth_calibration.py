"""Depth beside truth: from predicted maps to the depth uncertainty of a card, and how often its intervals hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from learned.depth_uncertainty import (
    FOLDS,
    DepthUncertainty,
    PixelErrors,
    choose_pixel_signals,
    fit_depth_uncertainty,
)
from learned.measured import BATCH, Measured
from learned.pixel_signals import PIXEL_SIGNALS, off_axis_angle, pixel_signals

Array = NDArray[np.float64]

PIXELS_PER_IMAGE = 100
"""Neighbouring pixels err alike: more of an image say little more."""
LEAST_PIXELS = 5000
"""With true depth, to fit a model to."""
SEED = 0
Z_95 = 1.959964


@dataclass(frozen=True)
class DepthCoverage:
    """How honest standard deviations of ln depth are, over all pixels with known truth."""

    image: float
    """Share of pixels within the 95 % interval once every image has its median scale."""
    image_gaussian: float
    """The same with ±1.96 sd."""
    prior: float
    """Share within the 95 % interval of the metric depth as it is written, at the prior scale."""
    rms_over_sd: float
    """Root mean square of error over sd at the image's scale: 1 when sd is what it says."""
    best_tenth: float
    """Root mean square error of the tenth of the pixels that sd trusts most."""
    worst_tenth: float
    """The same of the tenth that it trusts least."""
    recordings: tuple[float, ...]
    """`image`, recording by recording."""


def depth_uncertainty_section(measured: Sequence[Measured], scale_log_mean: float) -> dict[str, Any] | None:
    """The card's `depth_uncertainty`: the model, and figures of how it was chosen; None with too little true depth.

    Args:
        measured: calibration recordings.
        scale_log_mean: ln(metres per motion unit) of the prior.
    """
    pixels = pixel_errors(measured, scale_log_mean, np.random.default_rng(SEED))
    if len(pixels.error) < LEAST_PIXELS:
        return None
    chosen, alone = choose_pixel_signals(pixels)
    model = fit_depth_uncertainty(pixels, chosen)
    return {**model.to_dict(), "pixels": len(pixels.error), "recordings": len(np.unique(pixels.recording)),
            "gain_alone": {name: round(gain, 4) for name, gain in alone.items()},
            "left_out_coverage": _left_out_coverage(pixels, chosen)}


def pixel_errors(measured: Sequence[Measured], scale_log_mean: float, rng: np.random.Generator | None,
                 ) -> PixelErrors:
    """Errors and signals of pixels with known truth that the lens reaches.

    Args:
        measured: recordings; those without true depth give no pixels.
        scale_log_mean: ln(metres per motion unit) of the prior.
        rng: draws `PIXELS_PER_IMAGE` of every image; None takes all.
    """
    error, common, image, rows = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)], [np.zeros((0, len(PIXEL_SIGNALS)))]
    number: list[NDArray[np.int64]] = []
    for r, m in enumerate(measured):
        if m.depth_true_m is None:
            continue
        for k, signals in enumerate(_signals(m)):
            index = np.flatnonzero((m.depth_true_m[k] > 0) & m.usable & (m.depth[k] > 0))
            if len(index) == 0:
                continue
            off = np.log(m.depth_true_m[k].ravel()[index] / m.depth[k].ravel()[index].astype(float))
            scale = float(np.log(np.median(m.depth_true_m[k].ravel()[index]) / np.median(m.depth[k].ravel()[index])))
            taken = np.arange(len(index))
            if rng is not None and len(index) > PIXELS_PER_IMAGE:
                taken = np.sort(rng.choice(len(index), PIXELS_PER_IMAGE, replace=False))
            error.append(off[taken] - scale)
            common.append(np.full(len(taken), scale - scale_log_mean))
            image.append(np.full(len(taken), scale - m.log_scale))
            rows.append(signals.reshape(len(PIXEL_SIGNALS), -1)[:, index[taken]].T.astype(float))
            number.append(np.full(len(taken), r, np.int64))
    return PixelErrors(np.concatenate(error), np.concatenate(common), np.concatenate(image), np.concatenate(rows),
                       np.concatenate(number) if number else np.zeros(0, np.int64))


def depth_coverage(measured: Sequence[Measured], model: DepthUncertainty, scale_log_mean: float
                   ) -> DepthCoverage | None:
    """How often the intervals of a model hold on recordings; None without true depth."""
    parts = []
    for m in measured:  # one recording at a time: only three numbers a pixel are kept
        pixels = pixel_errors([m], scale_log_mean, None)
        if len(pixels.error):
            parts.append((pixels.error, pixels.common, model.of_rows(pixels.signals)))
    if not parts:
        return None
    recordings = tuple(float(np.mean(np.abs(e) <= model.interval_95 * sd)) for e, _, sd in parts)
    error, common, sd = (np.concatenate(column) for column in zip(*parts, strict=True))
    order, tenth = np.argsort(sd, kind="stable"), max(1, len(sd) // 10)
    return DepthCoverage(
        image=float(np.mean(np.abs(error) <= model.interval_95 * sd)),
        image_gaussian=float(np.mean(np.abs(error) <= Z_95 * sd)),
        prior=float(np.mean(np.abs(error + common) <= model.prior_interval_95 * model.with_prior(sd))),
        rms_over_sd=_rms(error / sd), best_tenth=_rms(error[order[:tenth]]), worst_tenth=_rms(error[order[-tenth:]]),
        recordings=recordings)


def _signals(m: Measured) -> list[NDArray[np.float32]]:
    """(S, H, W) of every image."""
    angle = torch.from_numpy(off_axis_angle(m.camera))
    out: list[NDArray[np.float32]] = []
    for start in range(0, len(m), BATCH):
        frames = torch.from_numpy(m.images[start : start + BATCH]).permute(0, 3, 1, 2).float() / 255
        out += list(pixel_signals(frames, torch.from_numpy(m.depth[start : start + BATCH]), angle).numpy())
    return out


def _left_out_coverage(pixels: PixelErrors, chosen: Sequence[str]) -> float | None:
    """Share of pixels within the 95 % interval of a model fitted to other recordings; None where there are none."""
    numbers, inside = np.unique(pixels.recording), []
    if len(numbers) < 2:
        return None
    for fold in range(min(FOLDS, len(numbers))):
        out = np.isin(pixels.recording, numbers[fold::FOLDS])
        model, rest = fit_depth_uncertainty(pixels.part(~out), chosen), pixels.part(out)
        inside.append(np.abs(rest.error) <= model.interval_95 * model.of_rows(rest.signals))
    return float(np.mean(np.concatenate(inside)))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
