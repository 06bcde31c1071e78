"""What all methods have in common to decide, and how a decision is written into a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, ClassVar, TypeVar

from learned.methods.parametrisation import DepthRange, PoseParametrisation
from learned.networks.vibration_branch import BranchConfig
from learned.vibration_fusion import FusionConfig
from vio.errors import ConfigError

SIZE_STEP, SMALLEST_SIZE = 32, 64
"""Frames have to be divisible by the coarsest stride, and twice as large."""

Config = TypeVar("Config")


@dataclass(frozen=True, kw_only=True)
class MethodConfig:
    """The decisions every method takes; the methods' own configs give them their defaults.

    Raises:
        ConfigError: a value outside its range.
    """

    name: ClassVar[str] = ""

    width: float = 1.0
    """Factor on the channels of all image networks; 1 is the method's own size, less gives compact variants."""
    vibration: bool = True
    """False: the same networks without branch and fusion."""
    fusion: FusionConfig = field(default_factory=FusionConfig)
    """How vibration enters; used when `vibration` is on."""
    branch: BranchConfig = field(default_factory=BranchConfig)
    """The vibration branch."""
    shared_branch: bool = True
    """One branch for depth and pose, as the paper's figure draws; False gives each its own. The text leaves it open."""
    image_size: tuple[int, int]
    """(height, width) the method is trained at."""
    depth_range: DepthRange
    """Range of the sigmoid."""
    pose: PoseParametrisation
    """How raw numbers become a motion."""
    depth_frames: tuple[int, ...]
    """Frames of a triplet whose depth the method's own loss needs; 1 is the target."""
    pairs: tuple[tuple[int, int], ...]
    """Motions T_i_j of a triplet that the method's own loss needs."""

    def __post_init__(self) -> None:
        if not 0 < self.width <= 4:
            raise ConfigError(f"{self.name} width {self.width:g}: must be in (0, 4]")
        if any(n % SIZE_STEP or n < SMALLEST_SIZE for n in self.image_size):
            raise ConfigError(f"{self.name} image size {self.image_size[1]} x {self.image_size[0]}: both must be "
                              f"divisible by {SIZE_STEP} and at least {SMALLEST_SIZE}")
        if not self.depth_frames or not self.pairs or any(i == j for i, j in self.pairs):
            raise ConfigError(f"{self.name}: depth_frames {self.depth_frames} and pairs {self.pairs} must not be "
                              "empty, and a pair needs two different frames")


def config_to_dict(config: MethodConfig) -> dict[str, Any]:
    """A method's decisions in values that JSON can hold, the method's name first."""
    return {"name": config.name, **_plain(config)}


def config_from_dict(values: Mapping[str, Any], kinds: Mapping[str, type[MethodConfig]]) -> MethodConfig:
    """The config that `config_to_dict` wrote; missing keys take their defaults.

    Args:
        values: name and decisions.
        kinds: config class by method name.

    Raises:
        ConfigError: an unknown method or key, or a value outside its range.
    """
    name = values.get("name")
    if name not in kinds:
        raise ConfigError(f"method {name!r}: unknown, choose one of {', '.join(kinds)}")
    return _filled(kinds[str(name)], {key: value for key, value in values.items() if key != "name"}, str(name))


def _plain(config: Any) -> dict[str, Any]:
    values = {f.name: getattr(config, f.name) for f in fields(config)}
    return {key: _plain(value) if is_dataclass(value) else _listed(value) for key, value in values.items()}


def _listed(value: Any) -> Any:
    return [_listed(v) for v in value] if isinstance(value, tuple) else value


def _tupled(value: Any) -> Any:
    return tuple(_tupled(v) for v in value) if isinstance(value, list) else value


PARTS: dict[str, type] = {"fusion": FusionConfig, "branch": BranchConfig, "depth_range": DepthRange,
                          "pose": PoseParametrisation}
"""Keys of a config that hold a config of their own."""


def _filled(kind: type[Config], values: Mapping[str, Any], where: str) -> Config:
    known = {f.name for f in fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(set(values) - known)
    if unknown:
        raise ConfigError(f"{where}: unknown key {unknown[0]!r}, choose from {', '.join(sorted(known))}")
    given = {key: _filled(PARTS[key], value, f"{where}.{key}") if key in PARTS and isinstance(value, Mapping)
             else _tupled(value) for key, value in values.items()}
    try:
        return kind(**given)
    except TypeError as error:
        raise ConfigError(f"{where}: {error}") from None
