"""Which pairs of frames are shown to a predictor, and their frames, each read once and held no longer than needed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from learned.frames import resized_rgb
from vio.errors import RecordingError
from vio.recording import Recording


@dataclass(frozen=True)
class Pair:
    """Two frames by number; the same twice where only depth is wanted."""

    i: int
    j: int
    depth_wanted: bool


@dataclass(frozen=True)
class Shown:
    """A pair with its frames, (3, H, W) float32 in 0..1."""

    pair: Pair
    frame_i: torch.Tensor
    frame_j: torch.Tensor


def pairs_of(frames: int, baselines: tuple[int, ...], depth: bool) -> Iterator[Pair]:
    """Pairs of `frames` frames in order of their second frame; with `depth`, every frame's depth is wanted once."""
    ordered = sorted(baselines)
    for j in range(frames):
        yield from (Pair(j - n, j, depth and n == ordered[0]) for n in ordered if j >= n)
    if depth:
        yield from (Pair(frames - back, frames - back, True) for back in range(ordered[0], 0, -1))


class FrameReader:
    """Frames of a recording at a predictor's size, in order; what cannot be read is remembered with its reason.

    Args:
        recording: with images.
        size: (height, width), None = as recorded.
        held: how many of the latest frames stay in memory.
    """

    def __init__(self, recording: Recording, size: tuple[int, int] | None, held: int) -> None:
        self._recording, self._size, self._most = recording, size, held
        self._held: OrderedDict[int, torch.Tensor | None] = OrderedDict()
        self._shape: torch.Size | None = None
        self.unreadable: dict[int, str] = {}

    def shown(self, pairs: Iterable[Pair]) -> Iterator[Shown]:
        """Pairs whose frames can be read; where only the second cannot, the first's depth is still asked for.

        Raises:
            RecordingError: a frame of another size than those before.
        """
        for pair in pairs:
            first, second = self._frame(pair.i), self._frame(pair.j)
            if first is None:
                continue
            if second is not None:
                yield Shown(pair, first, second)
            elif pair.depth_wanted:
                yield Shown(Pair(pair.i, pair.i, True), first, first)

    def _frame(self, k: int) -> torch.Tensor | None:
        if k not in self._held:
            self._held[k] = self._read(k)
            while len(self._held) > self._most:
                self._held.popitem(last=False)
        return self._held[k]

    def _read(self, k: int) -> torch.Tensor | None:
        try:
            image = self._recording.frame(k)
        except RecordingError as error:
            self.unreadable[k] = error.nameless
            return None
        image = resized_rgb(image, self._size)
        frame = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).float() / 255
        if self._shape is not None and frame.shape != self._shape:
            raise RecordingError(f"frame {k}: {frame.shape[2]} x {frame.shape[1]} pixels after frames of "
                                 f"{self._shape[2]} x {self._shape[1]}; all frames of a recording must have one size")
        self._shape = frame.shape
        return frame
