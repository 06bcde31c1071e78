"""Self-supervised training of any method on recordings; no truth is read.

    run = train(recordings, train_config("gyro-correlation", steps=4000), "runs/one")

The folder holds `config.json`, `train.csv`, `validation.csv` and `checkpoint.pt`. Started again with the same decisions
it goes on where it stopped, and ends with the same weights, bit for bit, as a run that was never interrupted.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, DistributedSampler

from learned.averaging import WeightAverage
from learned.checkpoints import load_checkpoint, save_checkpoint
from learned.dataset import TripletBatch, TripletDataset, collate
from learned.distributed import Team, team
from learned.errors import TrainingError
from learned.methods import Method, assemble
from learned.objective import Objective
from learned.train_config import TrainConfig, train_config_to_dict
from learned.train_log import TrainLog
from learned.training_source import SourceSettings
from learned.weights import fill_method
from vio.atomic import atomic_write
from vio.recording import Recording
from vio.trajectory import Trajectory

CHECKPOINT = "checkpoint.pt"
MOST_LOST = 50  # steps in a row without a finite gradient
WINDOWS_FOR_NORMALISATION = 2000

Progress = Callable[[int, int], None]


@dataclass
class TrainedRun:
    """How a run ended."""

    method: Method
    """With the averaged weights, in eval mode, on the CPU."""
    config: TrainConfig
    step: int
    """Steps done."""
    stopped_early: bool
    skipped: int
    """Steps without a finite gradient, which changed nothing."""
    validation: dict[str, float]
    """The last validation's means."""


@dataclass
class _EarlyStop:
    best: float = math.inf
    worse: int = 0

    def sees(self, loss: float, patience: int) -> bool:
        """Whether to stop after this loss."""
        self.best, self.worse = (loss, 0) if loss < self.best else (self.best, self.worse + 1)
        return bool(patience) and self.worse >= patience


def train(recordings: Sequence[Recording], config: TrainConfig, out: str | Path, *, device: str | None = None,
          progress: Progress | None = None, start_from: Mapping[str, Tensor] | None = None, alone: bool = False,
          trajectories: Sequence[Trajectory | None] | None = None) -> TrainedRun:
    """Train, or go on training.

    Under `torchrun` all processes call this; the first writes the files.

    Args:
        recordings: with images, calibrated cameras and, where the method or the recipe needs it, an IMU log.
        config: all decisions.
        out: folder of the run.
        device: "cpu" or "cuda"; None = cuda where there is one.
        progress: called with (steps done, steps in all) after every step.
        start_from: weights to start a new run with, by name; None = drawn from the seed.
        alone: train in this process alone, though there are others.
        trajectories: refined, of the body in metres, one for each recording or None for it; the lengths of their steps
            teach depth (`TrainConfig.length_from`, `length_weight`).

    Raises:
        CheckpointError: the folder's checkpoint is damaged, or of a run with other decisions.
        RecordingError, ImuError: recordings that cannot be trained on.
        WeightsError: start weights of another method.
        TrainingError: gradients stay without finite values, or no trajectory where step lengths are to teach.
        TrajectoryError: a trajectory of another time than its recording.
        OutputError: the folder cannot be written.
    """
    with team(device, alone) as members:
        trainer = Trainer(recordings, config, Path(out), members, start_from, trajectories)
        trainer.resume()
        trainer.run(progress)
        return trainer.result()


