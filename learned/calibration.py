"""From a trained run to weights that can be used: scale prior, uncertainty and measured figures, in a card.

This is the only place between training and prediction where truth is looked at, on recordings that were not trained on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from learned.aligned_calibration import aligned_section
from learned.dataset import frames_of_split
from learned.depth_calibration import depth_uncertainty_section
from learned.error_correlation import error_correlation_s
from learned.errors import TrainingError, WeightsError
from learned.evaluation import depth_score, motion_score, nees_of
from learned.inference import SIGNALS
from learned.measured import Measured, measure
from learned.scale_gain import scale_gain_sd
from learned.train_config import train_config_to_dict
from learned.training import TrainedRun
from learned.uncertainty import UncertaintyModel, choose_signals, fit_uncertainty, uncertainty_from_dict
from learned.weights import load_weights, rewrite_card, save_weights
from vio.recording import Recording

LEAST_PAIRS = 60
LEAST_SCALE_SD = 0.05
"""No simulator's scale is known better than this."""


def card_of(run: TrainedRun, trained_on: Sequence[Recording]) -> dict[str, Any]:
    """What is known of a run without looking at truth; nothing in it is calibrated yet."""
    cameras = [r.calibration.camera.resized(*run.config.method.image_size[::-1]) for r in trained_on
               if r.calibration.camera is not None]
    return {"depth_kind": run.config.depth_kind, "training": train_config_to_dict(run.config), "steps": run.step,
            "skipped_steps": run.skipped, "licence": "Apache-2.0", "truth_in_training": False,
            "data": _data(trained_on), "focal_px": [min(c.fx for c in cameras), max(c.fx for c in cameras)],
            "self_supervised_validation": run.validation, "uncertainty": None, "scale_log_mean": 0.0,
            "scale_log_sd": 1.0}


def write_calibrated(run: TrainedRun, trained_on: Sequence[Recording], calibrate_on: Sequence[Recording],
                     path: str | Path, history: Sequence[str] = ()) -> dict[str, Any]:
    """Write a run's weights, then calibrate what was written, and write the card.

    Args:
        run: from `learned.training.train`.
        trained_on: its recordings.
        calibrate_on: other recordings with truth; none = the validation part of those trained on.
        path: ends in .safetensors.
        history: what the run's start weights went through before, one line a stage.

    Returns:
        The card.

    Raises:
        TrainingError: too few pairs with truth to calibrate on.
        RecordingError, ImuError: recordings that cannot be measured.
        OutputError: the file cannot be written.
    """
    card = card_of(run, trained_on) | {"history": list(history)}
    save_weights(path, run.method, card)
    method = load_weights(path).method  # as rounded in the file
    measured = measured_parts(method, run, trained_on, calibrate_on)
    card |= calibrated(measured)
    card["calibrated_on"] = _data(calibrate_on) if calibrate_on else "the validation split of the training recordings"
    card["sha256"] = save_weights(path, method, card)
    return card


def measured_parts(method: Any, run: TrainedRun, trained_on: Sequence[Recording],
                   calibrate_on: Sequence[Recording]) -> list[Measured]:
    """Predictions beside truth for calibration."""
    if calibrate_on:
        return [measure(method, run.config.depth_kind, recording) for recording in calibrate_on]
    parts = [(r, *frames_of_split(len(r), "validation")) for r in trained_on if r.truth is not None]
    return [measure(method, run.config.depth_kind, r, first, end) for r, first, end in parts if end - first > 1]


