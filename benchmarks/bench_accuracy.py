"""Accuracy and consistency on simulated motion: vibration levels × held-out seeds, graph and EKF.

    python benchmarks/bench_accuracy.py                    # 5 levels × 12 seeds, three kinds of vibration
    python benchmarks/bench_accuracy.py --frames 10000 --seeds 301 302 303 --kinds gaussian
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from results import record, table

from fusion import RefineConfig, refine
from vio.consistency import fix_gauge
from vio.metrics import ate, nees
from vio.simulation import network_like_motions, simulate_recording
from vio.trajectory import Trajectory

HELD_OUT_SEEDS = tuple(range(621, 631))
"""Seeds 1-12, 101-112, 201-212, 604 and 610 were looked at while choosing constants; these were not."""
FRAME_RATE_HZ = 3.0


@dataclass(frozen=True)
class Row:
    """One run."""

    kind: str
    level: int
    seed: int
    path_m: float
    motions_mm: float
    graph_mm: float
    ekf_mm: float
    policy: str
    scale_error: float
    scale_sd: float
    graph_nees: float
    ekf_nees: float
    inside: float
    """Share of positions, per axis, within the claimed 95 % interval."""


def run(job: tuple[str, int, int, int, bool, float, float, int]) -> Row:
    """Simulate one recording, refine it with both estimators, and measure."""
    kind, level, seed, frames, with_ekf, prior_off, outliers, burst = job
    recording = simulate_recording("small-bowel", kind, level, frames / FRAME_RATE_HZ, seed)
    truth = recording.truth_at_frames()
    network = network_like_motions(truth, recording.calibration.T_body_camera, seed, outliers=outliers,
                                   burst_length=burst)
    motions = network.motions
    if prior_off:
        start = float(network.true_log_scale[0])
        motions = replace(motions, scale_log_mean=start + prior_off, scale_log_sd=abs(prior_off))
    graph = refine(recording, motions, RefineConfig(estimator="graph"))
    ekf = refine(recording, motions, RefineConfig(estimator="ekf")) if with_ekf else None
    return Row(
        kind, level, seed, truth.path_length_m, 1e3 * ate(graph.motions_only, truth, "se3").rmse_m,
        1e3 * ate(graph.trajectory, truth, "se3").rmse_m,
        1e3 * ate(ekf.trajectory, truth, "se3").rmse_m if ekf else float("nan"), graph.scale.policy,
        float(np.mean(graph.log_scale[:-1] - network.true_log_scale)), graph.scale.log_sd,
        float(np.nanmean(nees(graph.trajectory, truth))),
        float(np.nanmean(nees(ekf.trajectory, truth))) if ekf else float("nan"),
        positions_inside(graph.trajectory, truth),
    )


def positions_inside(estimate: Trajectory, truth: Trajectory) -> float:
    """Share of positions, per body axis, within 1.96 claimed standard deviations; the first pose is exact."""
    assert estimate.cov is not None
    error = fix_gauge(estimate, truth).positions_m - estimate.positions_m
    error = np.einsum("nji,nj->ni", estimate.rotations, error)
    sd = np.sqrt(np.diagonal(estimate.cov[:, 3:, 3:], axis1=1, axis2=2))
    return float((np.abs(error) < 1.96 * sd)[1:].mean())


def cell(rows: list[Row]) -> list[str]:
    """One line of the table: medians and worst cases over the seeds."""
    graph = np.array([r.graph_mm / r.motions_mm for r in rows])
    ekf = np.array([r.ekf_mm / r.motions_mm for r in rows])
    free = [r for r in rows if r.policy == "free"]
    errors = np.array([r.scale_error for r in free])
    inside = np.mean([abs(r.scale_error) < 1.96 * r.scale_sd for r in free]) if free else np.nan
    path = np.median([r.path_m for r in rows])
    filtered = bool(np.isfinite(ekf).all())
    bias = f"{100 * errors.mean():+.1f} ± {100 * errors.std() / len(free) ** 0.5:.1f}" if free else "–"
    consistency = [r.graph_nees for r in rows]
    return [
        f"{rows[0].kind} {rows[0].level}", f"{path:.2f}", f"{np.median([r.motions_mm for r in rows]):.1f}",
        f"{np.median([r.graph_mm for r in rows]):.2f}", f"{np.median(graph):.3f}", f"{graph.max():.3f}",
        f"{np.max([r.graph_mm / 10 / r.path_m for r in rows]):.2f}",
        f"{np.median(ekf):.3f}" if filtered else "–", f"{ekf.max():.3f}" if filtered else "–",
        f"{len(free)}/{len(rows)}", bias, f"{100 * inside:.0f}", f"{np.mean(consistency):.2f}",
        f"{np.min(consistency):.2f}–{np.max(consistency):.2f}",
        f"{100 * np.mean([r.inside for r in rows]):.0f}",
        f"{np.mean([r.ekf_nees for r in rows]):.2f}" if filtered else "–",
    ]


HEADER = ["vibration", "path m", "motions mm", "graph mm", "graph/motions median", "worst", "worst, % of path",
          "EKF/motions median", "worst", "policy free", "scale bias % (free)", "95 % interval holds %",
          "pose NEES/dof mean", "range", "95 % interval of position holds %", "EKF NEES/dof"]


def main() -> None:
    """Run all jobs on all cores and record one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(HELD_OUT_SEEDS))
    parser.add_argument("--levels", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--kinds", nargs="+", default=["gaussian", "peristalsis", "collision"])
    parser.add_argument("--no-ekf", action="store_true")
    parser.add_argument("--prior-off", type=float, default=0.0, help="log error, and sd, of the scale prior")
    parser.add_argument("--outliers", type=float, default=0.02, help="share of motions that are grossly wrong")
    parser.add_argument("--burst", type=int, default=1, help="how many motions in a row an outlier spoils")
    parser.add_argument("--name", default="accuracy")
    arguments = parser.parse_args()
    jobs = [(kind, level, seed, arguments.frames, not arguments.no_ekf, arguments.prior_off, arguments.outliers,
             arguments.burst) for kind in arguments.kinds for level in arguments.levels for seed in arguments.seeds]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        rows = list(pool.map(run, jobs))
    keys = dict.fromkeys((r.kind, r.level) for r in rows)
    cells = [cell([r for r in rows if (r.kind, r.level) == key]) for key in keys]
    prior = (f"its prior mean is {arguments.prior_off:+.2f} off in log" if arguments.prior_off
             else "its prior is right: N(ln 0.8, 0.10), from which the truth is drawn")
    bursts = f" in bursts of {arguments.burst}" if arguments.burst > 1 else ""
    bad = f"{100 * arguments.outliers:g} % gross outliers{bursts}"
    body = (f"{arguments.frames} frames at 3 Hz in the small bowel, IMU 40 Hz; motions with {bad},\n"
            "0.3° and 3 % + 0.05 mm noise, reported sigmas off by a factor exp(N(0, 0.2)), scale drifting 0.10 per\n"
            f"√1000 frames; {prior}. {len(arguments.seeds)} seeds that no constant was tuned on\n"
            f"({min(arguments.seeds)}–{max(arguments.seeds)}). ATE is the rmse of position after SE3 alignment, on\n"
            "the same frames for all; \"motions\" is the chain of the motions alone at its prior scale. NEES is of\n"
            "the absolute pose, per degree of freedom.\n\n"
            + table(HEADER, cells) + "\n\n" + _losers(rows))
    record(arguments.name, f"Accuracy on simulated motion, {arguments.frames} frames", body)


def _losers(rows: list[Row]) -> str:
    lost = [f"{r.kind} {r.level} seed {r.seed}: {r.graph_mm:.1f} against {r.motions_mm:.1f} mm" for r in rows
            if r.graph_mm >= r.motions_mm or r.ekf_mm >= r.motions_mm]
    off = [f"{r.kind} {r.level} seed {r.seed}: {r.graph_nees:.2f}" for r in rows if not 0.5 <= r.graph_nees <= 2]
    return ("Runs where an estimator lost to the motions alone: " + ("; ".join(lost) or "none") + ".\n\n"
            "Runs whose graph pose NEES per dof is outside 0.5 to 2: " + ("; ".join(off) or "none") + ".")


if __name__ == "__main__":
    main()
