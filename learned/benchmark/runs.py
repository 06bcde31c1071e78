"""One run: a variant trained with one seed and judged under its conditions, each result a file of its own.

    OUT/training/RUN/     config.json, train.csv, validation.csv; checkpoint.pt until all conditions are judged
    OUT/runs/RUN/CONDITION.json

A finished file is used again, by whichever table needs it; a training that was cut off goes on at its checkpoint.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from learned.benchmark.budgets import Budget, decisions
from learned.benchmark.conditions import CLEAN, Condition, shown
from learned.benchmark.data_set import DataSet, Entry
from learned.benchmark.scores import Scores, guess, mean_log_snr, scores
from learned.benchmark.tables import Variant
from learned.errors import BenchmarkError
from learned.measured import measure
from learned.train_config import BOOKKEEPING, TrainConfig, train_config_to_dict
from learned.training import CHECKPOINT, TrainedRun, train
from learned.training_source import SourceSettings, TrainingSource
from vio.atomic import atomic_write
from vio.recording import Recording

SCHEMA = 1
INDIFFERENT = tuple(name for name in BOOKKEEPING if name not in ("steps", "patience"))
"""Decisions of a training that its weights do not depend on."""
LIBRARIES = ("capsule-vio", "torch", "numpy", "scipy", "opencv-python-headless")


class Progress(Protocol):
    """Who is told how far things are."""

    def __call__(self, stage: str) -> None:
        """A new stage."""

    def count(self, done: int, total: int) -> None:
        """How much of the stage is done."""


@dataclass(frozen=True)
class Run:
    """A variant with a seed, and all that decides what comes of it."""

    variant: Variant
    seed: int
    train_on: tuple[Entry, ...]
    judge_on: tuple[Entry, ...]
    budget: Budget

    @property
    def name(self) -> str:
        """Of its folders."""
        return f"{self.variant.name}_seed-{self.seed}"


def runs_of(variants: Sequence[Variant], budget: Budget, data: DataSet) -> list[Run]:
    """All runs of some variants, seed by seed, so that whole comparisons are done early.

    Raises:
        BenchmarkError: a data set has no such sequences.
    """
    def entries(variant: Variant, part: str) -> tuple[Entry, ...]:
        return data.select(variant.sets, part, variant.level, budget.sequences)
    return [Run(variant, seed, entries(variant, "train"), entries(variant, "test"), budget)
            for seed in range(budget.seeds) for variant in variants]


def finish(run: Run, data: DataSet, out: Path, device: str | None, progress: Progress) -> dict[str, dict[str, Any]]:
    """The results of a run by condition: read where they are there, else trained and judged for.

    Raises:
        BenchmarkError: a result was made with other decisions, or cannot be read.
        VioError: recordings that cannot be trained on, or training that cannot go on.
    """
    recordings = [data.recording(entry, run.budget.train_frames) for entry in run.train_on]
    config = decisions(run.budget, run.variant.method, run.variant.fusion, run.seed, [len(r) for r in recordings])
    wanted = _decisions(run, config)
    files = {condition: out / "runs" / run.name / f"{condition.name}.json" for condition in run.variant.conditions}
    found = {condition.name: _read(path, wanted) for condition, path in files.items() if path.is_file()}
    missing = [condition for condition in files if condition.name not in found]
    if missing:
        folder = out / "training" / run.name
        trained = train(recordings, config, folder, device=device, progress=progress.count, alone=True)
        for condition, judged in _judged(run, trained, data, missing, progress):
            part = {"schema": SCHEMA, "run": run.name, "condition": condition.name, "decisions": wanted,
                    "versions": versions(), **judged}
            with atomic_write(files[condition]) as file:
                file.write((json.dumps(part, indent=1, allow_nan=False) + "\n").encode())
            found[condition.name] = part
        (folder / CHECKPOINT).unlink(missing_ok=True)
    return {condition.name: found[condition.name] for condition in files}


def versions() -> dict[str, str | None]:
    """Of this project and of what it computes with."""
    def of(name: str) -> str | None:
        try:
            return version(name)
        except PackageNotFoundError:
            return None
    return {name: of(name) for name in LIBRARIES} | {"python": platform.python_version()}


def _decisions(run: Run, config: TrainConfig) -> dict[str, Any]:
    """All that decides a result, in values as JSON gives them back."""
    training = {name: value for name, value in train_config_to_dict(config).items() if name not in INDIFFERENT}
    content = {"training": training, "train_frames": run.budget.train_frames,
               "test_frames": run.budget.test_frames, "train_on": {e.path: e.sha256 for e in run.train_on},
               "judge_on": {e.path: e.sha256 for e in run.judge_on}}
    return dict(json.loads(json.dumps(content)))


def _read(path: Path, wanted: dict[str, Any]) -> dict[str, Any]:
    where = f"{path.parent.name}/{path.name}"
    try:
        part = json.loads(path.read_text(encoding="utf-8"))
        schema, decided = part["schema"], part["decisions"]
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError):
        raise BenchmarkError(f"benchmark: runs/{where} cannot be read; delete it, and it is made again") from None
    if schema != SCHEMA:
        raise BenchmarkError(f"benchmark: runs/{where} has schema {schema}, this version writes {SCHEMA}; choose "
                             "another --out")
    different = _different(decided, wanted)
    if different:
        raise BenchmarkError(f"benchmark: runs/{where} was made with another {', '.join(different[:4])}; give the same "
                             "data and budget, or another --out")
    return dict(part)


def _different(one: Any, other: Any, name: str = "") -> list[str]:
    """Dotted names of what differs."""
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return [] if one == other else [name]
    return [found for key in sorted({*one, *other})
            for found in _different(one.get(key), other.get(key), f"{name}.{key}" if name else key)]


def _judged(run: Run, trained: TrainedRun, data: DataSet, conditions: list[Condition], progress: Progress
            ) -> Iterator[tuple[Condition, dict[str, Any]]]:
    """Yield (condition, its results), one after the other."""
    recordings = [data.recording(entry, run.budget.test_frames) for entry in run.judge_on]
    usable = [_usable(recording, trained) for recording in recordings]
    for k, condition in enumerate(conditions):
        found: dict[str, Scores] = {}
        guesses: dict[str, Scores] = {}
        snr: dict[str, float] = {}
        for recording, mask in zip(recordings, usable, strict=True):
            measured = measure(trained.method, trained.config.depth_kind, shown(recording, condition))
            found[recording.name] = scores(measured, mask)
            snr[recording.name] = mean_log_snr(measured)
            if condition == CLEAN:
                guesses[recording.name] = scores(guess(measured), mask)
        steps = {"steps": trained.step, "skipped_steps": trained.skipped, "validation": trained.validation}
        yield condition, {"trained": steps, "scores": found, "guess": guesses,
                          "mean_log_snr": snr if run.variant.fusion == "fourier" else None}
        if len(conditions) > 1:
            progress.count(k + 1, len(conditions))


def _usable(recording: Recording, trained: TrainedRun) -> NDArray[np.bool_]:
    """(H, W) pixels inside the lens and outside the vignette of the images as they are."""
    height, width = trained.config.method.image_size
    return TrainingSource(recording, SourceSettings(height=height, width=width, imu=False)).usable[0].numpy()
