"""Finished stages of a refinement on disk, so that one that was killed goes on where it stopped.

The recipe is deterministic: called with the same input, its n-th call of the engine is always the same call. Each
result is stored under its number, written whole or not at all; a folder made from other input is emptied.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.chain_engine import ChainEngine
from fusion.chain_model import ChainModel
from fusion.chain_start import inertial_steps
from fusion.chain_state import ChainState
from fusion.config import RefineConfig
from fusion.engine import Begin, Step, Uncertainty
from fusion.graph import Anchor
from fusion.joint import JointSamples
from fusion.preintegration import make_bias
from fusion.problem import Problem
from fusion.scale import Segments
from fusion.scaled_motion import Linearized
from fusion.solve import MotionTerm, Solution
from fusion.stretches import Stretch
from vio.atomic import atomic_write
from vio.errors import OutputError, VioError
from vio.loops import Loops
from vio.motions import UNREADABLE, RelativeMotions
from vio.recording import Recording

Arrays = dict[str, Any]

KEY = "key.json"
STATE = ("R", "p", "v", "accel_bias", "gyro_bias", "log_scale")


def refinement_key(recording: Recording, motions: RelativeMotions, config: RefineConfig,
                   loops: Loops | None = None) -> str:
    """SHA-256 of everything that a refinement depends on."""
    calibration = recording.calibration
    arrays: tuple[NDArray[Any], ...] = (
        recording.frame_t_s, recording.imu.t_ns, recording.imu.gyro_rad_s, recording.imu.accel_m_s2,
        calibration.T_body_camera, motions.t_i_s, motions.t_j_s, motions.T_i_j, motions.cov)
    facts = {"config": config.to_dict(), "imu_noise": asdict(calibration.imu_noise), "name": recording.name,
             "time_offset_s": calibration.time_offset_s, "scale": [motions.scale_log_mean, motions.scale_log_sd],
             "motions_meta": motions.meta,
             "libraries": {name: _version(name) for name in ("capsule-vio", "numpy", "scipy", "gtsam")}}
    if loops is not None and loops.motions is not None:
        m = loops.motions
        facts["loops"] = [m.scale_log_mean, m.scale_log_sd]
        arrays += (m.t_i_s, m.t_j_s, m.T_i_j, m.cov)
    return digest([json.dumps(facts, sort_keys=True).encode(), *(np.ascontiguousarray(a).tobytes() for a in arrays)])


def digest(parts: Iterable[bytes]) -> str:
    """Hexadecimal SHA-256 of byte strings, each with its length."""
    found = hashlib.sha256()
    for part in parts:
        found.update(len(part).to_bytes(8, "big") + part)
    return found.hexdigest()


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


class Checkpoint:
    """A folder of finished results of one computation, told apart by its key.

    Raises:
        OutputError: the folder exists and is not one of ours, or cannot be written.
    """

    def __init__(self, folder: str | Path, key: str) -> None:
        self.folder = Path(folder)
        path = self.folder / KEY
        if self.folder.exists() and not path.is_file() and any(self.folder.iterdir()):
            raise OutputError(f"{self.folder.name} exists and holds no unfinished run (no {KEY}); move it away")
        if not path.is_file() or path.read_text(encoding="utf-8") != key:
            self.discard()
            with atomic_write(path) as file:
                file.write(key.encode())

    def load(self, name: str) -> Arrays | None:
        """The arrays stored under a name; None where they were not finished."""
        try:
            with (self.folder / f"{name}.npz").open("rb") as file:
                return dict(np.load(file, allow_pickle=False))
        except (OSError, *UNREADABLE):  # a damaged file is computed again
            return None

    def save(self, name: str, arrays: Arrays) -> None:
        """Store arrays whole or not at all."""
        with atomic_write(self.folder / f"{name}.npz") as file:
            np.savez(file, **arrays)

    def discard(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


@contextmanager
def unfinished(out: str | Path) -> Iterator[Path]:
    """A hidden folder beside `out` for what is finished of it: kept when the process is killed or interrupted.

    It goes when the block succeeds, and when it fails for a reason that would be the same again.
    """
    out = Path(out)
    folder = out.parent / f".{out.name}.unfinished"
    try:
        yield folder
    except VioError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder, ignore_errors=True)


class ResumableEngine:
    """A chain engine whose finished calls are read back instead of computed again."""

    def __init__(self, engine: ChainEngine, checkpoint: Checkpoint) -> None:
        self.engine, self.checkpoint, self._calls = engine, checkpoint, 0

    def begin(self, problem: Problem, config: RefineConfig, log_scale: float, accel_inflation: float) -> Begin:
        """As `ChainEngine.begin`."""
        name = self._next("begin")
        stored = self.checkpoint.load(name)
        if stored is not None:
            return Begin(ChainModel(inertial_steps(problem, accel_inflation), _anchor(stored)), _state(stored),
                         _stretches(stored))
        begin = self.engine.begin(problem, config, log_scale, accel_inflation)
        self.checkpoint.save(name, _state_arrays(begin.values) | _anchor_arrays(begin.model.anchor)
                             | _stretch_arrays(begin.stretches))
        return begin

    def free(self, begin: Begin, problem: Problem, segments: Segments, walk_per_sqrt_s: float,
             log_scale: float) -> Begin:
        """As `ChainEngine.free`; there is nothing to store."""
        return self.engine.free(begin, problem, segments, walk_per_sqrt_s, log_scale)

    def solve(self, begin: Begin, term: MotionTerm, max_iterations: int, relative_tolerance: float) -> Solution:
        """As `ChainEngine.solve`."""
        name = self._next("solve")
        stored = self.checkpoint.load(name)
        if stored is not None:
            return Solution(_state(stored), stored["squared_norm"], float(stored["native_cost"]),
                            int(stored["iterations"]))
        solution = self.engine.solve(begin, term, max_iterations, relative_tolerance)
        self.checkpoint.save(name, _state_arrays(solution.values) | {
            "squared_norm": solution.squared_norm, "native_cost": np.float64(solution.native_cost),
            "iterations": np.int64(solution.iterations)})
        return solution

    def uncertainty(self, begin: Begin, term: MotionTerm, segments: Segments | None,
                    rng: np.random.Generator) -> Uncertainty:
        """As `ChainEngine.uncertainty`."""
        name = self._next("uncertainty")
        stored = self.checkpoint.load(name)
        if stored is not None:
            joint = JointSamples(stored["node"], stored["xi"], stored["log_scale"])
            return Uncertainty(stored["cov"], stored["variance"], joint)
        found = self.engine.uncertainty(begin, term, segments, rng)
        assert found.joint is not None
        self.checkpoint.save(name, {"cov": found.cov, "variance": found.log_scale_variance, "node": found.joint.node,
                                    "xi": found.joint.xi, "log_scale": found.joint.log_scale})
        return found

    def response(self, begin: Begin, term: MotionTerm, blocks: Linearized,
                 error: NDArray[np.float64]) -> Step:
        """As `ChainEngine.response`; quicker to compute again than to store."""
        return self.engine.response(begin, term, blocks, error)

    def responses(self, begin: Begin, term: MotionTerm, blocks: Linearized,
                  errors: NDArray[np.float64]) -> list[Step]:
        """As `ChainEngine.responses`."""
        return self.engine.responses(begin, term, blocks, errors)

    def _next(self, kind: str) -> str:
        self._calls += 1
        return f"{self._calls:02d}_{kind}"


def _state_arrays(state: ChainState) -> Arrays:
    return {name: getattr(state, name) for name in STATE}


def _state(stored: Arrays) -> ChainState:
    return ChainState(*(np.asarray(stored[name]) for name in STATE))


def _anchor_arrays(anchor: Anchor) -> Arrays:
    return {"anchor_T": anchor.T_world_body, "anchor_cov": anchor.pose_cov, "anchor_v": anchor.velocity_m_s,
            "anchor_v_sd": np.float64(anchor.velocity_sd), "anchor_bias": anchor.bias.vector(),
            "anchor_bias_sd": anchor.bias_sd}


def _anchor(stored: Arrays) -> Anchor:
    bias: NDArray[np.float64] = stored["anchor_bias"]
    return Anchor(stored["anchor_T"], stored["anchor_cov"], stored["anchor_v"], float(stored["anchor_v_sd"]),
                  make_bias(bias[:3], bias[3:]), stored["anchor_bias_sd"])


def _stretch_arrays(stretches: tuple[Stretch, ...]) -> Arrays:
    rows = [[s.first, s.last, s.imu_chi2, s.reason] for s in stretches]
    return {"stretches": np.array(json.dumps(rows))}


def _stretches(stored: Arrays) -> tuple[Stretch, ...]:
    return tuple(Stretch(*row) for row in json.loads(str(stored["stretches"])))
