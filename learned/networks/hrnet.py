"""HRNet-W18 encoder (Sun et al., "Deep High-Resolution Representation Learning", 2019): RA-Depth's.

Four resolutions run side by side and exchange sums after every module. Parameter names are those of the ImageNet
state dicts published with the article (`stage2.0.branches.0.0.conv1.weight`, …); the classifier is left out.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from learned.networks.encoder import Encoder, FuseBlock, keep_features, normalise_image, scaled
from learned.networks.resnet import BasicBlock, Bottleneck, initialise_convolutions, residual_stage

BRANCH_CHANNELS = (18, 36, 72, 144)
STAGE_MODULES = (1, 4, 3)
"""Modules of the stages with two, three and four resolutions."""
BRANCH_BLOCKS = 4


class HRNetEncoder(Encoder):
    """Five maps at strides 2, 4, 8, 16, 32 with 64, 18, 36, 72, 144 channels.

    Fused are the stem's map, which feeds everything after it, and the four maps that the last stage hands to the
    decoder: in between, the resolutions are no blocks of a chain.

    Args:
        width: factor on all channels; 1 has 9,562,260 parameters.
    """

    def __init__(self, width: float = 1.0) -> None:
        super().__init__()
        stem = scaled(64, width)
        branches = tuple(scaled(c, width) for c in BRANCH_CHANNELS)
        self.conv1 = nn.Conv2d(3, stem, 3, 2, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(stem)
        self.conv2 = nn.Conv2d(stem, stem, 3, 2, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(stem)
        self.relu = nn.ReLU(inplace=True)
        self.layer1 = residual_stage(Bottleneck, stem, stem, BRANCH_BLOCKS, 1)
        self.transition1 = _transition((stem * Bottleneck.expansion,), branches[:2])
        self.stage2 = _stage(branches[:2], STAGE_MODULES[0])
        self.transition2 = _transition(branches[:2], branches[:3])
        self.stage3 = _stage(branches[:3], STAGE_MODULES[1])
        self.transition3 = _transition(branches[:3], branches)
        self.stage4 = _stage(branches, STAGE_MODULES[2])
        initialise_convolutions(self)
        self.channels = (stem, *branches)

    def forward(self, images: Tensor, fuse: FuseBlock = keep_features) -> list[Tensor]:
        """(N, 3, H, W) in 0..1 → five maps, finest first."""
        stem = fuse(0, self.relu(self.bn1(self.conv1(normalise_image(images)))))
        maps = [self.layer1(self.relu(self.bn2(self.conv2(stem))))]
        for transition, stage in ((self.transition1, self.stage2), (self.transition2, self.stage3),
                                  (self.transition3, self.stage4)):
            maps = [maps[min(k, len(maps) - 1)] if step is None else step(maps[min(k, len(maps) - 1)])
                    for k, step in enumerate(_steps(transition))]
            for module in stage:
                maps = module(maps)
        return [stem, *(fuse(k, x) for k, x in enumerate(maps, 1))]


class HighResolutionModule(nn.Module):
    """Residual blocks on every resolution, then every resolution receives the sum of all."""

    def __init__(self, channels: tuple[int, ...]) -> None:
        super().__init__()
        self.branches = nn.ModuleList(residual_stage(BasicBlock, c, c, BRANCH_BLOCKS, 1) for c in channels)
        self.fuse_layers = nn.ModuleList(
            nn.ModuleList(_exchange(channels, source, target) for source in range(len(channels)))
            for target in range(len(channels))
        )

    def forward(self, maps: list[Tensor]) -> list[Tensor]:
        """One map per resolution in, one out, same shapes."""
        maps = [branch(x) for branch, x in zip(self.branches, maps, strict=True)]
        return [F.relu(_total(list(row), maps, target)) for target, row in enumerate(self._rows())]

    def _rows(self) -> list[nn.ModuleList]:
        return [row for row in self.fuse_layers if isinstance(row, nn.ModuleList)]


def _total(row: list[nn.Module], maps: list[Tensor], target: int) -> Tensor:
    total = maps[target]
    for source, (step, x) in enumerate(zip(row, maps, strict=True)):
        if source > target:
            total = total + F.interpolate(step(x), size=maps[target].shape[-2:], mode="nearest")
        elif source < target:
            total = total + step(x)
    return total


def _exchange(channels: tuple[int, ...], source: int, target: int) -> nn.Module:
    """From one resolution to another: 1x1 before enlarging, strided 3x3 steps to shrink."""
    if source == target:
        return nn.Identity()
    if source > target:
        return nn.Sequential(nn.Conv2d(channels[source], channels[target], 1, bias=False),
                             nn.BatchNorm2d(channels[target]))
    steps = [_strided(channels[source], channels[source]) for _ in range(target - source - 1)]
    last = nn.Sequential(nn.Conv2d(channels[source], channels[target], 3, 2, 1, bias=False),
                         nn.BatchNorm2d(channels[target]))
    return nn.Sequential(*steps, last)


def _strided(inputs: int, outputs: int, stride: int = 2) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs),
                         nn.ReLU(inplace=True))


def _transition(before: tuple[int, ...], after: tuple[int, ...]) -> nn.ModuleList:
    """Adapts the channels of the resolutions there are, and opens a new one from the coarsest of them."""
    steps: list[nn.Module] = []
    for k, channels in enumerate(after):
        if k < len(before):
            steps.append(nn.Identity() if before[k] == channels else _strided(before[k], channels, 1))
        else:
            steps.append(nn.Sequential(_strided(before[-1], channels)))
    return nn.ModuleList(steps)


def _steps(transition: nn.ModuleList) -> list[nn.Module | None]:
    return [None if isinstance(step, nn.Identity) else step for step in transition]


def _stage(channels: tuple[int, ...], modules: int) -> nn.Sequential:
    return nn.Sequential(*(HighResolutionModule(channels) for _ in range(modules)))
