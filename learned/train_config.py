"""Every decision of a training run, and the recipes: the paper's for the four methods, the measured one for our own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, get_args

from learned.methods import CONFIGS, FusionConfig, MethodConfig, config_from_dict, config_to_dict, method_config
from learned.warping import DepthKind
from vio.errors import ConfigError

Schedule = Literal["constant", "cosine"]
LossKind = Literal["native", "paper"]
RotationFrom = Literal["gyro", "network"]
LengthFrom = Literal["refined", "network"]
Precision = Literal["float32", "bfloat16"]

BOOKKEEPING = ("steps", "workers", "preload", "log_every", "validate_every", "validation_batches", "checkpoint_every",
               "keep_every", "patience")
"""Decisions that a resumed run may change: none of them changes what a step does, except that `steps` bends the
schedule from where the run stands."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """One training run.

    Raises:
        ConfigError: a value outside its range.
    """

    method: MethodConfig
    loss: LossKind = "native"
    """The method's own loss, or the paper's L_p, L_s, L_g for any method."""
    steps: int = 10_000
    """Optimiser steps in all."""
    batch_size: int = 4
    """Triplets per process."""
    learning_rate: float = 1e-4
    """Of Adam."""
    warm_up_steps: int = 0
    schedule: Schedule = "constant"
    final_rate: float = 0.03
    """Share of the learning rate that a cosine ends with."""
    clip_norm: float = 0.0
    """Largest norm of the gradient; 0 = any."""
    ema_decay: float = 0.0
    """Of the running mean of the weights, which is what gets validated and shipped; 0 = the weights themselves."""
    rotation_from: RotationFrom = "network"
    """Whose rotation warps the images."""
    tied_motions: bool = False
    """Warp both directions of a pair by one motion, the mean of the two that the network tells. Told apart, each takes
    the scale of its own target's depth, and nothing but L_g holds the depths of two frames together: measured, every
    image's median depth came out as one unit, however near the wall."""
    rotation_weight: float = 0.0
    """Of the network's rotation's L1 distance from the gyro's."""
    unit_depth_weight: float = 0.0
    """Of (mean log depth)², which keeps depth off the ends of its range."""
    length_from: LengthFrom = "network"
    """Whose step lengths warp the images; "refined" needs trajectories beside the recordings. Without it nothing holds
    the depths of distant frames together."""
    length_unit_m: float = 0.02
    """Metres that one motion unit stands for where lengths are refined."""
    length_weight: float = 0.0
    """Of the distance of the network's log step lengths from the refined ones."""
    nearness_weight: float = 0.0
    """Of how far the number per image that tells nearness is from what a search with steps of known length finds."""
    light_start_steps: int = 0
    """Steps over which a pull of depth towards luminance^-1/2 fades out."""
    depth_kind: DepthKind = "z"
    """What the depth network's numbers mean: along the optical axis, or along the ray, which suits a fisheye."""
    frame_step: int = 1
    """Frames from one frame of a triplet to the next."""
    seed: int = 0
    """Of the weights, the order of the data, augmentation and dropout."""
    precision: Precision = "float32"
    """bfloat16: networks under autocast; losses stay in float32."""
    channels_last: bool = False
    freeze_batch_norm: bool = False
    """Normalise by the running statistics that the start weights bring, so that training sees what use will see. With
    two triplets a process, steps were seen two to three times shorter in use than in training."""
    augment: bool = True
    """Mirror and turn the items."""
    workers: int = 0
    """Processes that load data."""
    preload: bool = True
    """Hold all frames in memory at the network's size."""
    log_every: int = 20
    validate_every: int = 500
    validation_batches: int = 50
    """Batches of the validation split per validation, at most."""
    checkpoint_every: int = 250
    keep_every: int = 0
    """Keep the averaged weights every so many steps as a file of their own; 0 = the last only."""
    patience: int = 0
    """Stop after so many validations without a better loss; 0 = never."""

    def __post_init__(self) -> None:
        for name, kind in (("loss", LossKind), ("schedule", Schedule), ("rotation_from", RotationFrom),
                           ("length_from", LengthFrom), ("precision", Precision), ("depth_kind", DepthKind)):
            if getattr(self, name) not in get_args(kind):
                raise ConfigError(f"training: {name} {getattr(self, name)!r} is unknown, choose one of "
                                  f"{', '.join(get_args(kind))}")
        for name in ("steps", "batch_size", "log_every", "validate_every", "validation_batches", "checkpoint_every",
                     "frame_step"):
            if getattr(self, name) < 1:
                raise ConfigError(f"training: {name} is {getattr(self, name)}, must be at least 1")
        for name in ("warm_up_steps", "clip_norm", "rotation_weight", "unit_depth_weight", "light_start_steps",
                     "workers", "keep_every", "patience", "seed", "length_weight", "nearness_weight"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"training: {name} is {getattr(self, name)}, must not be negative")
        if not self.length_unit_m > 0:
            raise ConfigError(f"training: length_unit_m is {self.length_unit_m:g}, must be positive")
        if not (self.learning_rate > 0 and 0 <= self.ema_decay < 1 and 0 <= self.final_rate <= 1):
            raise ConfigError(f"training: learning_rate {self.learning_rate:g}, ema_decay {self.ema_decay:g}, "
                              f"final_rate {self.final_rate:g}; need > 0, in [0, 1) and in [0, 1]")

    @property
    def needs_lengths(self) -> bool:
        """Whether some recording must come with a refined trajectory."""
        return self.length_from == "refined" or self.length_weight > 0

    @property
    def needs_imu(self) -> bool:
        """Whether items must carry inertial samples."""
        return self.method.vibration or self.rotation_from == "gyro" or self.rotation_weight > 0


