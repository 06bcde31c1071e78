"""Local weights for an encoder: a safetensors file with the names of an ImageNet state dict."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from learned.errors import WeightsError

CLASSIFIER = ("fc.", "classifier.", "incre_modules.", "downsamp_modules.", "final_layer.")
"""Parts of ImageNet classifiers that an encoder has no use for."""
FIRST = "conv1.weight"
OWN = ("after_stem.",)
"""Parts of an encoder that no classifier has."""


def load_encoder(encoder: nn.Module, path: str | Path) -> None:
    """Fill an encoder with the weights of a file.

    An encoder of several images gets the first convolution repeated and divided by their number, so that a pair of
    equal images gives what one image gave.

    Args:
        encoder: a ResNet or HRNet at full width.
        path: `*.safetensors`.

    Raises:
        WeightsError: the file is missing, damaged or no safetensors, lacks a tensor, or holds one of another shape.
    """
    tensors = read_safetensors(path)
    given = {name: value for name, value in tensors.items() if not name.startswith(CLASSIFIER)}
    wanted = {name: value for name, value in encoder.state_dict().items() if not name.startswith(OWN)}
    if FIRST in given and FIRST in wanted:
        given[FIRST] = _for_images(given[FIRST], wanted[FIRST])
    name = Path(path).name
    for key, value in wanted.items():
        if key.endswith("num_batches_tracked"):
            given.setdefault(key, value)
        if key not in given:
            raise WeightsError(f"{name}: tensor {key!r} is missing; give the weights of this encoder")
        if given[key].shape != value.shape:
            raise WeightsError(f"{name}: tensor {key!r} has shape {tuple(given[key].shape)}, expected "
                               f"{tuple(value.shape)}; ImageNet weights fit width 1 only")
    unknown = sorted(set(given) - set(wanted))
    if unknown:
        raise WeightsError(f"{name}: tensor {unknown[0]!r} is unknown to this encoder; give its own weights")
    encoder.load_state_dict(given, strict=False)


def read_safetensors(path: str | Path) -> dict[str, Tensor]:
    """All tensors of a safetensors file, on the CPU.

    Raises:
        WeightsError: the file is missing, damaged, or not safetensors: pickles are never opened.
    """
    path = check_safetensors(path)
    return load_file(path)


def check_safetensors(path: str | Path) -> Path:
    """The path of a file whose header and length are those of safetensors.

    Raises:
        WeightsError: the file is missing, damaged, or not safetensors.
    """
    path = Path(path)
    if not path.is_file():
        raise WeightsError(f"{path.name}: no such file; give a local safetensors file")
    if path.suffix != ".safetensors":
        raise WeightsError(f"{path.name}: not a safetensors file; pickled weights are refused, convert them")
    try:
        with safe_open(path, framework="pt"):
            return path
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path.name}: cannot be read as safetensors ({error})") from None


def _for_images(weight: Tensor, wanted: Tensor) -> Tensor:
    images = wanted.shape[1] // weight.shape[1]
    if images < 2 or wanted.shape[1] % weight.shape[1]:
        return weight
    return torch.cat([weight] * images, 1) / images
