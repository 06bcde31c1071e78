"""A picture of a whole examination: position error along eight hours, and the 3 sigma that was claimed.

    python benchmarks/plot_examination.py
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from fusion import Refinement, refine
from vio import se3
from vio.metrics import ate, fix_gauge
from vio.recording import Recording
from vio.simulation import network_like_motions, simulate_recording

FRAMES, SEED = 86_400, 801
PRIOR_OFF = 0.223
"""How far the mean of the scale prior is off in log, and its standard deviation."""
PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "examination.png"


def main() -> None:
    """Simulate, refine, draw."""
    recording = simulate_recording("small-bowel", "gaussian", 3, FRAMES / 3.0, SEED)
    truth = recording.truth_at_frames()
    network = network_like_motions(truth, recording.calibration.T_body_camera, SEED,
                                   scale_walk_per_sqrt_1000_frames=0.02)
    motions = replace(network.motions, scale_log_mean=network.motions.scale_log_mean + PRIOR_OFF,
                      scale_log_sd=PRIOR_OFF)
    draw(recording, refine(recording, motions))


def draw(recording: Recording, refined: Refinement) -> None:
    """Error and claim above, the motions alone beside it below."""
    truth = recording.truth_at_frames()
    moved = fix_gauge(refined.trajectory, truth)
    xi = se3.log(se3.inverse(refined.trajectory.T_world_body) @ moved.T_world_body)
    sd = np.sqrt(np.trace(refined.trajectory.cov[:, 3:, 3:], axis1=1, axis2=2))
    error_mm, sd_mm = 1e3 * np.linalg.norm(xi[:, 3:], axis=1), 1e3 * sd
    alone_mm = 1e3 * np.linalg.norm(refined.motions_only.positions_m - moved.positions_m, axis=1)
    hours = truth.t_s / 3600
    size, path_m = 1e3 * ate(refined.trajectory, truth, "se3").rmse_m, truth.path_length_m

    figure, (above, below) = plt.subplots(2, 1, figsize=(9, 6.4), sharex=True, height_ratios=(3, 2),
                                          layout="constrained")
    above.fill_between(hours, 0, 3 * sd_mm, color="#9ecae1", label="claimed: up to 3 sd")
    above.plot(hours, error_mm, color="#d94801", linewidth=1.2, label="position error")
    above.set_ylabel("mm from the first pose's frame")
    above.set_ylim(0, 1.1 * max(3 * sd_mm.max(), error_mm.max()))
    above.legend(loc="upper left", frameon=False)
    above.set_title(f"{FRAMES:,} frames, 8 hours, {path_m:.0f} m of path: ATE {size:.0f} mm after alignment "
                    f"({size / 10 / path_m:.3f} % of the path)", fontsize=11)
    below.semilogy(hours[1:], alone_mm[1:], color="#737373", linewidth=1.0, label="motions alone")
    below.semilogy(hours[1:], error_mm[1:], color="#d94801", linewidth=1.0, label="refined")
    below.set_ylim(0.1, None)
    below.set_ylabel("position error, mm")
    below.set_xlabel("hours")
    below.legend(loc="lower right", frameon=False)
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlim(0, hours[-1])
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=110)
    inside = float(np.mean(error_mm[1:] < 3 * sd_mm[1:]))
    print(f"{PICTURE.name}: ATE {size:.1f} mm, last error {error_mm[-1]:.0f} mm, claimed sd {sd_mm[-1]:.0f} mm, "
          f"{100 * inside:.1f} % of frames within 3 sd")


if __name__ == "__main__":
    main()
