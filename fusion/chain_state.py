"""The unknowns of a chain of frames as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vio import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ChainState:
    """Values at M frames, and of K log scales."""

    R: Array
    """(M, 3, 3) attitude of the body in the world."""
    p: Array
    """(M, 3) position [m]."""
    v: Array
    """(M, 3) velocity in the world [m/s]."""
    accel_bias: Array
    """(M, 3) [m/s²]"""
    gyro_bias: Array
    """(M, 3) [rad/s]"""
    log_scale: Array
    """(K,) one per segment; empty where scale is held."""

    def __len__(self) -> int:
        return len(self.R)

    @property
    def T_world_body(self) -> Array:
        """(M, 4, 4)"""
        return se3.transform(self.R, self.p)

    def moved(self, delta: Array, of_node: NDArray[np.int64] | None) -> ChainState:
        """The state after a step.

        Args:
            delta: (M, 16) log scale, rotation and translation in body axes, velocity, accelerometer and gyro bias.
            of_node: (M,) segment of every frame, whose copies of a log scale agree; None where scale is held.
        """
        log_scale = self.log_scale
        if of_node is not None:
            log_scale = log_scale + np.bincount(of_node, delta[:, 0]) / np.bincount(of_node)
        return ChainState(self.R @ se3.so3_exp(delta[:, 1:4]), self.p + (self.R @ delta[:, 4:7, None])[:, :, 0],
                          self.v + delta[:, 7:10], self.accel_bias + delta[:, 10:13], self.gyro_bias + delta[:, 13:16],
                          log_scale)

    def part(self, first: int, last: int) -> ChainState:
        """Frames `first` to `last` (exclusive)."""
        cut = slice(first, last)
        return ChainState(self.R[cut], self.p[cut], self.v[cut], self.accel_bias[cut], self.gyro_bias[cut],
                          self.log_scale)

    @staticmethod
    def joined(parts: Sequence[ChainState]) -> ChainState:
        """Consecutive parts as one, scale held."""
        fields = [[part.R, part.p, part.v, part.accel_bias, part.gyro_bias] for part in parts]
        R, p, v, accel_bias, gyro_bias = (np.concatenate(arrays) for arrays in zip(*fields, strict=True))
        return ChainState(R, p, v, accel_bias, gyro_bias, np.zeros(0))
