"""Band-limited random fields on the unrolled wall: endless along it, periodic around it, made block by block.

A field's value depends only on its seed and its place, never on which rows were asked for first, so a wall of any
length can be visited in any order with constant memory.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Field = NDArray[np.float32]
Item = TypeVar("Item")


class BandNoise:
    """Noise of zero mean and unit variance with wavelengths between two limits.

    Args:
        seed: integers; equal seeds give equal fields.
        columns: width of the field, which closes on itself.
        pixel_m: size of a pixel along and around [m].
        shortest_m, longest_m: the band of wavelengths.
        fall: amplitude falls with the wave number to this power.
        blocks_kept: how many blocks stay in memory.
    """

    def __init__(self, seed: tuple[int, ...], columns: int, pixel_m: tuple[float, float], shortest_m: float,
                 longest_m: float, fall: float = 0.0, blocks_kept: int = 4) -> None:
        self._seed, self._columns = seed, columns
        self._overlap = int(np.ceil(0.5 * longest_m / pixel_m[0]))
        self._block = max(256, int(np.ceil(1.5 * longest_m / pixel_m[0])))
        self._rows = fft.next_fast_len(self._block + self._overlap, real=True)
        self._amplitude = _band((self._rows, columns), pixel_m, shortest_m, longest_m, fall)
        ramp = (np.arange(self._overlap, dtype=np.float32) + 0.5) / self._overlap * np.float32(np.pi / 2)
        self._rising, self._falling = np.sin(ramp)[:, None], np.cos(ramp)[:, None]
        self._blocks: Recent[Field] = Recent(blocks_kept)

    def rows(self, first: int, last: int) -> Field:
        """Values (last - first, columns) float32 of rows `first` (may be negative) up to `last`, exclusive."""
        blocks = range(first // self._block, (last - 1) // self._block + 1)
        parts = []
        for k in blocks:
            whole = self._blocks.get(k, self._block_values)[: self._block].copy()
            whole[: self._overlap] *= self._rising
            before = self._blocks.get(k - 1, self._block_values)
            whole[: self._overlap] += self._falling * before[self._block:][: self._overlap]
            parts.append(whole)
        start = blocks[0] * self._block
        return np.concatenate(parts)[first - start: last - start]

    def _block_values(self, k: int) -> Field:
        rng = np.random.default_rng([*self._seed, k + 1_000_000])
        white = rng.standard_normal((self._rows, self._columns), dtype=np.float32)
        out: Field = fft.irfft2(fft.rfft2(white) * self._amplitude, s=white.shape)
        return out


class Recent(Generic[Item]):
    """Things with a number, made when they are asked for; the most recent ones are kept.

    How to make one is said at every call: a stored method would tie its owner into a cycle, and large arrays would wait
    for the garbage collector.
    """

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self._items: OrderedDict[int, Item] = OrderedDict()

    def get(self, k: int, make: Callable[[int], Item]) -> Item:
        """Item k, made by `make(k)` if it is not kept."""
        if k not in self._items:
            self._items[k] = make(k)
        self._items.move_to_end(k)
        while len(self._items) > self._kept:
            self._items.popitem(last=False)
        return self._items[k]


def block_rows(blocks: Recent[Field], block: int, first: int, last: int, make: Callable[[int], Field]) -> Field:
    """Rows `first` (at least 0) up to `last`, exclusive, of an endless array made in blocks; the caller's own copy."""
    numbers = range(first // block, (last - 1) // block + 1)
    joined = np.concatenate([blocks.get(k, make) for k in numbers])
    start = numbers[0] * block
    return joined[first - start: last - start]


def _band(shape: tuple[int, int], pixel_m: tuple[float, float], shortest_m: float, longest_m: float,
          fall: float) -> Field:
    """Amplitude per wave of a field of unit variance, soft at both ends of the band."""
    along = np.fft.fftfreq(shape[0], pixel_m[0])[:, None]
    around = np.fft.rfftfreq(shape[1], pixel_m[1])[None]
    f = np.hypot(along, around)
    f[0, 0] = 1e-9
    amplitude = np.exp(-(f * shortest_m) ** 4 - (1 / (f * longest_m)) ** 4) * (f * longest_m) ** -fall
    weight = np.full(amplitude.shape[1], 2.0)  # rfft keeps one of each pair of conjugate waves
    weight[0] = 1.0
    if shape[1] % 2 == 0:
        weight[-1] = 1.0
    variance = float(np.sum(weight * amplitude**2)) / (shape[0] * shape[1])
    out: Field = (amplitude / np.sqrt(variance)).astype(np.float32)
    return out
