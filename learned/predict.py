"""Recording → relative motions and depth maps: frames stream through a predictor in batches.

    motions = learned.predict(recording)                          # with the weights that come with the library
    motions = learned.predict(recording, "weights.safetensors")   # with others, or any `Predictor`

The driver knows nothing of networks. It reads every frame once and in order, keeps only the frames
that an open pair still needs, cuts the IMU windows, checks what comes back, and writes depth maps as
they come: memory does not grow with the recording, except for the motions themselves. Frames that
cannot be read lose their motions and are named; nothing stands in for their pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from learned.depth_maps import DepthMaps, depth_folder
from learned.errors import PredictionError
from learned.gyro_update import GyroRotations
from learned.network_predictor import NetworkPredictor, predictor_for
from learned.prediction_run import PredictionRun
from learned.predictor import JudgesDepth, Predictor
from learned.unfinished import MeasuredPairs, Unfinished, images_digest
from learned.weights import load_weights
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
    """16-bit z-depth of every frame, unknown where a frame cannot be read; None when no folder was asked for."""
    depth_sd: tuple[Path, ...] | None = None
    """16-bit standard deviation of ln depth of every frame; None when the weights cannot say, as `meta` does."""

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
            integrated gyro, its bias estimated from gravity and the images; far better alone, but such motions must
            not meet the same IMU again (`meta` says so).
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
        ImuError: the predictor or `rotation` needs an IMU log that is absent or does not cover the frames.
        PredictionError: the predictor's output breaks its contract, naming the frames.
        ConfigError: an unknown `rotation`, or a batch size below 1.
        OutputError: the depth maps cannot be written.
    """
    if batch_size < 1:
        raise ConfigError(f"batch_size is {batch_size}, must be at least 1")
    if predictor is None or isinstance(predictor, (str, Path)):
        predictor = predictor_for(recording, load_weights(predictor))
    _check(recording, predictor)
    gyro = GyroRotations(recording) if _wants_gyro(rotation) else None
    t = recording.frame_t_s
    meta: dict[str, Any] = {"source": "learned", "predictor": dict(predictor.card), "library_version": _version(),
                            "rotation": rotation}
    if isinstance(predictor, NetworkPredictor):
        meta |= predictor.said_of_itself
    run = PredictionRun(recording, predictor, batch_size, progress)
    with ExitStack() as stack:
        if depth_dir is not None:
            scale = float(np.exp(predictor.scale_log_mean))
            run.maps = stack.enter_context(depth_folder(depth_dir, depth_unit_m, scale, meta))
            judged = predictor.depth_uncertainty_card if isinstance(predictor, JudgesDepth) else None
            run.maps.with_sd = judged is not None
            meta["depth_uncertainty"] = "never calibrated, so there are no sd maps" if judged is None else dict(judged)
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
        corrected = gyro.correct(T, cov, i, j)
        T, cov = corrected.T_i_j, corrected.cov
        meta |= corrected.meta()
    prediction = Prediction(
        t_i_s=t[i], t_j_s=t[j], T_i_j=T, cov=cov,
        scale_log_mean=predictor.scale_log_mean, scale_log_sd=predictor.scale_log_sd,
        snr=snr, meta=meta, depth=None if run.maps is None else run.maps.files,
        depth_sd=None if run.maps is None else run.maps.sd_files,
    )
    if run.unfinished is not None:
        run.unfinished.discard()
    return prediction


def _question(recording: Recording, predictor: Predictor, batch_size: int, maps: DepthMaps | None) -> dict[str, Any]:
    """All that decides what is measured."""
    return {"images": images_digest(recording), "predictor": dict(predictor.card), "batch_size": batch_size,
            "baselines": list(predictor.baselines), "depth_unit_m": None if maps is None else maps.unit_m,
            "depth_sd": None if maps is None or not isinstance(predictor, JudgesDepth) else _judging(predictor),
            "library_version": _version()}


def _judging(predictor: JudgesDepth) -> dict[str, Any] | None:
    card = predictor.depth_uncertainty_card
    return None if card is None else dict(card)


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


def _check(recording: Recording, predictor: Predictor) -> None:
    baselines = predictor.baselines
    if not baselines or min(baselines) < 1 or len(set(baselines)) != len(baselines):
        raise PredictionError(f"predictor: baselines {baselines}, must be different frame distances of at least 1")
    if len(recording) <= min(baselines):
        raise RecordingError(
            f"recording {recording.name}: {len(recording)} frame(s), too few for a pair {min(baselines)} apart"
        )
    if not recording.has_any_image:
        raise RecordingError(
            f"recording {recording.name}: images are missing; restore cam0/data, or give motions with `--motions`"
        )


def _version() -> str:
    try:
        return version("capsule-vio")
    except PackageNotFoundError:
        return "not installed"