@dataclass
class Trainer:
    """One run in one process."""

    recordings: Sequence[Recording]
    config: TrainConfig
    out: Path
    members: Team = field(default_factory=Team)
    start_from: Mapping[str, Tensor] | None = None
    trajectories: Sequence[Trajectory | None] | None = None

    def __post_init__(self) -> None:
        config, members = self.config, self.members
        torch.manual_seed(1000 * config.seed + members.rank)
        settings = source_settings(config)
        if config.needs_lengths and not any(path is not None for path in self.trajectories or ()):
            raise TrainingError("training: step lengths are to come from refined trajectories, and no recording has "
                                "one; give trajectories, or length_from='network' and length_weight=0")
        self.data = TripletDataset(self.recordings, settings, "train", config.seed, config.augment, self.trajectories)
        self.held = TripletDataset(self.recordings, settings, "validation", config.seed, False, self.trajectories)
        self.sampler: DistributedSampler[Any] = DistributedSampler(
            self.data, members.size, members.rank, seed=config.seed, drop_last=True)
        self.method = assemble(config.method, seed=config.seed)
        if config.method.vibration:
            self.method.fit_vibration_normalisation(_windows(self.data))
        if self.start_from is not None:
            fill_method(self.method, self.start_from, "start weights",
                        "is trained; give weights of that method, width and fusion")
        layout = torch.channels_last if config.channels_last else torch.contiguous_format
        self.method.to(members.device, memory_format=layout)  # type: ignore[call-overload]
        self.objective = Objective(self.method, config).train()
        self.optimiser = torch.optim.Adam([p for p in self.method.parameters() if p.requires_grad],
                                          lr=config.learning_rate, fused=True)
        self.average = WeightAverage(self.method, config.ema_decay)
        self.step, self.skipped, self.lost_in_a_row, self.stopped = 0, 0, 0, False
        self.early_stop, self.validation = _EarlyStop(), dict[str, float]()
        paths = self.trajectories or [None] * len(self.recordings)
        self.digests = [_digest(recording) + _path_digest(path)
                        for recording, path in zip(self.recordings, paths, strict=True)]
        self.logs: tuple[TrainLog, TrainLog] | None = None
        self.sums: dict[str, Tensor] = {}
        self.summed = 0

    def resume(self) -> None:
        """Take up the folder's checkpoint, if there is one."""
        path = self.out / CHECKPOINT
        step = None
        if path.is_file():
            state = load_checkpoint(path, self.config, self.members.size, self.digests)
            self._restore(state)
            step = self.step
        if self.members.leads:
            self.out.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.out / "config.json") as file:
                file.write((json.dumps(train_config_to_dict(self.config), indent=2) + "\n").encode())
            self.logs = (TrainLog(self.out / "train.csv", step), TrainLog(self.out / "validation.csv", step))

    def run(self, progress: Progress | None = None) -> None:
        """Train until the last step, or until validation stops improving."""
        config = self.config
        model: nn.Module = self.objective
        if self.members.size > 1:
            devices = [self.members.device.index] if self.members.device.type == "cuda" else None
            model = DistributedDataParallel(model, devices, find_unused_parameters=self.objective.with_flows)
        batches = self._batches()
        while self.step < config.steps and not self.stopped:
            parts = self._one_step(model, next(batches))
            self.sums = {name: self.sums.get(name, 0) + value for name, value in parts.items()}
            self.step, self.summed = self.step + 1, self.summed + 1
            if self.step % config.log_every == 0 or self.step == config.steps:
                self._log()
            if self.step % config.validate_every == 0 or self.step == config.steps:
                self._validate()
            if self.step % config.checkpoint_every == 0 or self.step == config.steps or self.stopped:
                self._save()
            if progress is not None:
                progress(self.step, config.steps)

    def result(self) -> TrainedRun:
        """What came of it; call it after `run`."""
        method = assemble(self.config.method, seed=self.config.seed)
        method.load_state_dict({name: value.cpu() for name, value in self.average.values.items()})
        return TrainedRun(method.eval(), self.config, self.step, self.stopped, self.skipped, self.validation)

    def _one_step(self, model: nn.Module, batch: TripletBatch) -> dict[str, Tensor]:
        """One update of every stage's weights; a gradient that is not finite changes nothing and is counted."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.config.learning_rate * rate(self.config, self.step)
        parts: dict[str, Tensor] = {}
        for stage in self.objective.stages:
            self.optimiser.zero_grad(set_to_none=True)
            total, found = model(batch, self.step, stage)
            total.backward()
            limit = self.config.clip_norm or math.inf
            norm = nn.utils.clip_grad_norm_(self.method.parameters(), limit)
            if torch.isfinite(norm):
                self.optimiser.step()
                self.lost_in_a_row = 0
            else:
                self._lose(found)
            mark = "" if stage == "motion" else f"{stage}_"
            parts |= {f"{mark}loss": total.detach(), f"{mark}gradient": norm.detach(),
                      **{f"{mark}{name}": value.detach() for name, value in found.items()}}
        self.average.update(self.method)
        return parts

    def _lose(self, parts: dict[str, Tensor]) -> None:
        self.skipped += 1
        self.lost_in_a_row += 1
        if self.lost_in_a_row >= MOST_LOST:
            wrong = [name for name, value in parts.items() if not torch.isfinite(value).all()]
            raise TrainingError(f"training: no finite gradient in {MOST_LOST} steps up to step {self.step} "
                                f"(not finite: {', '.join(wrong) or 'gradients only'}); lower the learning rate "
                                "or use float32")

    def _batches(self) -> Iterator[TripletBatch]:
        """Batches from where the run stands, epoch after epoch."""
        size = self.config.batch_size
        per_epoch = len(self.sampler) // size
        if per_epoch == 0:
            raise TrainingError(f"training: {len(self.sampler)} triplets a process, fewer than a batch of {size}; give "
                                "more or longer recordings, or a smaller batch_size")
        while True:
            epoch, first = divmod(self.step, per_epoch)
            self.data.set_epoch(epoch)
            self.sampler.set_epoch(epoch)
            order = list(self.sampler)
            chosen = [order[k * size:(k + 1) * size] for k in range(first, per_epoch)]
            for batch in self._loader(self.data, chosen):
                yield batch.to(self.members.device, non_blocking=True)

    def _loader(self, data: TripletDataset, batches: list[list[int]]) -> DataLoader[Any]:
        # A generator of its own: the loader's base seed must not be drawn from the networks' random state.
        return DataLoader(data, batch_sampler=batches, num_workers=self.config.workers, collate_fn=collate,
                          pin_memory=self.members.device.type == "cuda", generator=torch.Generator().manual_seed(0))

    def _log(self) -> None:
        values = self.members.mean({name: float(value) / self.summed for name, value in self.sums.items()})
        self.sums, self.summed = {}, 0
        if self.logs is not None:
            values |= {"learning_rate": self.config.learning_rate * rate(self.config, self.step - 1),
                       "skipped": float(self.skipped)}
            self.logs[0].write(self.step, values)

    @torch.no_grad()
    def _validate(self) -> None:
        """The averaged weights on the validation split; random states and trained weights stay as they are."""
        kept = {name: value.detach().clone() for name, value in self.method.state_dict().items()}
        self.method.load_state_dict(self.average.values)
        self.objective.eval()
        order = list(range(self.members.rank, len(self.held), self.members.size))
        size = self.config.batch_size
        batches = [order[k:k + size] for k in range(0, len(order), size)]
        stride = max(len(batches) // self.config.validation_batches, 1)
        rows: list[dict[str, float]] = []
        for batch in self._loader(self.held, batches[::stride][:self.config.validation_batches]):
            total, parts = self.objective(batch.to(self.members.device), self.step, "motion")
            rows.append({"loss": float(total), **{name: float(value) for name, value in parts.items()}})
        self.method.load_state_dict(kept)
        self.objective.train()
        every = [row for some in self.members.gathered(rows) for row in some]
        self.validation = {name: sum(row[name] for row in every) / len(every) for name in every[0]}
        if self.logs is not None:
            self.logs[1].write(self.step, self.validation)
        self.stopped = self.early_stop.sees(self.validation["loss"], self.config.patience)

    def _save(self) -> None:
        states = self.members.gathered(_random_state(self.members.device) | {"sums": self.sums})
        if not self.members.leads:
            return
        save_checkpoint(self.out / CHECKPOINT, self.config, {
            "step": self.step, "model": self.method.state_dict(), "average": self.average.values,
            "average_updates": self.average.updates, "optimiser": self.optimiser.state_dict(), "rng": states,
            "world": self.members.size, "recordings": self.digests, "skipped": self.skipped, "summed": self.summed,
            "early_stop": [self.early_stop.best, self.early_stop.worse, self.stopped, self.lost_in_a_row],
            "validation": self.validation})
        if self.config.keep_every and self.step % self.config.keep_every == 0:
            with atomic_write(self.out / f"average-{self.step:06d}.pt") as file:
                torch.save(self.average.values, file)

    def _restore(self, state: dict[str, Any]) -> None:
        self.method.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.average.values = {name: value.to(self.members.device) for name, value in state["average"].items()}
        self.average.updates = state["average_updates"]
        self.step, self.skipped, self.validation = state["step"], state["skipped"], state.get("validation", {})
        best, worse, self.stopped, self.lost_in_a_row = state["early_stop"]
        self.early_stop = _EarlyStop(best, worse)
        random = state["rng"][self.members.rank]
        self.sums, self.summed = random["sums"], state["summed"]
        torch.set_rng_state(random["cpu"])
        if "cuda" in random and self.members.device.type == "cuda":
            torch.cuda.set_rng_state(random["cuda"], self.members.device)


def rate(config: TrainConfig, step: int) -> float:
    """Share of the learning rate at a step: a linear warm-up times a constant or a cosine."""
    warm = min(1.0, (step + 1) / config.warm_up_steps) if config.warm_up_steps else 1.0
    if config.schedule == "constant":
        return warm
    cosine = 0.5 * (1 + math.cos(math.pi * min(step / config.steps, 1.0)))
    return warm * (config.final_rate + (1 - config.final_rate) * cosine)


def source_settings(config: TrainConfig) -> SourceSettings:
    """How a run reads recordings."""
    height, width = config.method.image_size
    return SourceSettings(height=height, width=width, imu=config.needs_imu, imu_samples=config.method.branch.samples,
                          step=config.frame_step, preload=config.preload)


def _windows(data: TripletDataset) -> Tensor:
    """Vibration windows (N, 6, n) spread over the training data, for the branch's normalisation."""
    chosen = range(0, len(data), max(len(data) // WINDOWS_FOR_NORMALISATION, 1))
    return torch.cat([data.windows(k) for k in chosen])


def _random_state(device: torch.device) -> dict[str, Any]:
    state: dict[str, Any] = {"cpu": torch.get_rng_state()}
    if device.type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def _digest(recording: Recording) -> str:
    """What tells recordings apart without reading their images."""
    first, last = int(recording.frame_t_ns[0]), int(recording.frame_t_ns[-1])
    text = f"{recording.name}: {len(recording)} frames {first} to {last}, {len(recording.imu)} samples"
    return hashlib.sha256(text.encode()).hexdigest()[:16]  # names may be patients'


def _path_digest(path: Trajectory | None) -> str:
    """What tells trajectories apart; empty without one."""
    return "" if path is None else f", taught {hashlib.sha256(path.T_world_body.tobytes()).hexdigest()[:16]}"
