"""The run directory: everything a refinement concluded, written whole or not at all."""

from __future__ import annotations

import hashlib
import json
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from fusion.config import RefineConfig
from fusion.result import Refinement
from fusion.run_states import inertial_arrays, joint_arrays, name_of, view_arrays
from fusion.summary import summarize
from vio.atomic import atomic_folder
from vio.errors import FormatError
from vio.formats.tum import read_tum, write_tum
from vio.motions import RelativeMotions
from vio.trajectory import Trajectory

MARKER = "manifest.json"
LIBRARIES = ("numpy", "scipy", "gtsam", "filterpy", "torch", "opencv-python-headless")


@dataclass(frozen=True)
class Provenance:
    """How a run came about, for its manifest."""

    command: list[str]
    """The command line, without folders: only the names of files."""
    config: RefineConfig
    inputs: dict[str, Path]
    """Input files by role; only that and their SHA-256 are recorded: a file name may be a patient's."""
    seed: int | None = None


@dataclass(frozen=True)
class Run:
    """A run folder read back."""

    name: str
    refined: Trajectory
    motions_only: Trajectory
    summary: dict[str, Any]


def write_run(refinement: Refinement, out: str | Path, provenance: Provenance,
              motions: RelativeMotions | None = None) -> dict[str, Any]:
    """Write the run folder of the contract atomically and return its summary.

    Args:
        refinement: what was concluded.
        out: the folder; an earlier run folder is replaced, anything else is refused.
        provenance: what goes into the manifest.
        motions: the motions it was made from; the report marks the rejected ones with their help.

    Raises:
        OutputError: `out` exists and is no run folder, or cannot be written.
    """
    from fusion.report import write_report, write_trajectory_plot  # plotting libraries load in seconds

    summary = summarize(refinement)
    manifest = _manifest(provenance)
    with atomic_folder(out, MARKER) as folder:
        write_tum(refinement.trajectory, folder / "trajectory.tum")
        write_tum(refinement.motions_only, folder / "motions_only.tum")
        if refinement.truth is not None:
            write_tum(refinement.truth, folder / "truth.tum")
        if refinement.online is not None:
            write_tum(refinement.online.filtered, folder / "filtered.tum")
        if refinement.loops.proposed:
            (folder / "loops.csv").write_text(_loops_csv(refinement), encoding="utf-8")
        _write_states(refinement, folder / "trajectory.npz")
        _write_json(summary, folder / "summary.json")
        write_trajectory_plot(refinement, folder / "trajectory.svg", motions)
        write_report(refinement, summary, folder / "report.html", motions)
        _write_json(manifest, folder / MARKER)
    return summary


def read_run(folder: str | Path) -> Run:
    """Read a run folder.

    Raises:
        FormatError: a file is missing or not what it claims.
    """
    folder = Path(folder)
    summary = read_summary(folder)
    refined, motions_only = read_tum(folder / "trajectory.tum"), read_tum(folder / "motions_only.tum")
    return Run(name_of(folder, summary), refined, motions_only, summary)


def read_summary(folder: str | Path) -> dict[str, Any]:
    """The `summary.json` of a run folder.

    Raises:
        FormatError: it is missing or not what it claims.
    """
    folder = Path(folder)
    path = folder / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except OSError:
        raise FormatError(f"{folder.name}: no summary.json; give a folder written by `capsule-vio refine`") from None
    except ValueError as error:
        raise FormatError(f"{folder.name}/summary.json: not valid JSON ({error}); write the run again") from None
    if not isinstance(summary, dict) or summary.get("schema") != 1:
        raise FormatError(f"{folder.name}/summary.json: not a summary of schema 1; write the run again")
    return summary


def _write_states(r: Refinement, path: Path) -> None:
    np.savez_compressed(
        path, t=r.trajectory.t_s, T_world_body=r.trajectory.T_world_body, cov=np.asarray(r.trajectory.cov),
        velocity=r.velocity_m_s, gyro_bias=r.gyro_bias_rad_s, accel_bias=r.accel_bias_m_s2, log_scale=r.log_scale,
        log_scale_sd=r.log_scale_sd, rejected=r.rejected, **joint_arrays(r.joint), **view_arrays(r.view),
        **inertial_arrays(r.inertial),
    )


def _loops_csv(r: Refinement) -> str:
    """The verified loops: numbers and times of both frames, distance² from the trajectory in sigmas, whether used."""
    first, t = 0 if r.view is None else r.view.first_frame, r.trajectory.t_s
    rows = ["frame_i,frame_j,t_i_s,t_j_s,distance2,accepted"]
    for (i, j), distance2, accepted in zip(r.loops.frames.tolist(), r.loops.distance2, r.loops.accepted, strict=True):
        far = f"{distance2:.3f}" if np.isfinite(distance2) else ""
        rows.append(f"{first + i},{first + j},{t[i]:.6f},{t[j]:.6f},{far},{int(accepted)}")
    return "\n".join(rows) + "\n"


def _write_json(value: dict[str, Any], path: Path) -> None:
    path.write_text(json.dumps(value, indent=2, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")


def _manifest(provenance: Provenance) -> dict[str, Any]:
    return {
        "schema": 1,
        "project": {"name": "capsule-vio", "version": _version("capsule-vio")},
        "command": provenance.command,
        "config": provenance.config.to_dict(),
        "seed": provenance.seed,
        "libraries": {name: _version(name) for name in LIBRARIES} | {"python": platform.python_version()},
        "inputs": {role: {"name": f"{role}{path.suffix}", "sha256": sha256_of(path)}
                   for role, path in provenance.inputs.items()},
    }


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file, read in blocks.

    Raises:
        FormatError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise FormatError(f"{path.name}: cannot be read ({error.strerror or error}); give a file that can") from None
