"""The report of a whole examination: how large, how quickly built and opened, and in how much memory.

    python benchmarks/bench_report.py                       # 86,400 frames: eight hours at 3 frames per second
    python benchmarks/bench_report.py --frames 10000 86400  # how it grows

The refinement is made up (a winding track with covariances, joint samples, biases, holes, rejected motions and sixty
lesions with pictures), because solving a graph is not what is measured here. Each size is built in its
own process.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from browser import browser, find_chromium
from results import record, table

from fusion import (
    Provenance,
    RefineConfig,
    Refinement,
    Sighting,
    locate,
    read_lesions,
    write_lesions,
    write_run,
)
from fusion.joint import SAMPLES, JointSamples, checkpoints
from fusion.report import write_report
from fusion.result import ImuConclusion, ScaleConclusion, View
from fusion.run_folder import read_summary
from fusion.run_stream import RunFrames
from vio import se3
from vio.calibration import Calibration
from vio.imu import Gap, ImuSamples
from vio.inertial_levels import inertial_levels
from vio.recording import Recording
from vio.trajectory import Trajectory

FRAMES, RATE_HZ, GUT_M, LESIONS, OPENINGS = 86_400, 3.0, 6.0, 60, 5
LIMITS = {"size_mb": 8.0, "open_s": 3.0, "build_s": 20.0}
"""What must hold for 86,400 frames."""
WAIT = "window.reportDrawn ?? new Promise(done => addEventListener('load', () => done(window.reportDrawn)))"


def winding_track(n: int, rng: np.random.Generator) -> np.ndarray:
    """(N, 4, 4) poses along six metres of loops, with rests and a way back now and then."""
    share = np.cumsum(rng.exponential(1.0, n) * (rng.random(n) < 0.5))
    u = 2 * np.pi * share / share[-1]
    p = np.column_stack([0.12 * np.sin(9 * u) + 0.05 * np.sin(2 * u), 0.12 * np.cos(7 * u), 0.1 * np.sin(5 * u)])
    p *= GUT_M / np.linalg.norm(np.diff(p, axis=0), axis=1).sum()
    p += 1e-3 * np.cumsum(rng.normal(size=(n, 3)), axis=0) / np.sqrt(n)
    return se3.transform(se3.so3_exp(np.column_stack([0.3 * np.sin(20 * u), u, 0.2 * np.cos(13 * u)])), p)


def made_up(n: int) -> Refinement:
    """A refinement of N frames."""
    rng = np.random.default_rng(n)
    t, T = np.arange(n) / RATE_HZ, winding_track(n, rng)
    sd_m = 1e-4 + 0.02 * np.sqrt(np.arange(n) / n)
    cov = np.zeros((n, 6, 6))
    cov[:, range(3), range(3)] = 1e-5
    cov[:, range(3, 6), range(3, 6)] = (sd_m[:, None] * [1.0, 0.6, 0.4]) ** 2
    node = checkpoints(n)
    walk = np.cumsum(rng.normal(size=(SAMPLES, len(node), 6)), axis=1) / np.sqrt(len(node))
    joint = JointSamples(node, walk * ([3e-3] * 3 + [0.012] * 3), np.zeros((SAMPLES, len(node))))
    off = 0.006 * np.cumsum(rng.normal(size=(n, 3)), axis=0) / np.sqrt(n)
    drift = 0.3 * np.cumsum(rng.normal(size=(n, 3)), axis=0) / np.sqrt(n)
    samples = np.arange(int(t[-1] * 40))
    shake = rng.normal(size=(len(samples), 3)) * (0.05 + np.abs(np.sin(samples / 40_000))[:, None])
    imu = ImuSamples((samples * 25_000_000).astype(np.int64), 0.1 * shake, shake + np.array([0, 0, 9.81]))
    return Refinement(
        name="eight-hours", estimator="graph", fallback_reason=None, trajectory=Trajectory(t, T @ shifted(off), cov),
        velocity_m_s=np.zeros((n, 3)), gyro_bias_rad_s=1e-4 * np.cumsum(rng.normal(size=(n, 3)), axis=0) / np.sqrt(n),
        accel_bias_m_s2=0.1 + 1e-2 * np.cumsum(rng.normal(size=(n, 3)), axis=0) / np.sqrt(n),
        log_scale=np.log(8e-4) + 0.1 * np.cumsum(rng.normal(size=n)) / np.sqrt(n), log_scale_sd=np.full(n, 0.02),
        motions_only=Trajectory(t, T @ shifted(drift)),
        scale=ScaleConclusion("free", float(np.log(8e-4)), 0.02, "made up"),
        imu=ImuConclusion(0.49, 1.0, tuple(Gap(100.0 * k, 100.0 * k + 2) for k in range(1, int(t[-1] / 100), 3))),
        motions_used=n - 1 - n // 50, rejected=np.sort(rng.choice(n - 1, n // 50, replace=False)), bridged=0,
        time_offset_s=0.0, truth=Trajectory(t, T), joint=joint, view=View(0, np.eye(4), None, float(np.log(8e-4))),
        inertial=inertial_levels(imu, samples / 40.0),
    )


def shifted(p: np.ndarray) -> np.ndarray:
    """(N, 4, 4) pure translations."""
    return se3.transform(np.broadcast_to(np.eye(3), (len(p), 3, 3)), p)


def pictured(n: int, folder: Path) -> Recording:
    """A recording whose every frame is one of a few noisy images of 320 x 320 pixels."""
    import cv2

    rng = np.random.default_rng(0)
    paths = []
    for k in range(8):
        coarse = rng.integers(0, 255, (20, 20, 3), dtype=np.uint8)
        smooth = cv2.resize(coarse, (320, 320), interpolation=cv2.INTER_CUBIC)
        paths.append(folder / f"{k}.png")
        cv2.imwrite(str(paths[-1]), cv2.add(smooth, rng.integers(0, 12, smooth.shape, dtype=np.uint8)))
    t_ns = (np.arange(n) / RATE_HZ * 1e9).astype(np.int64)
    return Recording("eight-hours", t_ns, ImuSamples.none(), Calibration(None, np.eye(4)), None,
                     tuple(paths[k % 8] for k in range(n)))


def prepare(n: int, folder: Path) -> None:
    """Write the run folder with its lesions."""
    refinement = made_up(n)
    write_run(refinement, folder / "RUN", Provenance(["bench"], RefineConfig(), {}))
    frames = np.linspace(0.01 * n, 0.99 * n, LESIONS).astype(int).tolist()
    sightings = [Sighting(f"finding {k}", "finding", frame, None, None, f"row {k}") for k, frame in enumerate(frames)]
    sightings[0], sightings[-1] = (Sighting(label, "landmark", frame, None, None, label) for label, frame in
                                   (("Pylorus", frames[0]), ("Ileocecal valve", frames[-1])))
    write_lesions(locate(refinement, sightings), folder / "RUN")


def peak_mib() -> float:
    """Most memory that this process has held so far; unlike getrusage it forgets the process that started it."""
    return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text(encoding="ascii")).group(1)) / 1024


def build(n: int, folder: Path) -> dict[str, float]:
    """Read the run folder and write its report, as `capsule-vio report` does."""
    recording = pictured(n, folder)
    before = peak_mib()
    start, busy = time.perf_counter(), time.process_time()
    run = folder / "RUN"
    frames, summary, rows = RunFrames(run), read_summary(run), read_lesions(run)
    write_report(frames, summary, run / "report.html", lesions=rows, recording=recording)
    return {"build_s": time.perf_counter() - start, "cpu_s": time.process_time() - busy,
            "start_mb": before, "peak_mb": peak_mib(),
            "size_mb": (run / "report.html").stat().st_size / 1e6}


def opened(page: Path) -> dict[str, float]:
    """Median over several openings: until the page answers with its first figure, and until all are drawn."""
    found = []
    with browser() as tab:
        for _ in range(OPENINGS):
            tab.show(page)
            all_s = tab.ask(WAIT) / 1e3
            first = tab.ask("performance.getEntriesByName('first-figure')[0].startTime") / 1e3
            marks = tab.ask("document.querySelectorAll('.plot .main-svg').length")
            found.append((first, all_s, float(marks)))
        if tab.complaints:
            raise SystemExit(f"the page complains: {tab.complaints[:3]}")
    first, every, marks = np.median(found, axis=0)
    return {"open_s": float(first), "drawn_s": float(every), "marks": float(marks)}


def main() -> None:
    """Measure every size, record the table, and fail where a limit is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[10_000, FRAMES])
    parser.add_argument("--build", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.build is not None:
        print(json.dumps(build(arguments.frames[0], arguments.build)))
        return
    rows, broken = [], []
    for n in arguments.frames:
        with tempfile.TemporaryDirectory() as name:
            prepare(n, Path(name))
            command = [sys.executable, __file__, "--frames", str(n), "--build", name]
            found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
            if find_chromium() is not None:
                found |= opened(Path(name) / "RUN" / "report.html")
        rows.append([f"{n:,}", *(f"{found[key]:.1f}" for key in ("size_mb", "build_s", "cpu_s")),
                     *(f"{found[key]:.0f}" for key in ("start_mb", "peak_mb")),
                     *(f"{found[key]:.1f}" if key in found else "no chromium" for key in ("open_s", "drawn_s"))])
        print(rows[-1], flush=True)
        broken += [f"{n} frames: {key} is {found[key]:.1f}, limit {limit}" for key, limit in LIMITS.items()
                   if found.get(key, 0.0) > limit]
    lines = table(["frames", "page, MB", "built, s", "of it CPU, s", "memory before, MiB", "at most, MiB",
                   "opens, s", "all figures drawn, s"], rows)
    record("report", "The report of a whole examination",
           TEXT.format(table=lines, lesions=LESIONS, openings=OPENINGS))
    if broken:
        raise SystemExit("; ".join(broken))


TEXT = """{lesions} lesions with pictures, truth, covariances, joint samples, holes in the inertial data and 2 %
rejected motions; the refinement is made up. "Opens" is the time from navigation to the first figure, drawn and
answering, in headless Chromium with a software renderer; the other figures follow one by one. Medians of {openings}
openings.

{table}

A curve holds at most some 3000 points whatever the length, so the page hardly grows. Frames are read from the run
folder in blocks, twice: once for the numbers, which come from all of them, and once to choose what is drawn: of
recordings of more than 12,000 frames the extremes of short spans and points evenly along the way. So memory does not
grow with the recording beyond that."""


if __name__ == "__main__":
    main()
