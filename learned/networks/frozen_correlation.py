"""Our pose network for prediction: every frame is looked at once, whatever the number of its pairs."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.networks.correlation_pose import (
    COARSER_BLOCKS,
    GAIN,
    POOL,
    SHARPNESS,
    CorrelationPoseNetwork,
)
from learned.networks.encoder import normalise_image
from learned.networks.pair_network import PairMotion, PairNetwork, Pairs

WINDOW, LEAST_NORM = 9, 1e-3
"""As `locally_normalised` has them."""


class FrozenCorrelationPose(PairNetwork):
    """`CorrelationPoseNetwork` in eval mode, its batch norms folded: equal up to rounding, no gradients.

    The entry is linear before its ReLU, so it is taken apart: what the match distributions add is computed per pair,
    what the first frame's features add per frame, and what the coordinates add once per size of map.

    Args:
        network: whose weights are used; its entry's norm is part of the convolution already.
    """

    def __init__(self, network: CorrelationPoseNetwork) -> None:
        super().__init__()
        self.fusion, self.fused_channels, self.radius = network.fusion, network.fused_channels, network.radius
        self.stem, self.blocks, self.coarser = network.stem, network.trunk[1:], network.coarser
        self.rotation, self.translation = network.rotation, network.translation
        opening = network.trunk[0]
        assert isinstance(opening, nn.Sequential) and not isinstance(opening[1], nn.BatchNorm2d)
        entry = opening[0]
        assert isinstance(entry, nn.Conv2d)
        matches = (2 * network.radius + 1) ** 2
        self.of_matches = _part(entry, slice(0, matches), gain=GAIN)
        self.of_place = _part(entry, slice(matches, matches + 2), bias=True)
        self.of_features = _part(entry, slice(matches + 2, None))
        for convolution in self.coarser:
            assert isinstance(convolution, nn.Conv2d)
            convolution.weight.mul_(GAIN)
        self._places: dict[tuple[int, int, torch.device], Tensor] = {}

    def forward(self, frames: Tensor, pairs: Pairs, vibration: Tensor | None) -> PairMotion:
        """Motions of pairs of frames (B, F, 3, H, W) in 0..1; every frame passes the stem once."""
        count = (len(frames), len(pairs))
        used = sorted({k for pair in pairs for k in pair})
        features = self.features(frames[:, used].flatten(0, 1))
        snippet = len(used) * torch.arange(len(frames), device=frames.device)[:, None]
        first, second = ((snippet + snippet.new_tensor([used.index(pair[side]) for pair in pairs])).flatten()
                         for side in (0, 1))
        unit = unit_features(features)
        x = self._entry(unit, first, second)
        added = self._coarser_matches(features, first, second)
        bound = None if self.fusion is None or vibration is None else self.fusion.bind(vibration.flatten(0, 1))
        x = x if bound is None else bound(0, x)
        for number, block in enumerate(self.blocks, 1):
            x = block(x) + added[number] if number in added else block(x)
            x = x if bound is None else bound(number, x)
        raw = torch.unflatten(self._head(x), 0, count)
        snr = None if bound is None or bound.snr is None else torch.unflatten(bound.snr, 0, count)
        return PairMotion(raw, torch.unflatten(x, 0, count), None, snr)

    def features(self, images: Tensor) -> Tensor:
        """As `CorrelationPoseNetwork.features`, channels last."""
        x: Tensor = self.stem(normalise_image(images))
        return x.to(self.rotation.weight.dtype)

    def _entry(self, unit: Tensor, first: Tensor, second: Tensor) -> Tensor:
        x: Tensor = self.of_matches(self._distribution(unit, first, second))
        of_frame = self.of_features(unit) + self._place(unit)
        for total, frame in zip(x, first.tolist(), strict=True):
            total += of_frame[frame]
        return x.relu_()

    def _place(self, like: Tensor) -> Tensor:
        """(1, C, h, w) what the coordinates x, y in -1..1 add, and the bias."""
        height, width = like.shape[-2:]
        key = (height, width, like.device)
        if key not in self._places:
            across = torch.linspace(-1, 1, width, dtype=like.dtype, device=like.device).expand(height, width)
            down = torch.linspace(-1, 1, height, dtype=like.dtype, device=like.device)[:, None].expand(height, width)
            self._places[key] = self.of_place(torch.stack([across, down])[None])
        return self._places[key]

    def _coarser_matches(self, features: Tensor, first: Tensor, second: Tensor) -> dict[int, Tensor]:
        added = {}
        for block, told in zip(COARSER_BLOCKS, self.coarser, strict=False):
            features = F.avg_pool2d(features, 2, ceil_mode=True)
            added[block] = told(self._distribution(unit_features(features), first, second))
        return added

    def _distribution(self, unit: Tensor, first: Tensor, second: Tensor) -> Tensor:
        """Where each cell of the first frames went, (P, (2 radius + 1)², h, w), channels last, without `GAIN`."""
        cells = unit.permute(0, 2, 3, 1).contiguous()
        scores = pair_correlation(SHARPNESS * cells, cells, first.tolist(), second.tolist(), self.radius)
        return torch.softmax(scores, -1).permute(0, 3, 1, 2)

    def _head(self, x: Tensor) -> Tensor:
        pooled = x if x.shape[-2:] == (POOL, POOL) else F.adaptive_avg_pool2d(x, POOL)
        flat = pooled.contiguous().flatten(1)
        return torch.cat([self.rotation(flat), self.translation(flat)], 1)


def unit_features(features: Tensor) -> Tensor:
    """`locally_normalised`, its mean taken along rows and columns in turn."""
    reach = WINDOW // 2
    mean = F.avg_pool2d(features, (WINDOW, 1), 1, (reach, 0), count_include_pad=False)
    mean = F.avg_pool2d(mean, (1, WINDOW), 1, (0, reach), count_include_pad=False)
    return F.normalize(features - mean, dim=1, eps=LEAST_NORM)


def pair_correlation(first: Tensor, second: Tensor, rows: list[int], partners: list[int], radius: int) -> Tensor:
    """`local_correlation` of cells, channels last.

    A row of cells is multiplied with all rows it may match at once; of the product, the band is read in place, for a
    cell and the first that it may match move on together.

    Args:
        first: (F, H, W, C).
        second: (F, H, W, C).
        rows: P numbers of the first maps.
        partners: P numbers of the second.
        radius: r in cells.

    Returns:
        (P, H, W, (2r + 1)²).
    """
    frames, height, width, channels = first.shape
    side, line = 2 * radius + 1, width + 2 * radius
    padded = F.pad(second, (0, 0, radius, radius, radius, radius))
    stripes = padded.as_strided((frames, height, side * line, channels),
                                (padded.stride(0), line * channels, channels, 1))
    out = first.new_empty(len(rows), height, width, side, side)
    for number, (i, j) in enumerate(zip(rows, partners, strict=True)):
        products = torch.bmm(first[i], stripes[j].transpose(1, 2))
        out[number] = products.as_strided((height, width, side, side),
                                          (width * side * line, side * line + 1, line, 1))
    return out.flatten(3)


def _part(whole: nn.Conv2d, inputs: slice, gain: float = 1.0, bias: bool = False) -> nn.Conv2d:
    """A convolution of some of another's inputs."""
    weight = gain * whole.weight[:, inputs]
    part = nn.Conv2d(weight.shape[1], len(weight), 3, 1, 1, bias=bias).to(weight.device, weight.dtype)
    part.weight = nn.Parameter(weight, requires_grad=False)
    if bias:
        assert whole.bias is not None
        part.bias = nn.Parameter(whole.bias.clone(), requires_grad=False)
    return part
