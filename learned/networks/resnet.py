"""ResNet encoders with 18, 34 or 50 layers (He et al., CVPR 2016), for one or several images, at any width.

Parameter names are those of ImageNet state dicts (`conv1.weight`, `layer1.0.bn2.bias`, …), the classifier is left out.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.networks.encoder import Encoder, FuseBlock, keep_features, normalise_image, scaled
from vio.errors import ConfigError

BLOCKS = {18: (2, 2, 2, 2), 34: (3, 4, 6, 3), 50: (3, 4, 6, 3)}
"""Residual blocks per stage."""


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut."""

    expansion = 1

    def __init__(self, inputs: int, planes: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, planes, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(planes)
        self.conv2 = nn.Conv2d(planes, planes, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(planes)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = shortcut(inputs, planes, stride)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) → (N, planes, H / stride, W / stride)."""
        y = self.bn2(self.conv2(self.relu(self.bn1(self.conv1(x)))))
        out: Tensor = self.relu(y + (x if self.downsample is None else self.downsample(x)))
        return out


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 convolutions and a shortcut; four times as many channels come out."""

    expansion = 4

    def __init__(self, inputs: int, planes: int, stride: int = 1) -> None:
        super().__init__()
        outputs = planes * self.expansion
        self.conv1 = nn.Conv2d(inputs, planes, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(planes)
        self.conv2 = nn.Conv2d(planes, planes, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(planes)
        self.conv3 = nn.Conv2d(planes, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = shortcut(inputs, outputs, stride)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) → (N, 4 planes, H / stride, W / stride)."""
        y = self.relu(self.bn1(self.conv1(x)))
        y = self.relu(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        out: Tensor = self.relu(y + (x if self.downsample is None else self.downsample(x)))
        return out


def shortcut(inputs: int, outputs: int, stride: int) -> nn.Sequential | None:
    """A projection where the shapes differ, nothing where they do not."""
    if stride == 1 and inputs == outputs:
        return None
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))


def residual_stage(
    block: type[BasicBlock] | type[Bottleneck], inputs: int, planes: int, count: int, stride: int
) -> nn.Sequential:
    """`count` residual blocks, the first of which strides."""
    later = planes * block.expansion
    return nn.Sequential(block(inputs, planes, stride), *(block(later, planes) for _ in range(count - 1)))


def initialise_convolutions(module: nn.Module) -> None:
    """He-normal by fan-out for every convolution, as ResNets are trained from scratch."""
    for part in module.modules():
        if isinstance(part, nn.Conv2d):
            nn.init.kaiming_normal_(part.weight, mode="fan_out", nonlinearity="relu")
            if part.bias is not None:
                nn.init.zeros_(part.bias)


class ResNetEncoder(Encoder):
    """The trunk of a ResNet: five maps at strides 2, 4, 8, 16, 32; the fused blocks are the stem and the four stages.

    Args:
        layers: 18, 34 or 50.
        images: how many RGB images are stacked along the channels: 1, or 2 for a pair.
        width: factor on all channels; 1 is the published size (11,176,512 parameters at 18 layers).
        after_stem: a module between the stem and the first stage, such as spatial attention.

    Raises:
        ConfigError: another number of layers.
    """

    def __init__(self, layers: int = 18, images: int = 1, width: float = 1.0,
                 after_stem: nn.Module | None = None) -> None:
        super().__init__()
        if layers not in BLOCKS:
            raise ConfigError(f"ResNet with {layers} layers: unknown, choose one of {sorted(BLOCKS)}")
        block = Bottleneck if layers == 50 else BasicBlock
        base = scaled(64, width)
        self.conv1 = nn.Conv2d(3 * images, base, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(base)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        planes = [base, 2 * base, 4 * base, 8 * base]
        inputs = [base, *(p * block.expansion for p in planes)]
        self.layer1 = residual_stage(block, inputs[0], planes[0], BLOCKS[layers][0], 1)
        self.layer2 = residual_stage(block, inputs[1], planes[1], BLOCKS[layers][1], 2)
        self.layer3 = residual_stage(block, inputs[2], planes[2], BLOCKS[layers][2], 2)
        self.layer4 = residual_stage(block, inputs[3], planes[3], BLOCKS[layers][3], 2)
        initialise_convolutions(self)
        self.after_stem = after_stem
        self.channels = tuple(inputs)

    def forward(self, images: Tensor, fuse: FuseBlock = keep_features) -> list[Tensor]:
        """(N, 3 images, H, W) in 0..1 → five maps, finest first."""
        x = self.relu(self.bn1(self.conv1(normalise_image(images))))
        if self.after_stem is not None:
            x = self.after_stem(x)
        maps = [fuse(0, x)]
        x = self.maxpool(maps[0])
        for block, layer in enumerate((self.layer1, self.layer2, self.layer3, self.layer4), 1):
            x = fuse(block, layer(x))
            maps.append(x)
        return maps


def pair_of(first: Tensor, second: Tensor) -> Tensor:
    """Two images (N, 3, H, W) stacked along the channels."""
    return torch.cat([first, second], 1)