def calibrated(measured: Sequence[Measured]) -> dict[str, Any]:
    """Scale prior, uncertainty model and figures from predictions beside truth.

    Raises:
        TrainingError: fewer than 60 pairs of recordings in which the camera moves.
    """
    used = [m for m in measured if np.isfinite(m.log_scale)]
    pairs = sum(len(m) for m in used)
    if pairs < LEAST_PAIRS:
        raise TrainingError(f"calibration: {pairs} pairs with truth in {len(used)} recordings that move (limit: at "
                            f"least {LEAST_PAIRS}); give more or longer recordings with truth")
    scales = np.array([m.log_scale for m in used])
    errors = np.concatenate([m.errors(m.log_scale) for m in used])
    signals = np.concatenate([m.signals for m in used])
    recording = np.concatenate([np.full(len(m), k) for k, m in enumerate(used)])
    chosen = choose_signals(errors, signals, SIGNALS, recording)
    model = fit_uncertainty(errors, signals, SIGNALS, chosen)
    spread = float(np.std(scales, ddof=1)) if len(scales) > 1 else 1.0
    depth, motion = depth_score([m.depth for m in used], used), motion_score([m.T_i_j for m in used], used)
    return {
        **depth_sections(used, model, float(np.mean(scales))),
        "scale_log_mean": float(np.mean(scales)), "scale_log_sd": max(spread, LEAST_SCALE_SD),
        "uncertainty": model.to_dict(),
        "scale_gain_sd": scale_gain_sd(used), "error_correlation_s": error_correlation_s(used, model),
        "calibration": {"pairs": pairs, "recordings": len(used), "nees": float(nees_of(used, model, SIGNALS).mean()),
                        "depth": None if depth is None else asdict(depth), "motion": asdict(motion)},
    }


def depth_sections(measured: Sequence[Measured], network: UncertaintyModel, scale_log_mean: float) -> dict[str, Any]:
    """The card's `depth_uncertainty` and `depth_aligned`; each None where recordings do not suffice.

    Args:
        measured: calibration recordings.
        network: covariances of the pose network.
        scale_log_mean: ln(metres per motion unit) of the prior.
    """
    return {"depth_uncertainty": depth_uncertainty_section(measured, scale_log_mean),
            "depth_aligned": aligned_section(measured, network)}


def extend_card(source: str | Path, path: str | Path, calibrate_on: Sequence[Recording]) -> dict[str, Any]:
    """Add `depth_uncertainty` and `depth_aligned` to the card of calibrated weights, without training.

    Args:
        source: weights whose motions are calibrated.
        path: where the same weights are written under the longer card, may be `source`.
        calibrate_on: recordings with truth and true depth that the weights were not trained on.

    Returns:
        The card.

    Raises:
        WeightsError: weights that cannot be read, or whose motions were never calibrated.
        TrainingError: recordings that do not suffice.
        RecordingError, ImuError: recordings that cannot be measured.
        OutputError: the file cannot be written.
    """
    weights = load_weights(source)
    if weights.card["uncertainty"] is None:
        raise WeightsError(f"weights {weights.name}: their motions were never calibrated; run `capsule-vio train` with "
                           "recordings that have truth")
    measured = [measure(weights.method, weights.card["depth_kind"], recording) for recording in calibrate_on]
    sections = depth_sections(measured, uncertainty_from_dict(weights.card["uncertainty"]),
                              float(weights.card["scale_log_mean"]))
    missing = [name for name, section in sections.items() if section is None]
    if missing:
        raise TrainingError(f"calibration: {len(measured)} recordings do not suffice for {' and '.join(missing)}; "
                            "give more or longer ones with true depth and texture")
    return rewrite_card(source, path, {**sections, "depth_calibrated_on": _data(calibrate_on)})


def _data(recordings: Sequence[Recording]) -> dict[str, Any]:
    """How many of what: origin, organs, vibrations, cameras, seeds."""
    found = [r.provenance for r in recordings]
    counts = {key: dict(sorted(Counter(str(p.get(key, "unknown")) for p in found).items()))
              for key in ("source", "organ", "vibration", "vibration_level", "driving")}
    cameras = Counter(f"{c.model} f={c.fx / c.width:.3f} w" for c in (r.calibration.camera for r in recordings)
                      if c is not None)
    frames = sum(len(r) for r in recordings)
    return {"summary": f"{len(recordings)} recordings, {frames} frames, {', '.join(counts['source'])}",
            "seeds": sorted(int(p["seed"]) for p in found if "seed" in p), "cameras": dict(sorted(cameras.items())),
            **counts}
