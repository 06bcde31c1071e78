"""Recording → relative motions and depth maps: frames stream through a predictor in batches.

    motions = learned.predict(recording)                          # with the weights that come with the library
    motions = learned.predict(recording, "weights.safetensors")   # with others, or any `Predictor`

The driver knows nothing of networks. It reads every frame once and in order, keeps only the frames
that an open pair still needs, cuts the IMU windows, checks what comes back, and writes depth maps as
they come: memory does not grow with the recording, except for the motions themselves. Frames that
cannot be read lose their motions and are named; nothing stands in for their pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from learned.depth_maps import DepthMaps, depth_folder
from learned.errors import PredictionError
from learned.gyro_update import GyroRotations
from learned.network_predictor import NetworkPredictor, predictor_for
from learned.pairs import FrameReader, Pair, Shown, pairs_of
from learned.predictor import Predictor
from learned.unfinished import MeasuredPairs, Part, Unfinished, images_digest
from learned.weights import load_weights
from learned.windows import ImuWindows
from vio.errors import ConfigError, RecordingError
from vio.motions import RelativeMotions
from vio.recording import Recording

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
Rotation = Literal["network", "gyro"]

DEPTH_UNIT_M = 1e-5  # 0.01 mm per count reaches 655 mm, further than a capsule sees
PAIRS_KEPT = 512
"""About how many pairs an interrupted prediction may lose."""


@dataclass(frozen=True)
class Prediction(RelativeMotions):
    """Predicted motions, usable wherever `RelativeMotions` are, and the depth maps that came with them."""

    depth: tuple[Path, ...] | None = None
    """16-bit z-depth of every frame, unknown where a frame cannot be read; None when no folder was asked for."""

    @property
    def motions(self) -> RelativeMotions:
        """The motions alone."""
        return self


def predict(
    recording: Recording,
    predictor: Predictor | str | Path | None = None,
    *,
    batch_size: int = 8,
    rotation: Rotation = "network",
    depth_dir: str | Path | None = None,
    depth_unit_m: float = DEPTH_UNIT_M,
    unfinished: str | Path | None = None,
    progress: Progress | None = None,
) -> Prediction:
    """Measure the camera's motion between frames with a predictor.

    Args:
        recording: with images, and an IMU log if the predictor looks at it.
        predictor: what to measure with; a path = weights of `capsule-vio train`, None = those that come along.
        batch_size: pairs per call of the predictor; changes speed, not results. A batch that the accelerator's memory
            does not hold is halved, and `meta` says what fitted (`batch_size_that_fitted`).
        rotation: "network": what the images say, for a graph that fuses the gyro itself; "gyro": corrected by the
            integrated gyro, far better alone, but such motions must not meet the same gyro again (`meta` says so).
        depth_dir: where to write a depth map of every frame (layout: `learned.depth_maps`), metric at the
            prior scale. The last frames open no pair: they are shown twice and only their depth is kept.
        depth_unit_m: metres per count of the depth maps.
        unfinished: a folder for what is measured so far. A prediction that was stopped goes on from there to the same
            result; the folder is removed at the end. None = nothing is kept.
        progress: called with (pairs done, pairs in all) after every batch.

    Returns:
        One motion per pair of readable frames, ordered by the second frame, then by baseline. `meta` lists the frames
        that cannot be read (`unreadable_frames`: number and reason).

    Raises:
        WeightsError: weights that are missing, damaged, or a pickle.
        CameraError: no camera, or one too far from those that the weights were trained on.
        RecordingError: frames without images, too few frames, frames of different sizes, or no pair that can be read.
        ImuError: the predictor needs an IMU log that is absent or does not cover the frames.
        PredictionError: the predictor's output breaks its contract, naming the frames.
        ConfigError: an unknown `rotation`, or "gyro" without weights that know the gyro's error.
        OutputError: the depth maps cannot be written.
    """
    if batch_size < 1:
        raise ConfigError(f"batch_size is {batch_size}, must be at least 1")
    if predictor is None or isinstance(predictor, (str, Path)):
        predictor = predictor_for(recording, load_weights(predictor))
    _check(recording, predictor)
    gyro = _gyro(recording, predictor) if _wants_gyro(rotation) else None
    t = recording.frame_t_s
    meta: dict[str, Any] = {"source": "learned", "predictor": dict(predictor.card), "library_version": _version(),
                            "rotation": rotation}
    run = _Run(recording, predictor, batch_size, progress)
    with ExitStack() as stack:
        if depth_dir is not None:
            scale = float(np.exp(predictor.scale_log_mean))
            run.maps = stack.enter_context(depth_folder(depth_dir, depth_unit_m, scale, meta))
        if unfinished is not None:
            run.unfinished = Unfinished(unfinished, _question(recording, predictor, batch_size, run.maps))
        run.measure()
        run.mark_unreadable()
        i, j, T, cov, snr = _joined(run.done, recording, run.unreadable)
    meta["imu_windows_over_gaps"] = int(run.windows.over_gap(t[i]).sum())
    meta["unreadable_frames"] = {str(k): reason for k, reason in sorted(run.unreadable.items())}
    if run.smallest_batch < batch_size:
        meta["batch_size_that_fitted"] = run.smallest_batch
    if gyro is not None:
        T, cov, meta["pairs_without_gyro"] = gyro.correct(T, cov, i, j)
    prediction = Prediction(
        t_i_s=t[i], t_j_s=t[j], T_i_j=T, cov=cov,
        scale_log_mean=predictor.scale_log_mean, scale_log_sd=predictor.scale_log_sd,
        snr=snr, meta=meta, depth=None if run.maps is None else run.maps.files,
    )
    if run.unfinished is not None:
        run.unfinished.discard()
    return prediction


@dataclass
class _Run:
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
            self.unfinished.restore_maps(parts, self.maps.images)
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
                                 None if self.maps is None else self.maps.images)


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


def _question(recording: Recording, predictor: Predictor, batch_size: int, maps: DepthMaps | None) -> dict[str, Any]:
    """All that decides what is measured."""
    return {"images": images_digest(recording), "predictor": dict(predictor.card), "batch_size": batch_size,
            "baselines": list(predictor.baselines), "depth_unit_m": None if maps is None else maps.unit_m,
            "library_version": _version()}


def _joined(done: list[MeasuredPairs], recording: Recording, unreadable: dict[int, str],
            ) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array, Array | None]:
    """All measured pairs in order: frames i and j, motions, covariances, SNR."""
    if not any(len(part.i) for part in done):
        first = min(unreadable)
        raise RecordingError(f"recording {recording.name}: no two frames to compare can be read; {unreadable[first]}")
    snr = [part.snr for part in done if part.snr is not None]
    if len(snr) not in (0, len(done)):
        raise PredictionError("predictor: snr comes with some batches and not with others; give it always or never")
    i, j, T, cov = (np.concatenate([getattr(part, name) for part in done]) for name in ("i", "j", "T_i_j", "cov"))
    return i, j, T, cov, np.concatenate(snr) if snr else None


def _wants_gyro(rotation: str) -> bool:
    if rotation not in get_args(Rotation):
        raise ConfigError(f"rotation {rotation!r} is unknown; use one of {', '.join(get_args(Rotation))}")
    return rotation == "gyro"


def _gyro(recording: Recording, predictor: Predictor) -> GyroRotations:
    sd = predictor.weights.card.get("gyro_sd_rad") if isinstance(predictor, NetworkPredictor) else None
    if sd is None:
        raise ConfigError("rotation='gyro': only weights calibrated with an IMU know how wrong a gyro's rotation is; "
                          "use rotation='network'")
    return GyroRotations(recording, float(sd))


def _check(recording: Recording, predictor: Predictor) -> None:
    baselines = predictor.baselines
    if not baselines or min(baselines) < 1 or len(set(baselines)) != len(baselines):
        raise PredictionError(f"predictor: baselines {baselines}, must be different frame distances of at least 1")
    if len(recording) <= min(baselines):
        raise RecordingError(
            f"recording {recording.name}: {len(recording)} frame(s), too few for a pair {min(baselines)} apart"
        )
    if not recording.has_images:
        raise RecordingError(
            f"recording {recording.name}: images are missing; restore cam0/data, or give motions with `--motions`"
        )


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
        _write_depth(recording, out.depth_i, batch, maps)
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
    recording: Recording, depth: torch.Tensor | None, batch: list[Shown], maps: DepthMaps
) -> None:
    if depth is None:
        raise PredictionError("predictor: it predicts no depth; leave the depth folder (`--depth`) out")
    if depth.ndim != 3 or len(depth) != len(batch):
        raise PredictionError(
            f"predictor: depth_i has shape {tuple(depth.shape)} for {len(batch)} pairs, expected ({len(batch)}, h, w)"
        )
    for item, values in zip(batch, depth.detach().cpu().double().numpy(), strict=True):
        if item.pair.depth_wanted:
            shape = _frame_shape(recording, (values.shape[0], values.shape[1]))
            maps.write(int(recording.frame_t_ns[item.pair.i]), values, shape)


def _frame_shape(recording: Recording, otherwise: tuple[int, int]) -> tuple[int, int]:
    camera = recording.calibration.camera
    return otherwise if camera is None else (camera.height, camera.width)


def _version() -> str:
    try:
        return version("capsule-vio")
    except PackageNotFoundError:
        return "not installed"
