"""The demonstration: simulate an examination, degrade its motions like a network would, refine, compare."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from fusion.compare import Comparison
from fusion.compare_files import compare_paths
from fusion.config import RefineConfig
from fusion.refine import refine
from fusion.run_folder import Provenance, write_run
from vio.formats.asl import read_asl, write_asl
from vio.motions import load_motions
from vio.simulation.network_motions import network_like_motions
from vio.simulation.scenario import simulate_recording

ORGAN, VIBRATION, LEVEL, FRAMES, FRAME_RATE_HZ = "small-bowel", "gaussian", 3, 1000, 3.0


@dataclass(frozen=True)
class Demo:
    """What the demonstration left behind."""

    comparison: Comparison
    report: Path
    plot: Path


def run_demo(out: Path, seed: int, announce: Callable[[str], None] | None = None) -> Demo:
    """Write `recording/`, `motions.npz`, `graph/` and `ekf/` under `out`, and compare them with the truth.

    Every step goes through files, as it would for anyone's own recording.

    Raises:
        OutputError: `out` cannot be written.
    """
    say = announce or (lambda _: None)
    say("simulating 1000 frames in the small bowel, vibration level 3")
    simulated = simulate_recording(ORGAN, VIBRATION, LEVEL, FRAMES / FRAME_RATE_HZ, seed)
    write_asl(simulated, out / "recording")
    recording = read_asl(out / "recording")
    network = network_like_motions(recording.truth_at_frames(), recording.calibration.T_body_camera, seed)
    network.motions.save(out / "motions.npz")
    motions = load_motions(out / "motions.npz")
    for estimator in ("graph", "ekf"):
        say(f"refining with the {estimator}")
        config = replace(RefineConfig(), estimator=estimator)
        provenance = Provenance(["demo", "--seed", str(seed)], config, {"motions": out / "motions.npz"}, seed)
        write_run(refine(recording, motions, config), out / estimator, provenance, motions)
    comparison = compare_paths([out / "graph", out / "ekf"], None)
    return Demo(comparison, out / "graph" / "report.html", out / "graph" / "trajectory.svg")
