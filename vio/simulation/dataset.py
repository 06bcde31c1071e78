"""The paper's data sets, simulated: MM-WCE-1 and MM-WCE-2, and the two kinds of vibration on one route.

V²-SfMLearner, section "Dataset": two operators drive one capsule each through six training and five test sequences, at
3 frames/s and 40 Hz, with Gaussian vibration of levels 1 to 5; its section on vibration types compares peristalsis and
collisions on the same route. What the paper leaves open (organs, lengths, which level where) is fixed here: organs take
turns, levels run through 1 to 5, test seeds are no training seeds.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vio.atomic import atomic_write
from vio.calibration import load_yaml
from vio.errors import OutputError, SimulationError
from vio.formats.asl import MARKER
from vio.simulation.cameras import preset_camera
from vio.simulation.images import check_can_render, write_rendered
from vio.simulation.organs import ORGANS
from vio.simulation.scenario import SIMULATOR_VERSION, simulate

MANIFEST = "manifest.json"
DATASETS = ("mm-wce",)
_DRIVING = {"mm-wce-1": "operated", "mm-wce-2": "brisk"}
_TRAIN_LEVELS, _TEST_LEVELS = (1, 2, 3, 4, 5, 3), (1, 2, 3, 4, 5)


@dataclass(frozen=True)
class Sequence:
    """One recording of a data set: where it lies and what is simulated."""

    path: str
    organ: str
    vibration: str
    level: int
    driving: str
    seed: int
    duration_s: float
    camera: str
    size: int


def plan(name: str, seed: int, duration_s: float, camera: str, size: int) -> tuple[Sequence, ...]:
    """The sequences of a data set.

    Raises:
        SimulationError: an unknown data set.
    """
    if name not in DATASETS:
        raise SimulationError(f"simulate: unknown data set {name!r}; choose one of {', '.join(DATASETS)}")
    return tuple(_mm_wce(seed, duration_s, camera, size))


def write_dataset(sequences: tuple[Sequence, ...], out: str | Path, workers: int = 1,
                  progress: Callable[[int, int], None] | None = None) -> Path:
    """Simulate and render every sequence that is not there yet, then write `manifest.json`, which is returned.

    A sequence is there when its folder is whole and holds what the plan asks for; so a run that was killed goes on
    where it stopped, and a finished one does nothing.

    Args:
        sequences: of `plan`.
        out: folder of the data set.
        workers: processes that render, one sequence each.
        progress: called with the number of sequences done and of all.

    Raises:
        SimulationError: fewer than one worker, or whatever a sequence cannot be simulated with.
        OutputError: a sequence's folder is not ours, or cannot be written.
    """
    if workers < 1:
        raise SimulationError(f"simulate: workers is {workers}; give at least 1")
    check_can_render()
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out.name} is a file; choose another --out")
    missing = [sequence for sequence in sequences if not _is_there(sequence, out)]
    done = len(sequences) - len(missing)
    if progress is not None:
        progress(done, len(sequences))
    for _ in _rendered(missing, out, workers):
        done += 1
        if progress is not None:
            progress(done, len(sequences))
    return _write_manifest(sequences, out)


def _mm_wce(seed: int, duration_s: float, camera: str, size: int) -> Iterator[Sequence]:
    organs = tuple(ORGANS)
    number = 1000 * seed
    for data, driving in _DRIVING.items():
        for part, levels in (("train", _TRAIN_LEVELS), ("test", _TEST_LEVELS)):
            for k, level in enumerate(levels):
                number += 1
                yield Sequence(f"{data}/{part}/{k:02d}", organs[k % 3], "gaussian", level, driving, number, duration_s,
                               camera, size)
    for kind in ("peristalsis", "collision"):
        for part, first in (("train", number + 1), ("test", number + 7)):
            for k in range(6 if part == "train" else 5):
                yield Sequence(f"vibration-types/{kind}/{part}/{k:02d}", organs[k % 3], kind, 3, "operated", first + k,
                               duration_s, camera, size)


def _rendered(sequences: list[Sequence], out: Path, workers: int) -> Iterator[str]:
    """Render sequences and name each as it is done."""
    if workers == 1 or len(sequences) < 2:
        for sequence in sequences:
            yield _render(sequence, out)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(sequences)), mp_context=context) as pool:
        futures = [pool.submit(_render, sequence, out) for sequence in sequences]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            for future in futures:
                future.cancel()


def _render(sequence: Sequence, out: Path) -> str:
    import cv2  # heavy, and only images need it

    cv2.setNumThreads(1)  # the processes share the cores
    simulation = simulate(sequence.organ, sequence.vibration, sequence.level, sequence.duration_s, sequence.seed,
                          driving=sequence.driving, camera=preset_camera(sequence.camera, sequence.size),
                          name=sequence.path.replace("/", "-"))
    write_rendered(simulation, out / sequence.path)
    return sequence.path


def _is_there(sequence: Sequence, out: Path) -> bool:
    """Whether the sequence was written by this version of the simulator, with these arguments."""
    marker = out / sequence.path / MARKER
    if not marker.is_file():
        return False
    content = load_yaml(marker)
    found = content.get("provenance") or {}
    wanted: dict[str, Any] = {"simulator_version": SIMULATOR_VERSION, "seed": sequence.seed, "organ": sequence.organ,
                              "vibration": sequence.vibration, "vibration_level": sequence.level,
                              "duration_s": sequence.duration_s, "driving": sequence.driving}
    camera = preset_camera(sequence.camera, sequence.size)
    lens = load_yaml(out / sequence.path / "mav0" / "cam0" / "sensor.yaml")
    same_lens = lens.get("resolution") == [camera.width, camera.height] and lens.get("intrinsics") == [
        camera.fx, camera.fy, camera.cx, camera.cy]
    return same_lens and all(found.get(key) == value for key, value in wanted.items())


def _write_manifest(sequences: tuple[Sequence, ...], out: Path) -> Path:
    """What lies where, and a digest of every recording's bytes."""
    entries = [asdict(sequence) | {"sha256": recording_digest(out / sequence.path)} for sequence in sequences]
    content = {"schema": 1, "simulator_version": SIMULATOR_VERSION, "frame_rate_hz": 3.0, "imu_rate_hz": 40.0,
               "sequences": entries}
    with atomic_write(out / MANIFEST) as file:
        file.write((json.dumps(content, indent=2) + "\n").encode())
    return out / MANIFEST


def recording_digest(folder: Path) -> str:
    """SHA-256 of all files of a recording, with their names, in the order of their names: `sha256` of the manifest."""
    total = hashlib.sha256()
    for file in sorted(file for file in folder.rglob("*") if file.is_file()):
        total.update(file.relative_to(folder).as_posix().encode() + b"\0")
        total.update(hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()
