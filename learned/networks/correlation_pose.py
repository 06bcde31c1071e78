"""Our pose network: it is shown where things went, instead of having to find out.

One stem looks at every frame alone. Features, free of slowly varying light, are correlated with the cells around the
same place of the other frame; the match distributions, the cells' coordinates and the features go through a small
ResNet. Six stacked channels have to invent matching first, which takes far longer: at equal, short training this
network finds the direction of motion to 18°, the stacked one to 94°.

A match may lie a few cells away, so how far depends on the size of a cell: coarser maps find what moves farther. With
one map at a quarter resolution, 16 px of reach, a third of the pixels of quick motion near a wall were out of reach,
the direction of such steps was off two to five times as far, and their length was seen up to a fifth too short.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learned.networks.correlation import local_correlation, locally_normalised
from learned.networks.encoder import normalise_image
from learned.networks.pair_network import PairMotion, PairNetwork, Pairs
from learned.networks.resnet import BasicBlock
from vio.errors import ConfigError

SHARPNESS, GAIN = 8.0, 4.0
"""Match scores in -1..1 → distribution: softmax(8 c); times 4, to have the size of the other inputs."""
POOL = 4
COARSER_BLOCKS = (1, 2)
"""Blocks of the trunk whose output has the cells of the first and of the second coarser map."""
HEAD_START_SD = 1e-3


class CorrelationPoseNetwork(PairNetwork):
    """Frames → motions of pairs, rotation vector and translation.

    Fused are the five blocks of the pair's trunk. The stem is not: the local normalisation after it takes away gain and
    offset, which is what a fusion without neighbours can change.

    Args:
        base: channels of the stem; 32 give 2.52 M parameters, 2.66 M with three maps.
        radius: cells that a match may lie away.
        maps: 1 at a quarter of the image's resolution, 2 with one at an eighth, 3 with one at a sixteenth: a match may
            lie 4, 8 or 16 px times `radius` away.

    Raises:
        ConfigError: fewer than one map or more than three.
    """

    def __init__(self, base: int = 32, radius: int = 4, maps: int = 1) -> None:
        super().__init__()
        if not 1 <= maps <= 1 + len(COARSER_BLOCKS):
            raise ConfigError(f"pose network: {maps} correlation maps; choose 1, 2 or 3")
        self.radius = radius
        self.stem = nn.Sequential(
            nn.Conv2d(3, base, 5, 2, 2), nn.BatchNorm2d(base), nn.ReLU(),
            nn.Conv2d(base, base, 3, 2, 1), nn.BatchNorm2d(base), nn.ReLU(), nn.Conv2d(base, base, 3, 1, 1),
        )
        inputs = (2 * radius + 1) ** 2 + 2 + base
        entry = nn.Sequential(nn.Conv2d(inputs, 2 * base, 3, 1, 1), nn.BatchNorm2d(2 * base), nn.ReLU())
        self.trunk = nn.ModuleList([
            entry, BasicBlock(2 * base, 2 * base, 2), BasicBlock(2 * base, 4 * base, 2),
            BasicBlock(4 * base, 8 * base, 2), BasicBlock(8 * base, 8 * base),
        ])
        self.fused_channels = (2 * base, 2 * base, 4 * base, 8 * base, 8 * base)
        self.coarser = nn.ModuleList(
            _silent(nn.Conv2d((2 * radius + 1) ** 2, self.fused_channels[block], 3, 1, 1))
            for block in COARSER_BLOCKS[:maps - 1])
        self.rotation = _small(nn.Linear(8 * base * POOL * POOL, 3))
        self.translation = _small(nn.Linear(8 * base * POOL * POOL, 3))

    def forward(self, frames: Tensor, pairs: Pairs, vibration: Tensor | None) -> PairMotion:
        """Motions of pairs of frames (B, F, 3, H, W) in 0..1; every frame passes the stem once."""
        count = (len(frames), len(pairs))
        used = sorted({k for pair in pairs for k in pair})
        features = torch.unflatten(self.features(frames[:, used].flatten(0, 1)), 0, (count[0], len(used)))
        first, second = ([used.index(pair[side]) for pair in pairs] for side in (0, 1))
        seen = features[:, first].flatten(0, 1), features[:, second].flatten(0, 1)
        x = self.matches(*(locally_normalised(side) for side in seen))
        added = self.coarser_matches(*seen)
        bound = None if self.fusion is None or vibration is None else self.fusion.bind(vibration.flatten(0, 1))
        for number, block in enumerate(self.trunk):
            x = block(x) + added[number] if number in added else block(x)
            x = x if bound is None else bound(number, x)
        raw = torch.unflatten(self._head(x), 0, count)
        snr = None if bound is None or bound.snr is None else torch.unflatten(bound.snr, 0, count)
        return PairMotion(raw, torch.unflatten(x, 0, count), None, snr)

    def features(self, images: Tensor) -> Tensor:
        """(N, 3, H, W) → features (N, base, H / 4, W / 4); `locally_normalised` frees them of gain and offset of the
        light around a cell."""
        x: Tensor = self.stem(normalise_image(images))
        return x.to(self.rotation.weight.dtype)

    def coarser_matches(self, first: Tensor, second: Tensor) -> dict[int, Tensor]:
        """Features of both frames → what the coarser maps' matches add to the output of a block, by its number."""
        added = {}
        for block, told in zip(COARSER_BLOCKS, self.coarser, strict=False):
            first, second = (F.avg_pool2d(side, 2, ceil_mode=True) for side in (first, second))
            added[block] = told(self.distribution(locally_normalised(first), locally_normalised(second)))
        return added

    def distribution(self, first: Tensor, second: Tensor) -> Tensor:
        """Unit features of both frames → where each cell went, (N, (2 radius + 1)², h, w), times `GAIN`."""
        with torch.autocast(first.device.type, enabled=False):
            scores = local_correlation(first, second, self.radius)
            return GAIN * torch.softmax(SHARPNESS * scores, 1)

    def matches(self, first: Tensor, second: Tensor) -> Tensor:
        """Unit features of both frames → match distributions, coordinates (x, y in -1..1) and the first's features."""
        distribution = self.distribution(first, second)
        number, _, height, width = first.shape
        across = torch.linspace(-1, 1, width, dtype=first.dtype, device=first.device).expand(number, 1, height, width)
        down = torch.linspace(-1, 1, height, dtype=first.dtype, device=first.device)[:, None]
        return torch.cat([distribution, across, down.expand(number, 1, height, width), first], 1)

    def _head(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            pooled = F.adaptive_avg_pool2d(x.to(self.rotation.weight.dtype), POOL).flatten(1)
            return torch.cat([self.rotation(pooled), self.translation(pooled)], 1)


def _small(layer: nn.Linear) -> nn.Linear:
    """Motions start near zero."""
    nn.init.normal_(layer.weight, 0.0, HEAD_START_SD)
    nn.init.zeros_(layer.bias)
    return layer


def _silent(layer: nn.Conv2d) -> nn.Conv2d:
    """Adds nothing at first: a network trained without coarser maps can go on with them."""
    nn.init.zeros_(layer.weight)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return layer
