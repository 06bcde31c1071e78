"""EndoDAC's depth encoder: a DINOv2 vision transformer (through `transformers`) with DV-LoRA and convolutional necks.

The transformer stays frozen; trained are low-rank updates of its MLPs and a bottleneck of convolutions after some of
its blocks. `transformers` comes with the extra `foundation` and is imported when such an encoder is built.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.errors import NetworkInputError, WeightsError
from learned.networks.dv_lora import RANK, DvLoraLinear
from learned.networks.encoder import Encoder, FuseBlock, keep_features
from learned.networks.pretrained import check_safetensors
from vio.errors import ConfigError

PATCH, CELL = 14, 16
"""Pixels of a patch, and pixels of the frame it stands for: 256 x 320 is seen at 224 x 280, as published."""
HEAD_WIDTH, LAYERS, TRAINED_SIZE = 64, 12, 518
NECK_REDUCTION = 8
HEADS = {"small": 6, "base": 12}
"""Attention heads, 64 channels each."""


@dataclass(frozen=True)
class DinoShape:
    """Size of the transformer and where it is tapped."""

    heads: int = HEADS["base"]
    taps: tuple[int, ...] = (2, 5, 8, 11)
    """Blocks whose maps are fused and handed to the decoder. The published code asks for the last four (8 to 11)."""
    necks: tuple[int, ...] = (2, 5, 8, 11)
    """Blocks that a convolutional bottleneck follows."""
    rank: int = RANK

    @property
    def channels(self) -> int:
        """Of every token."""
        return self.heads * HEAD_WIDTH


class DinoEncoder(Encoder):
    """Images (N, 3, H, W) → maps of the tapped blocks (N, C, H / 16, W / 16), after the final layer norm.

    Images enter in 0..1 without ImageNet's mean and deviation, as published.

    Args:
        shape: size and taps.
        weights: a local folder as `transformers` saves it (`config.json`, `model.safetensors`); None starts at random.
        frozen: leave the transformer's own weights untrained. At random weights, train them.

    Raises:
        ConfigError: `transformers` is not installed, or a tap beyond the last block.
        WeightsError: the folder is missing or damaged, or holds a transformer of another size.
    """

    def __init__(self, shape: DinoShape, weights: str | Path | None = None, frozen: bool = True) -> None:
        super().__init__()
        if not shape.taps or not {*shape.taps, *shape.necks} <= set(range(LAYERS)):
            raise ConfigError(f"taps {shape.taps}, necks {shape.necks}: blocks are numbered 0 to {LAYERS - 1}")
        self.shape = shape
        self.vit = _transformer(shape, weights)
        self.vit.requires_grad_(not frozen)
        self.vit.embeddings.mask_token.requires_grad_(False)  # nothing is masked here
        for layer in self.vit.encoder.layer:
            layer.mlp.fc1 = DvLoraLinear(layer.mlp.fc1, shape.rank)
            layer.mlp.fc2 = DvLoraLinear(layer.mlp.fc2, shape.rank)
        self.necks = nn.ModuleDict({str(k): Neck(shape.channels) for k in shape.necks})
        self.channels = (shape.channels,) * len(shape.taps)
        self.set_phase("directions")

    def forward(self, images: Tensor, fuse: FuseBlock = keep_features) -> list[Tensor]:
        """One map per tap, shallow first; H and W divisible by 16.

        Raises:
            NetworkInputError: another size.
        """
        height, width = images.shape[-2] // CELL, images.shape[-1] // CELL
        if images.shape[-2] % CELL or images.shape[-1] % CELL:
            raise NetworkInputError(f"images of {images.shape[-1]} x {images.shape[-2]} pixels; both must be "
                                    f"divisible by {CELL}")
        images = F.interpolate(images, (height * PATCH, width * PATCH), mode="bilinear", align_corners=True)
        x: Tensor = self.vit.embeddings(images)
        maps: list[Tensor] = []
        for block, layer in enumerate(self.vit.encoder.layer):
            x = layer(x)
            if str(block) in self.necks:
                x = self._on_map(x, height, self.necks[str(block)])
            if block in self.shape.taps:
                number = len(maps)
                x = self._on_map(x, height, lambda m, n=number: fuse(n, m))
                maps.append(self._map(self.vit.layernorm(x)[:, 1:], height))
        return maps

    def set_phase(self, phase: str) -> None:
        """What of DV-LoRA trains: "directions" (A and B, the warm-up) or "magnitudes" (U and V, afterwards).

        The published optimiser never received U and V, because they were frozen when it was built: register all
        parameters, then switch.

        Raises:
            ConfigError: another phase.
        """
        if phase not in ("directions", "magnitudes"):
            raise ConfigError(f"DV-LoRA phase {phase!r}: unknown, choose 'directions' or 'magnitudes'")
        for part in self.modules():
            if isinstance(part, DvLoraLinear):
                for factor, when in ((part.lora_A, "directions"), (part.lora_B, "directions"),
                                     (part.lora_U, "magnitudes"), (part.lora_V, "magnitudes")):
                    factor.requires_grad_(phase == when)

    def _on_map(self, tokens: Tensor, height: int, step: Any) -> Tensor:
        """Apply a step on maps to the patch tokens; the class token stays."""
        changed: Tensor = step(self._map(tokens[:, 1:], height))
        return torch.cat([tokens[:, :1], changed.flatten(2).transpose(1, 2)], 1)

    @staticmethod
    def _map(tokens: Tensor, height: int) -> Tensor:
        return torch.unflatten(tokens.transpose(1, 2), 2, (height, -1))


class Neck(nn.Module):
    """1x1, 3x3, 1x1 convolutions with an eighth of the channels, added to the map; starts as the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = channels // NECK_REDUCTION
        self.conv1 = nn.Conv2d(channels, inner, 1, bias=False)
        self.norm1 = nn.LayerNorm(inner)
        self.conv2 = nn.Conv2d(inner, inner, 3, 1, 1, bias=False)
        self.norm2 = nn.LayerNorm(inner)
        self.conv3 = nn.Conv2d(inner, channels, 1, bias=False)
        self.norm3 = nn.LayerNorm(channels)
        nn.init.zeros_(self.norm3.weight)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, h, w) → same shape."""
        y = F.gelu(_norm(self.norm1, self.conv1(x)))
        y = F.gelu(_norm(self.norm2, self.conv2(y)))
        return x + _norm(self.norm3, self.conv3(y))


def _norm(layer: nn.Module, x: Tensor) -> Tensor:
    """Layer norm over the channels of a map."""
    out: Tensor = layer(x.movedim(1, -1))
    return out.movedim(-1, 1)


def _transformer(shape: DinoShape, weights: str | Path | None) -> Any:
    try:
        import transformers
    except ImportError:
        raise ConfigError("EndoDAC's encoder needs the library transformers: install capsule-vio[foundation]") from None
    if weights is None:
        config = transformers.Dinov2Config(
            hidden_size=shape.channels, num_hidden_layers=LAYERS, num_attention_heads=shape.heads,
            image_size=TRAINED_SIZE, patch_size=PATCH,
        )
        return transformers.Dinov2Model(config)
    return _loaded(transformers, shape, Path(weights))


def _loaded(transformers: Any, shape: DinoShape, folder: Path) -> Any:
    """A transformer from a local folder; nothing of it is left at random in silence."""
    if not (folder / "config.json").is_file():
        raise WeightsError(f"{folder.name}: no config.json in it; give the folder that transformers saved DINOv2 to")
    check_safetensors(folder / "model.safetensors")
    try:
        model, info = transformers.Dinov2Model.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True)
    except (OSError, ValueError, RuntimeError) as error:
        raise WeightsError(f"{folder.name}: not a DINOv2 that transformers can load ({_line(error)})") from None
    found = (model.config.hidden_size, model.config.num_hidden_layers, model.config.patch_size)
    if found != (shape.channels, LAYERS, PATCH):
        raise WeightsError(f"{folder.name}: channels, blocks, patch are {found}, expected "
                           f"{(shape.channels, LAYERS, PATCH)}; choose the transformer of this size")
    missing = sorted(set(info["missing_keys"]) - {"embeddings.mask_token"})
    if missing:
        raise WeightsError(f"{folder.name}: tensor {missing[0]!r} is missing; give all weights of DINOv2")
    return model


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
