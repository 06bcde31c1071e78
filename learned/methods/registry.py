"""Methods by name."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from learned.methods import af_sfmlearner, endodac, endosfmlearner, gyro_correlation, ra_depth
from learned.methods.config import MethodConfig, config_from_dict
from learned.methods.method import Method, Networks
from learned.vibration_fusion import FusionConfig
from vio.errors import ConfigError

CONFIGS: dict[str, type[MethodConfig]] = {kind.name: kind for kind in (
    endosfmlearner.EndoSfMLearnerConfig, af_sfmlearner.AfSfMLearnerConfig, ra_depth.RaDepthConfig,
    endodac.EndoDacConfig, gyro_correlation.GyroCorrelationConfig,
)}
"""Config class by method name."""

BUILDERS: dict[str, Callable[..., Networks]] = {
    "endosfmlearner": endosfmlearner.networks, "af-sfmlearner": af_sfmlearner.networks, "ra-depth": ra_depth.networks,
    "endodac": endodac.networks, "gyro-correlation": gyro_correlation.networks,
}
"""Vision networks by method name."""


def method_config(
    name: str, *, vibration: bool = True, fusion: str | FusionConfig = "fourier", width: float = 1.0, **options: Any
) -> MethodConfig:
    """A method's decisions, its own defaults where nothing is said.

    Args:
        name: endosfmlearner, af-sfmlearner, ra-depth, endodac or gyro-correlation.
        vibration: with branch and fusion.
        fusion: strategy by name, or with its open choices decided.
        width: factor on the channels.
        options: other fields of the method's config, parts of it as dictionaries.

    Raises:
        ConfigError: an unknown method, strategy or option, or a value outside its range.
    """
    config = config_from_dict({"name": name, "vibration": vibration, "width": width, **options}, CONFIGS)
    return replace(config, fusion=FusionConfig(fusion) if isinstance(fusion, str) else fusion)


def build_method(
    name: str,
    *,
    vibration: bool = True,
    fusion: str | FusionConfig = "fourier",
    width: float = 1.0,
    seed: int = 0,
    encoder_weights: str | Path | None = None,
    pose_encoder_weights: str | Path | None = None,
    **options: Any,
) -> Method:
    """A method with freshly initialised networks; arguments as in `method_config` and `assemble`."""
    config = method_config(name, vibration=vibration, fusion=fusion, width=width, **options)
    return assemble(config, seed=seed, encoder_weights=encoder_weights, pose_encoder_weights=pose_encoder_weights)


def assemble(
    config: MethodConfig,
    *,
    seed: int = 0,
    encoder_weights: str | Path | None = None,
    pose_encoder_weights: str | Path | None = None,
) -> Method:
    """The networks of a config, on the CPU, in train mode.

    The same seed gives the same weights, and torch's own random state is left as it was. With and without vibration,
    and with any fusion, the vision networks of one seed start the same.

    Args:
        config: the method's decisions.
        seed: of the initial weights.
        encoder_weights: local weights of the depth encoder (and of the pose ResNet where it is of the same kind): a
            safetensors file, or for EndoDAC a folder of the transformer.
        pose_encoder_weights: safetensors of the pose ResNet, for RA-Depth and EndoDAC, whose depth encoder is none.

    Raises:
        ConfigError: a value outside its range, or a missing library.
        WeightsError: weights that cannot be read or do not fit.
    """
    build = BUILDERS[config.name]
    extra = {}
    if pose_encoder_weights is not None:
        if "pose_weights" not in inspect.signature(build).parameters:
            raise ConfigError(f"{config.name}: takes no weights for its pose encoder alone; leave them out")
        extra["pose_weights"] = pose_encoder_weights
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return Method(config, build(config, encoder_weights, **extra))
