"""One pass of a predictor over a recording: batches of pairs in, measured pairs and depth maps out, part by part."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray

from learned.depth_maps import DepthMaps
from learned.errors import PredictionError
from learned.pairs import FrameReader, Pair, Shown, pairs_of
from learned.predictor import JudgesDepth, Predictor
from learned.unfinished import MeasuredPairs, Part, Unfinished
from learned.windows import ImuWindows
from vio.recording import Recording

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

PAIRS_KEPT = 512
"""About how many pairs an interrupted prediction may lose."""


@dataclass
class PredictionRun:
    """One pass over a recording."""

    recording: Recording
    predictor: Predictor
    batch_size: int
    progress: Progress | None
    maps: DepthMaps | None = None
    unfinished: Unfinished | None = None
    done: list[MeasuredPairs] = field(default_factory=list)
    unreadable: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.windows = ImuWindows(self.recording.imu, self.recording.imu_t_s, self.recording.frame_t_s,
                                  self.predictor.imu_samples_per_item, self.predictor.imu_rate_hz)
        self.smallest_batch = self.batch_size
        self.reader = FrameReader(self.recording, self.predictor.image_size, max(self.predictor.baselines) + 1)

    def measure(self) -> None:
        """Show all pairs that no earlier run has measured to the predictor."""
        every = list(pairs_of(len(self.recording), self.predictor.baselines, self.maps is not None))
        passed = self._take_up()
        part = max(1, PAIRS_KEPT // self.batch_size) * self.batch_size
        for first in range(passed, len(every), part):
            self._measure_part(every[first: first + part], first, len(every))

    def mark_unreadable(self) -> None:
        """Frames that cannot be read get a map that knows nothing, so that maps and frames stay side by side."""
        if self.maps is not None:
            for k in self.unreadable:
                shape = _frame_shape(self.recording, (1, 1))
                self.maps.write(int(self.recording.frame_t_ns[k]), np.zeros(shape), shape)

    def _take_up(self) -> int:
        parts = [] if self.unfinished is None else self.unfinished.taken_up()
        if self.maps is not None and self.unfinished is not None:
            self.unfinished.restore_maps(parts, self.maps.folders)
            self.maps.names += [name for part in parts for name in part.maps]
        for part in parts:
            self.done += part.measured
            self.unreadable |= part.unreadable
        return sum(part.pairs_passed for part in parts)

    def _measure_part(self, pairs: list[Pair], passed: int, total: int) -> None:
        measured: list[MeasuredPairs] = []
        shown = passed
        maps_before = 0 if self.maps is None else len(self.maps.names)
        for batch in _batches(self.reader.shown(pairs), self.batch_size):
            measured += self._fitting(batch)
            shown += len(batch)
            if self.progress is not None:
                self.progress(shown, total)
        self.done += measured
        unreadable = {k: reason for k, reason in self.reader.unreadable.items() if k not in self.unreadable}
        self.unreadable |= unreadable
        if self.unfinished is not None:
            names = [] if self.maps is None else self.maps.names[maps_before:]
            self.unfinished.keep(Part(len(pairs), measured, unreadable, names),
                                 () if self.maps is None else self.maps.folders)

    def _fitting(self, batch: list[Shown]) -> list[MeasuredPairs]:
        """One batch, in halves where the accelerator's memory does not hold it."""
        try:
            return [_predict_batch(self.recording, self.predictor, self.windows, batch, self.maps)]
        except torch.OutOfMemoryError:
            if len(batch) == 1:
                raise PredictionError("predictor: one pair of frames does not fit the accelerator's memory; use the "
                                      "CPU (CUDA_VISIBLE_DEVICES=) or smaller weights") from None
        torch.cuda.empty_cache()
        middle = len(batch) // 2
        self.smallest_batch = min(self.smallest_batch, middle)
        return [*self._fitting(batch[:middle]), *self._fitting(batch[middle:])]


