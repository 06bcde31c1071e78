"""From the options of `capsule-vio train` to a trained and, where there is truth, calibrated file of weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from learned.calibration import card_of, write_calibrated
from learned.distributed import leads
from learned.methods import method_config
from learned.train_config import (
    MEASURED_BRANCH,
    MEASURED_FUSION,
    MEASURED_LENGTHS,
    MEASURED_NEARNESS,
    TrainConfig,
    train_config,
)
from learned.training import train
from learned.weights import load_weights, save_weights
from vio.calibration import load_yaml
from vio.errors import ConfigError
from vio.recording import Recording
from vio.trajectory import Trajectory

WEIGHTS = "weights.safetensors"
DIRECT = ("loss", "steps", "batch_size", "seed", "workers", "patience")
"""Options that are decisions of `TrainConfig` under the same name."""


def run_training(recordings: Sequence[Recording], calibrate_on: Sequence[Recording], options: Mapping[str, Any],
                 progress: Callable[[int, int], None] | None = None,
                 taught_by: Sequence[Trajectory | None] | None = None) -> str:
    """Train, write `RUN/weights.safetensors`, and say what came of it in one line.

    Args:
        recordings: to train on.
        calibrate_on: with truth; none = the validation split of the recordings, where all have truth.
        options: of the command line, by name.
        progress: called with (steps done, steps in all).
        taught_by: refined trajectories of the recordings, None where there is none; their steps teach depth.

    Raises:
        VioError: options, recordings or a checkpoint that do not fit, see `learned.training.train`.
    """
    config = config_of(options, taught=taught_by is not None)
    start = None if options.get("start_from") is None else load_weights(options["start_from"]).method.state_dict()
    run = train(recordings, config, options["out"], device=options.get("device"), progress=progress, start_from=start,
                trajectories=taught_by)
    path = Path(options["out"]) / WEIGHTS
    done = f"{path}: {run.step} steps, validation loss {run.validation.get('loss', float('nan')):.4f}"
    if not leads():
        return done
    if not calibrate_on and any(recording.truth is None for recording in recordings):
        save_weights(path, run.method, card_of(run, recordings))
        return f"{done}; no truth, so not calibrated: give --calibrate REC before using them"
    card = write_calibrated(run, recordings, calibrate_on, path)
    return f"{done}; NEES {card['calibration']['nees']:.2f} over {card['calibration']['pairs']} calibration pairs"


def config_of(options: Mapping[str, Any], taught: bool = False) -> TrainConfig:
    """The decisions that the command line and its file of decisions make.

    Args:
        options: of the command line, by name.
        taught: refined trajectories are given; lengths come from them unless the file decides otherwise.

    Raises:
        ConfigError: an unknown decision, or a value outside its range.
    """
    name = options.get("method", "gyro-correlation")
    ours, size = name == "gyro-correlation", options.get("image_size")
    more: dict[str, Any] = {"image_size": tuple(size)} if size else {}
    method = method_config(name, vibration=not options.get("vision_only", False), width=options.get("width", 1.0),
                           fusion=options.get("fusion") or (MEASURED_FUSION if ours else "fourier"),
                           **more, **({"branch": MEASURED_BRANCH} if ours else {}))
    decided: dict[str, Any] = {}
    if options.get("config") is not None:
        decided = load_yaml(options["config"])
        if "method" in decided:
            raise ConfigError(f"{Path(options['config']).name}: the method is decided by --method and its options; "
                              "leave it out")
    if taught:
        decided = MEASURED_LENGTHS | decided
        if decided["length_from"] == "refined" and getattr(method, "whole_image", False):
            decided = {"nearness_weight": MEASURED_NEARNESS} | decided
    decided |= {key: options[key] for key in DIRECT if options.get(key) is not None}
    return train_config(method, **decided)
