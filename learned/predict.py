"""Recording → relative motions and depth maps: frames stream through a predictor in batches.

    motions = learned.predict(recording)                          # with the weights that come with the library
    motions = learned.predict(recording, "weights.safetensors")   # with others, or any `Predictor`

The driver knows nothing of networks. It reads every frame once and in order, keeps only the frames
that an open pair still needs, cuts the IMU windows, checks what comes back, and writes depth maps as
they come: memory does not grow with the recording, except for the motions themselves.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from learned.depth_maps import DepthMaps, depth_folder
from learned.errors import PredictionError
from learned.frames import resized_rgb
from learned.gyro_update import GyroRotations
from learned.network_predictor import NetworkPredictor, predictor_for
from learned.predictor import JudgesDepth, Predictor
from learned.weights import load_weights
from learned.windows import ImuWindows
from vio.errors import ConfigError, RecordingError
from vio.motions import RelativeMotions
from vio.recording import Recording

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
Rotation = Literal["network", "gyro"]

DEPTH_UNIT_M = 1e-5  # 0.01 mm per count reaches 655 mm, further than a capsule sees


@dataclass(frozen=True)
class Prediction(RelativeMotions):
    """Predicted motions, usable wherever `RelativeMotions` are, and the depth maps that came with them."""

    depth: tuple[Path, ...] | None = None
    """16-bit z-depth of every frame; None when no folder was asked for."""
    depth_sd: tuple[Path, ...] | None = None
    """16-bit standard deviation of ln depth of every frame; None when the weights cannot say, as `meta` does."""

    @property
    def motions(self) -> RelativeMotions:
        """The motions alone."""
        return self


@dataclass(frozen=True)
class _Item:
    i: int
    j: int
    frame_i: torch.Tensor
    frame_j: torch.Tensor
    depth_wanted: bool


@dataclass(frozen=True)
class _Batch:
    """The measured pairs of one batch, in numpy."""

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    T_i_j: Array
    cov: Array
    snr: Array | None


def predict(
    recording: Recording,
    predictor: Predictor | str | Path | None = None,
    *,
    batch_size: int = 8,
    rotation: Rotation = "network",
    depth_dir: str | Path | None = None,
    depth_unit_m: float = DEPTH_UNIT_M,
    progress: Progress | None = None,
) -> Prediction:
    """Measure the camera's motion between frames with a predictor.

    Args:
        recording: with images, and an IMU log if the predictor looks at it.
        predictor: what to measure with; a path = weights of `capsule-vio train`, None = those that come along.
        batch_size: pairs per call of the predictor; changes speed, not results.
        rotation: "network": what the images say, for a graph that fuses the gyro itself; "gyro": corrected by the
            integrated gyro, far better alone, but such motions must not meet the same gyro again (`meta` says so).
        depth_dir: where to write a depth map of every frame (layout: `learned.depth_maps`), metric at the
            prior scale. The last frames open no pair: they are shown twice and only their depth is kept.
        depth_unit_m: metres per count of the depth maps.
        progress: called with (pairs done, pairs in all) after every batch.

    Returns:
        One motion per pair, ordered by the second frame, then by baseline.

    Raises:
        WeightsError: weights that are missing, damaged, or a pickle.
        CameraError: no camera, or one too far from those that the weights were trained on.
        RecordingError: frames without images, too few frames, or an image that cannot be read, naming it.
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
    windows = ImuWindows(recording.imu, recording.imu_t_s, t, predictor.imu_samples_per_item, predictor.imu_rate_hz)
    meta: dict[str, Any] = {"source": "learned", "predictor": dict(predictor.card), "library_version": _version(),
                            "rotation": rotation}
    total = sum(max(len(recording) - baseline, 0) for baseline in predictor.baselines)
    done: list[_Batch] = []
    with ExitStack() as stack:
        maps = None
        if depth_dir is not None:
            scale = float(np.exp(predictor.scale_log_mean))
            maps = stack.enter_context(depth_folder(depth_dir, depth_unit_m, scale, meta))
            judged = predictor.depth_uncertainty_card if isinstance(predictor, JudgesDepth) else None
            maps.with_sd = judged is not None
            meta["depth_uncertainty"] = "never calibrated, so there are no sd maps" if judged is None else dict(judged)
        items = _items(recording, predictor, maps is not None)
        while batch := list(islice(items, batch_size)):
            done.append(_predict_batch(recording, predictor, windows, batch, maps))
            if progress is not None:
                progress(sum(len(part.i) for part in done), total)
    i, j = np.concatenate([part.i for part in done]), np.concatenate([part.j for part in done])
    snr = [part.snr for part in done if part.snr is not None]
    if len(snr) not in (0, len(done)):
        raise PredictionError("predictor: snr comes with some batches and not with others; give it always or never")
    meta["imu_windows_over_gaps"] = int(windows.over_gap(t[i]).sum())
    T, cov = np.concatenate([part.T_i_j for part in done]), np.concatenate([part.cov for part in done])
    if gyro is not None:
        T, cov, meta["pairs_without_gyro"] = gyro.correct(T, cov, i, j)
    return Prediction(
        t_i_s=t[i], t_j_s=t[j], T_i_j=T, cov=cov,
        scale_log_mean=predictor.scale_log_mean, scale_log_sd=predictor.scale_log_sd,
        snr=np.concatenate(snr) if snr else None, meta=meta,
        depth=None if maps is None else maps.files, depth_sd=None if maps is None else maps.sd_files,
    )


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


