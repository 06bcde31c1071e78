"""Weights on disk: safetensors with a card that says what they are, and a digest that shows when they changed.

The card is JSON in the file's metadata: the method and its decisions, how and on what it was trained, what was
measured, the scale prior and the uncertainty model, and the SHA-256 of the tensors. No pickle is ever opened.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import save
from torch import Tensor

from learned.errors import WeightsError
from learned.methods import CONFIGS, Method, assemble, config_from_dict, config_to_dict
from vio.atomic import atomic_write
from vio.errors import ConfigError

SCHEMA = 1
BUNDLED = "gyro-correlation"
"""Name of the weights that come with the library: `learned/bundled/<name>.safetensors`."""
REQUIRED = ("schema", "method", "sha256", "depth_kind", "scale_log_mean", "scale_log_sd", "uncertainty")


@dataclass(frozen=True)
class Weights:
    """A method with its weights."""

    method: Method
    """In eval mode, float32, on the CPU."""
    card: dict[str, Any]
    """What the file says about itself."""
    name: str
    """Of the file."""


def save_weights(path: str | Path, method: Method, card: Mapping[str, Any], half: bool = True) -> str:
    """Write weights with their card, atomically.

    Args:
        path: ends in .safetensors.
        method: whose weights are written.
        card: what else is to be known; `schema`, `method` and `sha256` are added.
        half: kernels and matrices in float16, half the size; vectors stay in float32, for variances need the range.

    Returns:
        The SHA-256 of the tensors.

    Raises:
        OutputError: the file cannot be written.
    """
    tensors = {name: _stored(value, half) for name, value in sorted(method.state_dict().items())}
    digest = tensors_digest(tensors)
    whole = {**card, "schema": SCHEMA, "method": config_to_dict(method.config), "sha256": digest}
    with atomic_write(path) as file:
        file.write(save(tensors, {"card": json.dumps(whole, sort_keys=True)}))
    return digest


def rewrite_card(source: str | Path, path: str | Path, more: Mapping[str, Any]) -> dict[str, Any]:
    """The weights of a file under a card that says more; tensors and digest stay as they are. Atomic, also in place.

    Args:
        source: weights that `load_weights` accepts.
        path: where they are written, may be `source`.
        more: keys to add or to replace; not `schema`, `method` or `sha256`.

    Returns:
        The whole card.

    Raises:
        WeightsError: as `load_weights`, or a key that describes the tensors.
        OutputError: the file cannot be written.
    """
    fixed = sorted({"schema", "method", "sha256"} & set(more))
    if fixed:
        raise WeightsError(f"weights {Path(path).name}: the card's {fixed[0]} describes the tensors and cannot be "
                           "replaced; save the weights anew")
    card = {**load_weights(source).card, **more}
    tensors, _ = _read(Path(source))
    with atomic_write(path) as file:
        file.write(save(tensors, {"card": json.dumps(card, sort_keys=True)}))
    return card


def load_weights(path: str | Path | None = None) -> Weights:
    """Weights from a file, or those that come with the library.

    Raises:
        WeightsError: no such file, a pickle, a damaged or changed file, one without a card, or of another method.
    """
    where = bundled_path() if path is None else Path(path)
    name = where.name
    tensors, metadata = _read(where)
    card = _card(metadata, name)
    found = tensors_digest(tensors)
    if found != card["sha256"]:
        raise WeightsError(f"weights {name}: the tensors have SHA-256 {found[:12]}…, the card says "
                           f"{str(card['sha256'])[:12]}…; the file was changed, get it again")
    try:
        method = assemble(config_from_dict(card["method"], CONFIGS))
    except ConfigError as error:
        raise WeightsError(f"weights {name}: {error}; this version cannot build that method") from None
    fill_method(method, tensors, f"weights {name}", "the card describes; get the file again")
    return Weights(method.eval(), card, name)


def bundled_path() -> Path:
    """Where the library's own weights lie.

    Raises:
        WeightsError: this installation lacks them.
    """
    path = Path(str(files("learned") / "bundled" / f"{BUNDLED}.safetensors"))
    if not path.is_file():
        raise WeightsError("this installation lacks the bundled weights (learned/bundled); install it again, or give "
                           "weights of your own")
    return path


def tensors_digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, types, shapes and bytes, in the order of the names."""
    total = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        total.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        total.update(value.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def _stored(value: Tensor, half: bool) -> Tensor:
    value = value.detach().cpu().contiguous()
    return value.half() if half and value.is_floating_point() and value.ndim > 1 else value


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    name = path.name
    try:
        with path.open("rb") as file:
            start = file.read(2)
    except OSError as error:
        raise WeightsError(f"weights {name}: {error.strerror or 'cannot be read'}; give a .safetensors file") from None
    try:
        with safetensors.safe_open(path, framework="pt") as opened:
            return {key: opened.get_tensor(key) for key in list(opened.keys())}, dict(opened.metadata() or {})
    except (safetensors.SafetensorError, OSError):
        if start == b"PK" or start[:1] == b"\x80":  # only of what is no safetensors: its header may begin so too
            raise WeightsError(f"weights {name}: a pickle, which can run code when it is opened; give safetensors"
                               ) from None
        raise WeightsError(f"weights {name}: damaged, or no safetensors file; get it again") from None


def _card(metadata: Mapping[str, str], name: str) -> dict[str, Any]:
    if "card" not in metadata:
        raise WeightsError(f"weights {name}: no card, so their method is not known; give weights that "
                           "`capsule-vio train` wrote")
    try:
        card = json.loads(metadata["card"])
    except json.JSONDecodeError:
        raise WeightsError(f"weights {name}: the card is not JSON; get the file again") from None
    missing = [key for key in REQUIRED if key not in card]
    if missing or card["schema"] != SCHEMA:
        what = f"lacks {', '.join(missing)}" if missing else f"has schema {card['schema']}, this version reads {SCHEMA}"
        raise WeightsError(f"weights {name}: the card {what}; train them again or use a matching version")
    return dict(card)


def fill_method(method: Method, tensors: Mapping[str, Tensor], what: str, remedy: str) -> None:
    """Put tensors into a method's networks, all or none.

    Args:
        method: whose weights are replaced.
        tensors: by name.
        what: they are called in a refusal.
        remedy: what to do about tensors of another method.

    Raises:
        WeightsError: names or shapes that are not the method's, or values that are not finite.
    """
    wanted = method.state_dict()
    missing, extra = sorted(set(wanted) - set(tensors)), sorted(set(tensors) - set(wanted))
    wrong = [key for key in wanted if key in tensors and tensors[key].shape != wanted[key].shape]
    if missing or extra or wrong:
        first = (missing or extra or wrong)[0]
        how = "lack" if missing else "have an unknown" if extra else "have another shape of"
        raise WeightsError(f"{what}: they {how} {first}, so they are not of the method that {remedy}")
    bad = [key for key, value in tensors.items() if value.is_floating_point() and not torch.isfinite(value).all()]
    if bad:
        raise WeightsError(f"{what}: {bad[0]} is not finite; train again, or store in float32")
    method.load_state_dict({key: value.to(wanted[key].dtype) for key, value in tensors.items()})
