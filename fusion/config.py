"""Every knob of the refinement, typed, with unknown keys refused."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from vio.errors import ConfigError


@dataclass(frozen=True)
class RobustConfig:
    """Outlier handling of the relative motions: Huber first, then a gate, then Gaussian."""

    huber: float = 2.8
    """Huber threshold on the whitened 6-vector norm."""
    gate: float = 25.0
    """Squared whitened norm (6 degrees of freedom) above which a motion is rejected."""


@dataclass(frozen=True)
class ScaleConfig:
    """Metric scale of the motions."""

    policy: Literal["auto", "free", "prior", "fixed"] = "auto"
    """"auto" decides from the data; the others force it."""
    segment_s: float = 1.0
    """Length of the stretches that share one scale variable [s]; the walk, not this, says how fast scale may change."""
    walk_per_sqrt_s: float = 0.0055
    """Random walk of the log scale [1/sqrt(s)]; 0.10 per 1000 frames at 3 Hz."""
    imu_chi2_limit: float = 1.5
    """Inertial chi² (clean value about 0.5) above which the body moves in ways the camera does not see."""


@dataclass(frozen=True)
class RestConfig:
    """Where the capsule lies still."""

    policy: Literal["auto", "off"] = "auto"
    """"auto" looks for it."""
    found_m_s: float = 1e-4
    """Creep that must be found [m/s]: no stretch is called rest that is too short for it. Slowest in transit."""
    slowest_m_s: float = 1e-6
    """What does not rest goes at least this fast [m/s]: the default assumes nothing, for noise hides slower creep for
    hours. Larger only where that is known, as of a phantom's drive."""


@dataclass(frozen=True)
class SolverConfig:
    """Gauss-Newton and the chunked start."""

    chunk_frames: int = 1500
    overlap_frames: int = 90
    max_iterations: int = 25
    relative_tolerance: float = 1e-5


@dataclass(frozen=True)
class InitialConfig:
    """Standard deviations of the state at the first frame."""

    tilt_sd_rad: float = 0.2
    velocity_sd_m_s: float = 0.05
    accel_bias_sd_m_s2: float = 0.3
    gyro_bias_sd_rad_s: float = 0.0175


@dataclass(frozen=True)
class RefineConfig:
    """Configuration of `refine`; the YAML file has the same nesting."""

    estimator: Literal["auto", "graph", "ekf"] = "auto"
    robust: RobustConfig = field(default_factory=RobustConfig)
    scale: ScaleConfig = field(default_factory=ScaleConfig)
    rest: RestConfig = field(default_factory=RestConfig)
    solver: SolverConfig = field(default_factory=SolverConfig)
    initial: InitialConfig = field(default_factory=InitialConfig)

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionary, as written into the manifest."""
        return dataclasses.asdict(self)


def config_from_dict(values: dict[str, Any]) -> RefineConfig:
    """Build a configuration from nested plain values.

    Raises:
        ConfigError: an unknown key (the known ones are listed), a wrong type or a number outside its range.
    """
    config: RefineConfig = _build(RefineConfig, values, "")
    return config


def load_config(path: str | Path) -> RefineConfig:
    """Read a YAML configuration file.

    Raises:
        ConfigError: the file is missing or no YAML mapping, or as `config_from_dict`.
    """
    path = Path(path)
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path.name}: cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path.name}: cannot be read ({error})") from None
    except yaml.YAMLError as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"{path.name}: not valid YAML ({reason}); write `key: value` lines") from None
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path.name}: must hold a mapping of keys to values")
    return config_from_dict(values)


CHOICES = {
    "estimator": ("auto", "graph", "ekf"),
    "scale.policy": ("auto", "free", "prior", "fixed"),
    "rest.policy": ("auto", "off"),
}


def _build(kind: Any, values: dict[str, Any], prefix: str) -> Any:
    fields = {f.name: f for f in dataclasses.fields(kind)}
    unknown = [key for key in values if key not in fields]
    if unknown:
        raise ConfigError(f"configuration: unknown key {prefix + str(unknown[0])!r}; known are {', '.join(fields)}")
    built: dict[str, Any] = {}
    for key, value in values.items():
        name = prefix + key
        default = getattr(kind(), key)
        if dataclasses.is_dataclass(default):
            if not isinstance(value, dict):
                raise ConfigError(f"configuration: {name} must be a mapping, got {value!r}")
            built[key] = _build(type(default), value, f"{name}.")
        elif isinstance(default, str):
            built[key] = _choice(name, value)
        else:
            built[key] = _positive(name, value, type(default))
    return kind(**built)


def _choice(name: str, value: Any) -> str:
    if value not in CHOICES[name]:
        raise ConfigError(f"configuration: {name} is {value!r}; choose one of {', '.join(CHOICES[name])}")
    return str(value)


def _positive(name: str, value: Any, kind: type) -> int | float:
    number = _number(value)
    if number is None or not 0 < number < float("inf"):
        raise ConfigError(f"configuration: {name} is {value!r}; must be a positive number")
    if kind is int and int(number) != number:
        raise ConfigError(f"configuration: {name} is {value!r}; must be a whole number")
    return int(number) if kind is int else number


def _number(value: Any) -> float | None:
    """A number, or text that is one: YAML 1.1 reads 1e-6 as text."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        return float(value)
    except (ValueError, OverflowError):
        return None
