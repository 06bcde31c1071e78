"""Comparisons from and to files: run folders and TUM trajectories in, a table, JSON and TUM files for evo out."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fusion.compare import Comparison, compare, join
from fusion.compare_text import format_table
from fusion.run_folder import read_run
from vio.alignment import associate
from vio.atomic import atomic_folder
from vio.errors import TrajectoryError
from vio.formats.tum import read_tum, write_tum
from vio.trajectory import Trajectory

MOTIONS_ONLY, REFINED = ": motions only", ": refined"
MARKER = "comparison.json"
SAME_TRUTH_M = 1e-6


@dataclass
class _Recording:
    """Everything given of one recording."""

    truth: Trajectory | None
    estimates: dict[str, Trajectory] = field(default_factory=dict)
    pairs: list[tuple[str, str]] = field(default_factory=list)


def compare_paths(paths: Sequence[str | Path], truth_path: str | Path | None) -> Comparison:
    """Compare run folders and TUM files.

    A run folder stands for two rows, its motions alone and its refined trajectory. Runs whose own truths differ are of
    several recordings: each is judged by its own truth, and a last sentence says what they show together.

    Raises:
        TrajectoryError: no truth was given and no run folder holds one, or it is not clear whose truth a file has.
        FormatError: a file is not what it should be.
    """
    taken: list[str] = []
    recordings: list[_Recording] = [] if truth_path is None else [_Recording(read_tum(truth_path))]
    homeless = recordings[0] if recordings else _Recording(None)
    for path in map(Path, paths):
        if path.is_dir():
            run = read_run(path)
            base = _free_name(run.name, [name.removesuffix(REFINED) for name in taken])
            pair = base + MOTIONS_ONLY, base + REFINED
            home = homeless if truth_path is not None else _recording_of(path, recordings) or homeless
            home.estimates |= dict(zip(pair, (run.motions_only, run.refined), strict=True))
            home.pairs.append(pair)
            taken += pair
        else:
            taken.append(_free_name(path.stem, taken))
            homeless.estimates[taken[-1]] = read_tum(path)
    _house(homeless, recordings)
    parts = [compare({name: r.estimates[name] for name in taken if name in r.estimates}, r.truth, r.pairs)
             for r in recordings if r.truth is not None]
    return parts[0] if len(parts) == 1 else join(parts, [r.pairs for r in recordings])


def _recording_of(path: Path, recordings: list[_Recording]) -> _Recording | None:
    """The recording with a run's own truth, a new one where none has it; None where the run holds no truth."""
    if not (path / "truth.tum").is_file():
        return None
    truth = read_tum(path / "truth.tum")
    for recording in recordings:
        if recording.truth is not None and _same(recording.truth, truth):
            return recording
    recordings.append(_Recording(truth))
    return recordings[-1]


def _house(homeless: _Recording, recordings: list[_Recording]) -> None:
    """Give what brought no truth to the only recording there is."""
    if not recordings:
        raise TrajectoryError("compare: no truth; give --truth traj.tum (runs of recordings with truth bring it)")
    if homeless is recordings[0] or not homeless.estimates:
        return
    if len(recordings) > 1:
        raise TrajectoryError(f"compare: {len(recordings)} recordings, and {next(iter(homeless.estimates))} does not "
                              "say of which one it is; compare one recording at a time, or give --truth traj.tum")
    recordings[0].estimates |= homeless.estimates
    recordings[0].pairs += homeless.pairs


def _same(a: Trajectory, b: Trajectory) -> bool:
    try:
        first, second = associate(a, b)
    except TrajectoryError:
        return False
    half = 2 * len(first) >= min(len(a), len(b))
    return half and bool(np.abs(first.positions_m - second.positions_m).max() <= SAME_TRUTH_M)


def _free_name(name: str, taken: Sequence[str]) -> str:
    candidate, n = name, 2
    while candidate in taken:
        candidate, n = f"{name} ({n})", n + 1
    return candidate


def write_comparison(comparison: Comparison, out: str | Path) -> Path:
    """Write `comparison.json`, `table.txt` and, for evo, every estimate and its truth as TUM files.

    The TUM files hold the shared frames with one set of stamps, not aligned: `evo_ape tum truth.tum NAME.tum -a`
    gives the column SE3, `-as` the column Sim3.

    Returns:
        The folder.

    Raises:
        OutputError: the folder exists and is not ours, or cannot be written.
    """
    files: dict[str, dict[str, str]] = {}
    written: dict[int, str] = {}
    with atomic_folder(out, MARKER) as folder:
        for name, (estimate, truth) in comparison.matched.items():
            if id(truth) not in written:
                written[id(truth)] = "truth.tum" if not written else f"truth_{len(written) + 1}.tum"
                write_tum(truth, folder / written[id(truth)])
            taken = [*written.values(), *(entry["estimate"] for entry in files.values())]
            file = _file_name(name, taken)
            write_tum(estimate, folder / file)
            files[name] = {"estimate": file, "truth": written[id(truth)]}
        content = {"schema": 1} | comparison.to_dict() | {"files": files}
        (folder / MARKER).write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        (folder / "table.txt").write_text(format_table(comparison) + "\n", encoding="utf-8")
    return Path(out)


def _file_name(name: str, taken: Sequence[str]) -> str:
    """A file name of plain letters that no other file has."""
    stem = re.sub(r"[^A-Za-z0-9.-]+", "_", name).strip("._") or "estimate"
    lower = [other.lower() for other in taken]
    candidate, n = f"{stem}.tum", 2
    while candidate.lower() in lower:
        candidate, n = f"{stem}_{n}.tum", n + 1
    return candidate
