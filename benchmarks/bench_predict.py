"""What `learned.predict` adds to the bare networks, and how many frames per second it measures.

    python benchmarks/bench_predict.py

The weights that come along, on a rendered recording of 160 × 160 pixels. Networks = their bare forward passes on the
same batches of frames that lie ready in memory; with signals = and what tells the covariances; predict = all of it,
from image files to motions. The three are timed in turn, the quickest of several runs each: processor time, which other
programs disturb little, and for predict the clock too.
"""

from __future__ import annotations

import os
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
from learned.inference import distinct, estimate_pairs
from learned.network_predictor import NetworkPredictor, predictor_for
from learned.weights import load_weights
from learned.windows import ImuWindows
from vio.recording import Recording
from vio.simulation import preset_camera, simulate
from vio.simulation.images import write_rendered

FRAMES, SIZE, REPEATS = 49, 160, 3
BATCHES, THREADS = (8, 16), (1, 2)


def bare_passes(recording: Recording, predictor: NetworkPredictor,
                batch_size: int) -> tuple[Callable[[], None], Callable[[], None]]:
    """The networks alone, and with the signals, on everything made ready beforehand."""
    images = [torch.from_numpy(resized_rgb(recording.frame(k), predictor.image_size).transpose(2, 0, 1).copy())
              .float() / 255 for k in range(len(recording))]
    windows = ImuWindows(recording.imu, recording.imu_t_s, recording.frame_t_s, predictor.imu_samples_per_item,
                         predictor.imu_rate_hz)
    pairs = torch.stack([torch.stack(pair) for pair in pairwise(images)])
    imu = torch.from_numpy(windows.at(recording.frame_t_s[:-1])).float().transpose(1, 2)
    batches = list(zip(pairs.split(batch_size), imu.split(batch_size), strict=True))
    ready = [(distinct(frames), inertial) for frames, inertial in batches]
    cameras = {len(frames): camera_batch([predictor.camera]).repeated(len(frames)) for frames, _ in batches}

    def networks() -> None:
        with torch.inference_mode():
            for shots, inertial in ready:
                ahead = list(zip(shots.i, shots.j, strict=True))
                predictor.network(shots.frames[None], inertial[shots.pair][None], depth_frames=shots.i,
                                  pairs=[*ahead, *((j, i) for i, j in ahead)])

    def with_signals() -> None:
        with torch.inference_mode():
            for frames, inertial in batches:
                estimate_pairs(predictor.network, frames, inertial, cameras[len(frames)],
                               predictor.weights.card["depth_kind"], predictor.uncertainty.signals)
    return networks, with_signals


def seconds(run: Callable[[], object]) -> tuple[float, float]:
    """Processor time and the clock's."""
    start = time.process_time(), time.perf_counter()
    run()
    return time.process_time() - start[0], time.perf_counter() - start[1]


def rows(recording: Recording) -> list[list[str]]:
    """One per number of threads and batch size."""
    predictor, found = predictor_for(recording, load_weights()), []
    for threads in THREADS:
        torch.set_num_threads(threads)
        for batch_size in BATCHES:
            networks, with_signals = bare_passes(recording, predictor, batch_size)

            def whole(batch_size: int = batch_size) -> object:
                return learned.predict(recording, predictor, batch_size=batch_size)

            networks()
            timed = [[seconds(run) for run in (networks, with_signals, whole)] for _ in range(REPEATS)]
            cpu = [min(times[k][0] for times in timed) for k in range(3)]
            clock = min(times[2][1] for times in timed)
            found.append([f"{threads}", f"{batch_size}", *(f"{1e3 * t / FRAMES:.1f}" for t in cpu),
                          f"{cpu[2] / cpu[0]:.3f}", f"{cpu[2] / cpu[1]:.3f}",
                          f"{FRAMES / cpu[2]:.0f}" if threads == 1 else "",
                          f"{FRAMES / clock:.0f}"])
    return found


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        simulation = simulate("small-bowel", "gaussian", 2, FRAMES / 3, 1, camera=preset_camera("fisheye-140", SIZE))
        write_rendered(simulation, Path(folder) / "REC")
        recording = vio.open_recording(Path(folder) / "REC")
        before = os.getloadavg()[0]
        text = table(["threads", "batch", "networks, CPU ms per frame", "with signals", "predict", "predict / networks",
                      "predict / with signals", "frames/s by CPU time", "frames/s by the clock"], rows(recording))
    record("predict_speed", "Speed of predict",
           f"{FRAMES} frames of {SIZE} × {SIZE} pixels; {before:.1f} programs were running on {os.cpu_count()} cores "
           f"when it began, so the clock says something on an idle machine only.\n\n{text}")