def _batches(items: Iterator[Shown], size: int) -> Iterator[list[Shown]]:
    while batch := list(islice(items, size)):
        yield batch


def _predict_batch(
    recording: Recording, predictor: Predictor, windows: ImuWindows, batch: list[Shown], maps: DepthMaps | None
) -> MeasuredPairs:
    imu = torch.from_numpy(windows.at(recording.frame_t_s[[item.pair.i for item in batch]])).float()
    with torch.inference_mode():
        out = predictor.predict(
            torch.stack([item.frame_i for item in batch]), torch.stack([item.frame_j for item in batch]), imu
        )
    n = len(batch)
    T = _numbers(out.T_i_j, "T_i_j", (n, 4, 4), batch)
    cov = _numbers(out.cov, "cov", (n, 6, 6), batch)
    snr = None if out.snr is None else _numbers(out.snr, "snr", (n,), batch)
    if maps is not None:
        _write_depth(recording, predictor, out.depth_i, batch, maps)
    i, j = np.array([(item.pair.i, item.pair.j) for item in batch], np.int64).T
    pair = i != j
    return MeasuredPairs(i[pair], j[pair], T[pair], cov[pair], None if snr is None else snr[pair])


def _numbers(values: torch.Tensor, name: str, shape: tuple[int, ...], batch: list[Shown]) -> Array:
    """The tensor in numpy, after a look at its shape and its values."""
    if tuple(values.shape) != shape:
        raise PredictionError(f"predictor: {name} has shape {tuple(values.shape)}, expected {shape}: one entry a pair")
    array = values.detach().cpu().double().numpy()
    finite = np.isfinite(array).reshape(len(array), -1).all(axis=1)
    if not finite.all():
        pair = batch[int(np.argmin(finite))].pair
        raise PredictionError(
            f"predictor: {name} of frames {pair.i} to {pair.j} is not finite; look at these frames or use other weights"
        )
    return np.asarray(array)


def _write_depth(
    recording: Recording, predictor: Predictor, depth: torch.Tensor | None, batch: list[Shown], maps: DepthMaps
) -> None:
    if depth is None:
        raise PredictionError("predictor: it predicts no depth; leave the depth folder (`--depth`) out")
    if depth.ndim != 3 or len(depth) != len(batch):
        raise PredictionError(
            f"predictor: depth_i has shape {tuple(depth.shape)} for {len(batch)} pairs, expected ({len(batch)}, h, w)"
        )
    sd = _depth_sd(predictor, depth, batch) if maps.with_sd else None
    for n, (item, values) in enumerate(zip(batch, depth.detach().cpu().double().numpy(), strict=True)):
        if item.pair.depth_wanted:
            shape = _frame_shape(recording, (values.shape[0], values.shape[1]))
            maps.write(int(recording.frame_t_ns[item.pair.i]), values, shape, None if sd is None else sd[n])


def _depth_sd(predictor: Predictor, depth: torch.Tensor, batch: list[Shown]) -> Array | None:
    """Standard deviation (B, h, w) of ln depth, after a look at it."""
    if not isinstance(predictor, JudgesDepth):
        return None
    found = predictor.log_depth_sd(torch.stack([item.frame_i for item in batch]), depth)
    if found is None:
        return None
    sd = found.detach().cpu().double().numpy()
    if sd.shape != tuple(depth.shape) or not (np.isfinite(sd) & (sd > 0)).all():
        raise PredictionError(f"predictor: log_depth_sd of frames {batch[0].pair.i} to {batch[-1].pair.i} has shape "
                              f"{sd.shape}, expected {tuple(depth.shape)} with finite positive values; calibrate again")
    return np.asarray(sd)


def _frame_shape(recording: Recording, otherwise: tuple[int, int]) -> tuple[int, int]:
    camera = recording.calibration.camera
    return otherwise if camera is None else (camera.height, camera.width)
