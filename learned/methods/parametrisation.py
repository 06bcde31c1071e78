"""From a network's raw numbers to depth and motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from learned.lie import inverse, rotation_from_euler_xyz, so3_exp, transform
from vio.errors import ConfigError

ROTATIONS = {"euler_xyz": rotation_from_euler_xyz, "vector": so3_exp}
ORDERS = ("rotation_first", "translation_first")
PAIR_ORDERS = ("i_then_j", "j_then_i", "temporal")


@dataclass(frozen=True)
class DepthRange:
    """Depth from a disparity s in 0..1: depth = 1 / (1/farthest + (1/nearest - 1/farthest) s), in motion units.

    Raises:
        ConfigError: not 0 < nearest < farthest.
    """

    nearest: float
    farthest: float

    def __post_init__(self) -> None:
        if not 0 < self.nearest < self.farthest:
            raise ConfigError(f"depth range {self.nearest:g} to {self.farthest:g}: need 0 < nearest < farthest")

    def depth(self, disparity: Tensor) -> Tensor:
        """Any shape, 0..1 → z-depth in motion units."""
        far, near = 1 / self.farthest, 1 / self.nearest
        return 1 / (far + (near - far) * disparity)

    def disparity(self, depth: float) -> float:
        """The disparity of a depth within the range."""
        far, near = 1 / self.farthest, 1 / self.nearest
        return (1 / depth - far) / (near - far)


@dataclass(frozen=True)
class PoseParametrisation:
    """How six raw numbers of an ordered pair of images are read as T_i_j, the pose of camera j in camera i.

    Raises:
        ConfigError: an unknown name, or a scale that is not positive.
    """

    rotation: str = "vector"
    """"vector": rotation vector; "euler_xyz": R = Rx Ry Rz."""
    order: str = "rotation_first"
    """Which three numbers come first."""
    scale: float = 0.01
    """All six are multiplied by it, so that an untrained network predicts small motions."""
    pair_order: str = "i_then_j"
    """Which image the network sees first when T_i_j is wanted. Its motion maps points of the second camera to the first
    with "i_then_j", and of the first to the second with "j_then_i". "temporal" shows the earlier frame first, maps its
    points to the later camera, and inverts where the other direction is wanted."""

    in_depths: bool = False
    """The translation of T_i_j is a share of the typical depth of frame i, which is what two images show. In units of
    its own, a pose network has to learn how near everything is together with the depth network, or the images no longer
    match: measured, neither began, and every image's median depth came out as one unit."""

    def __post_init__(self) -> None:
        for value, known in ((self.rotation, ROTATIONS), (self.order, ORDERS), (self.pair_order, PAIR_ORDERS)):
            if value not in known:
                raise ConfigError(f"pose parametrisation {value!r}: unknown, choose one of {', '.join(known)}")
        if not self.scale > 0:
            raise ConfigError(f"pose scale {self.scale:g}: must be positive")

    def images(self, i: int, j: int) -> tuple[int, int]:
        """Numbers of the frames that the network sees first and second for T_i_j."""
        if self.pair_order == "temporal":
            return min(i, j), max(i, j)
        return (i, j) if self.pair_order == "i_then_j" else (j, i)

    def motions(self, raw: Tensor, pairs: Sequence[tuple[int, int]], typical: Mapping[int, Tensor]) -> Tensor:
        """Raw numbers (N, P, 6) of the images of P pairs in that order → T_i_j (N, P, 4, 4) in motion units.

        Args:
            raw: (N, P, 6).
            pairs: numbers i of the frames whose cameras T_i_j are told in, and j of the others.
            typical: by frame, (N,) `typical_depth` of every frame i; wanted with `in_depths`.
        """
        numbers = self.scale * (raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw)
        first, second = numbers[..., :3], numbers[..., 3:]
        turn, shift = (first, second) if self.order == "rotation_first" else (second, first)
        if self.in_depths:
            shift = shift * torch.stack([typical[i].to(shift.dtype) for i, _ in pairs], 1)[..., None]
        T = transform(ROTATIONS[self.rotation](turn), shift)
        if self.pair_order != "temporal":
            return T
        ahead = torch.tensor([i < j for i, j in pairs], device=T.device)
        return torch.where(ahead[:, None, None], inverse(T), T)


def typical_depth(depth: Tensor) -> Tensor:
    """(N,) geometric mean of depth (N, 1, H, W)."""
    return depth.log().mean((1, 2, 3)).exp()
