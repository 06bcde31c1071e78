"""What `learned.predict` adds to the bare networks, and how many frames per second it measures.

    python benchmarks/bench_predict.py

The weights that come along, on a rendered recording of 160 × 160 pixels. Bare = the same networks on the same batches
of frames that lie ready in memory, nothing else. Both are timed in turn, wall time, the quickest of several runs each.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import torch
from results import record, table

import learned
import vio
from learned.camera_rays import camera_batch
from learned.frames import resized_rgb
from learned.inference import estimate_pairs
from learned.network_predictor import NetworkPredictor, predictor_for
from learned.weights import load_weights
from learned.windows import ImuWindows
from vio.recording import Recording
from vio.simulation import preset_camera, simulate
from vio.simulation.images import write_rendered

FRAMES, SIZE, REPEATS = 120, 160, 3
BATCHES, THREADS = (8, 32), (1, 2)


def bare_pass(recording: Recording, predictor: NetworkPredictor, batch_size: int) -> Callable[[], None]:
    """The networks alone, on everything made ready beforehand."""
    images = [torch.from_numpy(resized_rgb(recording.frame(k), predictor.image_size).transpose(2, 0, 1).copy())
              .float() / 255 for k in range(len(recording))]
    windows = ImuWindows(recording.imu, recording.imu_t_s, recording.frame_t_s, predictor.imu_samples_per_item,
                         predictor.imu_rate_hz)
    pairs = torch.stack([torch.stack(pair) for pair in pairwise(images)])
    imu = torch.from_numpy(windows.at(recording.frame_t_s[:-1])).float().transpose(1, 2)
    batches = list(zip(pairs.split(batch_size), imu.split(batch_size), strict=True))

    def run() -> None:
        with torch.inference_mode():
            for frames, inertial in batches:
                cameras = camera_batch([predictor.camera]).repeated(len(frames))
                estimate_pairs(predictor.weights.method, frames, inertial, cameras,
                               predictor.weights.card["depth_kind"])
    return run


def seconds(run: Callable[[], object]) -> float:
    """Wall time."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def rows(recording: Recording) -> list[list[str]]:
    """One per number of threads and batch size."""
    predictor, found = predictor_for(recording, load_weights()), []
    for threads in THREADS:
        torch.set_num_threads(threads)
        for batch_size in BATCHES:
            bare = bare_pass(recording, predictor, batch_size)

            def whole(batch_size: int = batch_size) -> object:
                return learned.predict(recording, predictor, batch_size=batch_size)

            bare(), whole()
            times = [(seconds(bare), seconds(whole)) for _ in range(REPEATS)]
            alone, all_of_it = min(t for t, _ in times), min(t for _, t in times)
            per_frame_ms = [f"{1e3 * t / FRAMES:.1f}" for t in (alone, all_of_it)]
            found.append([f"{threads}", f"{batch_size}", *per_frame_ms, f"{all_of_it / alone:.3f}",
                          f"{FRAMES / all_of_it:.0f}"])
    return found


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        simulation = simulate("small-bowel", "gaussian", 2, FRAMES / 3, 1, camera=preset_camera("fisheye-140", SIZE))
        write_rendered(simulation, Path(folder) / "REC")
        recording = vio.open_recording(Path(folder) / "REC")
        text = table(["threads", "batch", "bare networks, ms per frame", "predict, ms per frame", "predict / bare",
                      "predict, frames/s"], rows(recording))
    record("predict_speed", "Speed of predict", f"{FRAMES} frames of {SIZE} × {SIZE} pixels.\n\n{text}")