def _items(recording: Recording, predictor: Predictor, depth: bool) -> Iterator[_Item]:
    """Pairs in order of their second frame; holds no more frames than the widest baseline spans."""
    baselines = sorted(predictor.baselines)
    held: deque[torch.Tensor] = deque(maxlen=baselines[-1])
    for j in range(len(recording)):
        frame = _load(recording, j, predictor.image_size, held[-1].shape if held else None)
        for baseline in baselines:
            if j >= baseline:
                yield _Item(j - baseline, j, held[-baseline], frame, depth and baseline == baselines[0])
        held.append(frame)
    if depth:
        for back in range(baselines[0], 0, -1):
            k = len(recording) - back
            yield _Item(k, k, held[-back], held[-back], True)


def _load(
    recording: Recording, k: int, size: tuple[int, int] | None, expected: torch.Size | None
) -> torch.Tensor:
    """Frame k as (3, H, W) float32 in 0..1, R, G, B."""
    image = resized_rgb(recording.frame(k), size)
    frame = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).float() / 255
    if expected is not None and frame.shape != expected:
        raise RecordingError(
            f"frame {k}: {frame.shape[2]} x {frame.shape[1]} pixels after frames of {expected[2]} x {expected[1]}; "
            "all frames of a recording must have one size"
        )
    return frame


def _predict_batch(
    recording: Recording, predictor: Predictor, windows: ImuWindows, batch: list[_Item], maps: DepthMaps | None
) -> _Batch:
    imu = torch.from_numpy(windows.at(recording.frame_t_s[[item.i for item in batch]])).float()
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
    pair = np.array([item.i != item.j for item in batch])
    i, j = np.array([item.i for item in batch], np.int64), np.array([item.j for item in batch], np.int64)
    return _Batch(i[pair], j[pair], T[pair], cov[pair], None if snr is None else snr[pair])


def _numbers(values: torch.Tensor, name: str, shape: tuple[int, ...], batch: list[_Item]) -> Array:
    """The tensor in numpy, after a look at its shape and its values."""
    if tuple(values.shape) != shape:
        raise PredictionError(f"predictor: {name} has shape {tuple(values.shape)}, expected {shape}: one entry a pair")
    array = values.detach().cpu().double().numpy()
    finite = np.isfinite(array).reshape(len(array), -1).all(axis=1)
    if not finite.all():
        item = batch[int(np.argmin(finite))]
        raise PredictionError(
            f"predictor: {name} of frames {item.i} to {item.j} is not finite; look at these frames or use other weights"
        )
    return np.asarray(array)


def _write_depth(
    recording: Recording, predictor: Predictor, depth: torch.Tensor | None, batch: list[_Item], maps: DepthMaps
) -> None:
    if depth is None:
        raise PredictionError("predictor: it predicts no depth; leave the depth folder (`--depth`) out")
    if depth.ndim != 3 or len(depth) != len(batch):
        raise PredictionError(
            f"predictor: depth_i has shape {tuple(depth.shape)} for {len(batch)} pairs, expected ({len(batch)}, h, w)"
        )
    camera, sd = recording.calibration.camera, _depth_sd(predictor, depth, batch) if maps.with_sd else None
    for n, (item, values) in enumerate(zip(batch, depth.detach().cpu().double().numpy(), strict=True)):
        if item.depth_wanted:
            shape = tuple(values.shape) if camera is None else (camera.height, camera.width)
            maps.write(int(recording.frame_t_ns[item.i]), values, (shape[0], shape[1]), None if sd is None else sd[n])


def _depth_sd(predictor: Predictor, depth: torch.Tensor, batch: list[_Item]) -> Array | None:
    """Standard deviation (B, h, w) of ln depth, after a look at it."""
    if not isinstance(predictor, JudgesDepth):
        return None
    found = predictor.log_depth_sd(torch.stack([item.frame_i for item in batch]), depth)
    if found is None:
        return None
    sd = found.detach().cpu().double().numpy()
    if sd.shape != tuple(depth.shape) or not (np.isfinite(sd) & (sd > 0)).all():
        raise PredictionError(f"predictor: log_depth_sd of frames {batch[0].i} to {batch[-1].i} has shape {sd.shape}, "
                              f"expected {tuple(depth.shape)} with finite positive values; calibrate again")
    return np.asarray(sd)


def _version() -> str:
    try:
        return version("capsule-vio")
    except PackageNotFoundError:
        return "not installed"
