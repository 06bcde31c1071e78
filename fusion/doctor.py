"""Is this installation able to work? Versions, and a tiny refinement from end to end."""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from fusion.config import RefineConfig
from fusion.refine import refine
from vio.errors import VioError
from vio.simulation import network_like_motions, simulate_recording

REQUIRED = ("numpy", "scipy", "opencv-python-headless", "gtsam", "filterpy", "torch", "safetensors", "plotly",
            "pyyaml")
EXTRAS = {"numba": "sim", "transformers": "foundation", "rerun-sdk": "view", "submitit": "cluster"}


@dataclass(frozen=True)
class Finding:
    """One line of the diagnosis."""

    name: str
    ok: bool
    text: str
    required: bool = True


def diagnose() -> list[Finding]:
    """Check the interpreter, every library, and both estimators on twenty simulated frames."""
    findings = [Finding("python", sys.version_info >= (3, 11), platform.python_version())]
    findings += [_installed(name, f"pip install {name}", True) for name in REQUIRED]
    findings += [_installed(name, f"pip install 'capsule-vio[{extra}]'", False) for name, extra in EXTRAS.items()]
    findings += [_works("graph"), _works("ekf")]
    return findings


def _installed(name: str, remedy: str, required: bool) -> Finding:
    try:
        return Finding(name, True, version(name), required)
    except PackageNotFoundError:
        return Finding(name, False, f"not installed; {remedy}", required)


def _works(estimator: Any) -> Finding:
    recording = simulate_recording("small-bowel", "gaussian", 1, 7.0, 1)
    network = network_like_motions(recording.truth_at_frames(), recording.calibration.T_body_camera, 1)
    try:
        refined = refine(recording, network.motions, RefineConfig(estimator=estimator))
    except VioError as error:
        return Finding(estimator, False, str(error))
    ok = refined.estimator == estimator and bool(np.isfinite(refined.trajectory.T_world_body).all())
    return Finding(estimator, ok, f"{len(refined.trajectory)} simulated frames refined")


def format_findings(findings: list[Finding]) -> str:
    """The diagnosis as lines for a terminal."""
    width = max(len(f.name) for f in findings)
    return "\n".join(f"{_mark(f)}  {f.name.ljust(width)}  {f.text}" for f in findings)


def _mark(finding: Finding) -> str:
    if finding.ok:
        return "ok      "
    return "MISSING " if finding.required else "optional"
