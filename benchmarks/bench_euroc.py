"""Real IMU and real truth: EuRoC V1_01, with degraded true motions and with motions from real image features.

    python benchmarks/bench_euroc.py

Needs ../shared/data/euroc_v101. The features are the ones that ship with gtsam (eqvio_processed_30s.csv).
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gtsam
import numpy as np
from eqvio_tracks import CAMERA, FRAME_RATE_HZ, load_eqvio_tracks
from results import record, table

from fusion import RefineConfig, Refinement, refine
from fusion.compare import compare
from fusion.compare_text import format_table
from vio import Recording, open_recording
from vio.metrics import nees
from vio.odometry import measure_motions
from vio.simulation import network_like_motions

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "euroc_v101"
KEYFRAME_STEP = 4
"""Every fourth truth pose of 20 Hz: 5 Hz."""
TRUE_SCALE, PRIOR_SD = 0.5, 0.7
SEEDS = (1, 2, 3, 4, 5)


def main() -> None:
    """Run both experiments and record their tables."""
    if not DATA.is_dir():
        sys.exit("needs the EuRoC sample in ../shared/data/euroc_v101")
    recording = open_recording(DATA)
    body = "\n\n".join([_degraded(recording), _classical(recording)])
    record("euroc", "EuRoC V1_01: real inertial data", body)


def _at_times(recording: Recording, t_ns: np.ndarray) -> Recording:
    """The recording with other frame times and no images; truth moves along with the first frame."""
    truth = recording.truth
    assert truth is not None
    later = (t_ns[0] - recording.frame_t_ns[0]) * 1e-9
    moved = replace(truth, t_s=truth.t_s - later)
    return replace(recording, frame_t_ns=t_ns, frame_paths=(), depth_paths=(), truth=moved)


def _degraded(recording: Recording) -> str:
    """(a) True motions with noise, scale 0.5 against a prior of 1, and 2 % outliers, over the whole 145 s."""
    truth = recording.truth
    assert truth is not None
    t_ns = recording.frame_t_ns[0] + np.round(truth.t_s[::KEYFRAME_STEP] * 1e9).astype(np.int64)
    keyframes = _at_times(recording, t_ns)
    rows, text = [], ""
    for seed in SEEDS:
        network = network_like_motions(keyframes.truth_at_frames(), recording.calibration.T_body_camera, seed,
                                       scale_log_mean=float(np.log(TRUE_SCALE)), scale_prior_sd=0.0,
                                       scale_walk_per_sqrt_1000_frames=0.0)
        motions = replace(network.motions, scale_log_mean=0.0, scale_log_sd=PRIOR_SD)
        graph = refine(keyframes, motions, RefineConfig(estimator="graph"))
        rows += _rows(f"seed {seed}", graph)
        text = text or _printed(graph)
    return (f"## Degraded true motions, {len(t_ns)} frames at 5 Hz, 145 s\n\n"
            f"Noise 0.3° and 3 % + 0.05 mm, 2 % outliers, true scale {TRUE_SCALE} of the prior's mean (prior sd "
            f"{PRIOR_SD} in log).\n\n{table(HEADER, rows)}\n\nSeed {SEEDS[0]} as printed:\n\n```\n{text}\n```")


def _classical(recording: Recording) -> str:
    """(b) Motions measured on the real features of the first 30 s."""
    frames, tracks = load_eqvio_tracks(Path(gtsam.findExampleDataFile("eqvio_processed_30s.csv")))
    truth = recording.truth
    assert truth is not None
    t_s = truth.t_s[frames]
    rows, text = [], ""
    for step in CLASSICAL_STEPS:
        index = frames[::step]
        motions = measure_motions(tracks, CAMERA, t_s, frame_indices=index)
        keyframes = _at_times(recording, recording.frame_t_ns[0] + np.round(t_s[index] * 1e9).astype(np.int64))
        graph = refine(keyframes, motions, RefineConfig(estimator="graph"))
        rows += _rows(f"{FRAME_RATE_HZ / step:g} Hz, {len(motions)} motions", graph)
        text = text or _printed(graph)
    return ("## Classical motions from real features, first 30 s\n\n"
            f"{len(tracks)} observations, {len(tracks) / len(frames):.0f} a frame. The drone stands on the ground for\n"
            "the first seconds, where nothing shows parallax; motions begin when it takes off. Their unit is\n"
            f"arbitrary, so the prior knows nothing of scale (sd {motions.scale_log_sd:g} in log).\n\n"
            f"{table(HEADER, rows)}\n\nAt {FRAME_RATE_HZ / CLASSICAL_STEPS[0]:g} Hz as printed:\n\n```\n{text}\n```")


CLASSICAL_STEPS = (4, 1)
"""Every fourth and every frame of 20 Hz."""
HEADER = ["run", "trajectory", "ATE yaw4 mm", "ATE SE3 mm", "ATE Sim3 mm", "rotation SE3 °", "scale error %",
          "scale policy", "pose NEES/dof"]


def _rows(name: str, refined: Refinement) -> list[list[str]]:
    assert refined.truth is not None
    result = compare({"motions only": refined.motions_only, "refined": refined.trajectory}, refined.truth, [])
    consistency = float(np.nanmean(nees(refined.trajectory, refined.truth)))
    return [[name, key, *(f"{1e3 * row[m]['ate_rmse_m']:.0f}" for m in ("yaw4", "se3", "sim3")),
             f"{np.rad2deg(row['se3']['rotation_rmse_rad']):.2f}", f"{100 * row['scale_error']:+.1f}",
             refined.scale.policy if key == "refined" else "", f"{consistency:.2f}" if key == "refined" else ""]
            for key, row in result.rows.items()]


def _printed(refined: Refinement) -> str:
    assert refined.truth is not None
    estimates = {"motions only": refined.motions_only, "refined": refined.trajectory}
    return format_table(compare(estimates, refined.truth, [("motions only", "refined")]))


if __name__ == "__main__":
    main()
