"""The demonstration: simulated motions degraded like a network's, then rendered frames through the bundled network."""

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
from vio.motions import RelativeMotions, load_motions
from vio.recording import Recording
from vio.simulation.cameras import preset_camera
from vio.simulation.images import write_rendered
from vio.simulation.network_motions import network_like_motions
from vio.simulation.scenario import simulate, simulate_recording

ORGAN, VIBRATION, LEVEL, FRAMES, FRAME_RATE_HZ = "small-bowel", "gaussian", 3, 1000, 3.0
RENDERED_S, CAMERA, SIZE = 60.0, "fisheye-140", 160


@dataclass(frozen=True)
class Demo:
    """What the demonstration left behind."""

    comparison: Comparison
    """Graph and EKF on motions that are degraded like a network's."""
    rendered: Comparison
    """The graph on what the bundled network measured in rendered frames."""
    report: Path
    rendered_report: Path
    plot: Path
    about: str = (f"{FRAMES} frames in the {ORGAN}, {VIBRATION} vibration of level {LEVEL}; true motions degraded like "
                  "a network's")
    about_rendered: str = (f"{RENDERED_S * FRAME_RATE_HZ:.0f} rendered frames of the same organ; motions measured by "
                           "the bundled network")


def run_demo(out: Path, seed: int, predict: Callable[[Recording], RelativeMotions],
             announce: Callable[[str], None] | None = None) -> Demo:
    """Write both examinations, their motions and their runs under `out`, and compare the runs with the truth.

    Every step goes through files, as it would for anyone's own recording.

    Args:
        out: gets `recording/`, `motions.npz`, `graph/`, `ekf/`; `rendered/`, `network_motions.npz`, `network/`.
        seed: of the simulation.
        predict: measures motions in images.
        announce: called with every step.

    Raises:
        OutputError: `out` cannot be written.
        SimulationError: images cannot be rendered here, because the extra `sim` is not installed.
    """
    say = announce or (lambda _: None)
    say(f"simulating {FRAMES} frames in the {ORGAN}, vibration level {LEVEL}")
    write_asl(simulate_recording(ORGAN, VIBRATION, LEVEL, FRAMES / FRAME_RATE_HZ, seed), out / "recording")
    recording = read_asl(out / "recording")
    network = network_like_motions(recording.truth_at_frames(), recording.calibration.T_body_camera, seed)
    network.motions.save(out / "motions.npz")
    for estimator in ("graph", "ekf"):
        say(f"refining with the {estimator}")
        _refined(recording, out / "motions.npz", out / estimator, replace(RefineConfig(), estimator=estimator), seed)
    rendered = _rendered(out, seed, predict, say)
    comparison = compare_paths([out / "graph", out / "ekf"], None)
    return Demo(comparison, rendered, out / "graph" / "report.html", out / "network" / "report.html",
                out / "graph" / "trajectory.svg")


def _rendered(out: Path, seed: int, predict: Callable[[Recording], RelativeMotions],
              say: Callable[[str], None]) -> Comparison:
    """Render, measure with the network, refine."""
    say(f"rendering {RENDERED_S * FRAME_RATE_HZ:.0f} frames")
    camera = preset_camera(CAMERA, SIZE)
    write_rendered(simulate(ORGAN, VIBRATION, LEVEL, RENDERED_S, seed, camera=camera, driving="operated"),
                   out / "rendered")
    recording = read_asl(out / "rendered")
    say("measuring motions with the bundled network")
    predict(recording).save(out / "network_motions.npz")
    say("refining them with the graph")
    _refined(recording, out / "network_motions.npz", out / "network", RefineConfig(), seed)
    return compare_paths([out / "network"], None)


def _refined(recording: Recording, motions: Path, out: Path, config: RefineConfig, seed: int) -> None:
    provenance = Provenance(["demo", "--seed", str(seed)], config, {"motions": motions}, seed)
    loaded = load_motions(motions)
    write_run(refine(recording, loaded, config), out, provenance, loaded)
