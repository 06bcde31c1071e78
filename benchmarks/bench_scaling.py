"""Time and memory per frame from 1,000 to 10,000 frames; every run in a process of its own.

    python benchmarks/bench_scaling.py
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

FRAMES = (1000, 10_000)
LIMIT = 1.5


def measure(frames: int, seed: int) -> dict[str, float]:
    """Refine one recording; seconds and bytes beyond what was there before."""
    from fusion import RefineConfig, refine
    from vio.metrics import ate
    from vio.simulation import network_like_motions, simulate_recording

    recording = simulate_recording("small-bowel", "gaussian", 3, frames / 3.0, seed)
    truth = recording.truth_at_frames()
    network = network_like_motions(truth, recording.calibration.T_body_camera, seed)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    begun = time.process_time()
    refined = refine(recording, network.motions, RefineConfig(estimator="graph"))
    return {"frames": frames, "cpu_s": time.process_time() - begun, "bytes": refined.peak_rss_bytes - before,
            "ate_mm": 1e3 * ate(refined.trajectory, truth, "se3").rmse_m, "path_m": truth.path_length_m}


def main() -> None:
    """Measure in fresh processes and record the ratios."""
    if len(sys.argv) == 3:
        print(json.dumps(measure(int(sys.argv[1]), int(sys.argv[2]))))
        return
    from results import record, table

    runs = []
    for frames in FRAMES:
        for seed in (401, 402, 403):
            command = [sys.executable, __file__, str(frames), str(seed)]
            runs.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
    rows = [[f"{r['frames']}", f"{r['cpu_s']:.1f}", f"{1e3 * r['cpu_s'] / r['frames']:.2f}",
             f"{r['bytes'] / 2**20:.0f}", f"{r['bytes'] / r['frames'] / 1024:.1f}", f"{r['ate_mm']:.1f}",
             f"{r['ate_mm'] / 10 / r['path_m']:.2f}"] for r in runs]
    per_frame = {frames: [sum(r[key] for r in runs if r["frames"] == frames) / (3 * frames)
                          for key in ("cpu_s", "bytes")] for frames in FRAMES}
    ratios = [b / a for a, b in zip(per_frame[FRAMES[0]], per_frame[FRAMES[1]], strict=True)]
    body = (table(["frames", "CPU s", "ms/frame", "MiB above the start", "KiB/frame", "ATE SE3 mm", "% of path"], rows)
            + f"\n\nPer frame, {FRAMES[1]} over {FRAMES[0]} frames, means of three seeds: time × {ratios[0]:.2f}, "
            f"memory × {ratios[1]:.2f} (limit {LIMIT}).")
    record("scaling", "Time and memory per frame", body)


if __name__ == "__main__":
    main()