PAPER_RECIPE: dict[str, Any] = {}
"""Adam 1e-4, batch 4: the defaults."""
MEASURED_RECIPE: dict[str, Any] = {
    "learning_rate": 1e-3, "warm_up_steps": 50, "schedule": "cosine", "clip_norm": 1.0, "ema_decay": 0.995,
    "rotation_from": "gyro", "tied_motions": True, "rotation_weight": 1.0, "unit_depth_weight": 0.2,
    "light_start_steps": 150, "depth_kind": "range", "precision": "bfloat16", "channels_last": True,
}
"""What was measured to train our own method within minutes: ten times the paper's rate, the gyro in the warp. With
fewer than four triplets a process, consider `freeze_batch_norm` once there are weights to start from."""
MEASURED_LENGTHS: dict[str, Any] = {"length_from": "refined", "length_weight": 0.1, "unit_depth_weight": 0.0}
"""Where refined trajectories are given: lengths then keep depth off the ends of its range."""
MEASURED_NEARNESS = 0.1
"""`nearness_weight` with them, for a network that tells nearness by a number. At 0.5 its gradient outweighed all others
tenfold, and depth became rough."""
MEASURED_FUSION = FusionConfig("fourier", snr_start=4.0, snr_floor=1.0)
"""SNR from where the gain's slope is 0.04 (at 100 it was measured not to learn at all), and never below 1: in one run
without that floor the last block of the pose network, which no batch norm follows, fell to 0.1 within 200 steps, with a
loss that looked normal. With the floor it went to the floor in one run and stayed above 2 in another."""
MEASURED_BRANCH = {"dropout": 0.0}
"""The article's dropout of 0.8 makes every SNR jump from step to step, and differ between training and use."""


def train_config(method: str | MethodConfig, **options: Any) -> TrainConfig:
    """The recipe of a method, with some decisions changed.

    Args:
        method: by name (with vibration, Fourier fusion), or its config.
        options: fields of `TrainConfig`.

    Raises:
        ConfigError: an unknown method or option, or a value outside its range.
    """
    ours = (method if isinstance(method, str) else method.name) == "gyro-correlation"
    if isinstance(method, str):
        method = (method_config(method, fusion=MEASURED_FUSION, branch=MEASURED_BRANCH) if ours
                  else method_config(method))
    known = {f.name for f in fields(TrainConfig)}
    unknown = sorted(set(options) - known)
    if unknown:
        raise ConfigError(f"training: unknown option {unknown[0]!r}, choose from {', '.join(sorted(known))}")
    return TrainConfig(method=method, **(MEASURED_RECIPE if ours else PAPER_RECIPE) | options)


def train_config_to_dict(config: TrainConfig) -> dict[str, Any]:
    """The decisions in values that JSON can hold."""
    return asdict(replace(config, method=config.method)) | {"method": config_to_dict(config.method)}


def train_config_from_dict(values: Mapping[str, Any]) -> TrainConfig:
    """What `train_config_to_dict` wrote.

    Raises:
        ConfigError: an unknown key or method, or a value outside its range.
    """
    rest = {name: value for name, value in values.items() if name != "method"}
    unknown = sorted(set(rest) - {f.name for f in fields(TrainConfig)})
    if unknown:
        raise ConfigError(f"training: unknown key {unknown[0]!r}")
    return TrainConfig(method=config_from_dict(values.get("method", {}), CONFIGS), **rest)


def different_decisions(one: TrainConfig, other: TrainConfig) -> list[str]:
    """Names of the decisions, bookkeeping aside, in which two runs differ."""
    a, b = train_config_to_dict(one), train_config_to_dict(other)
    return [name for name in a if name not in BOOKKEEPING and a[name] != b[name]]
