"""How much a table may cost: sizes of networks and images, steps of training, frames and sequences looked at."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from learned.dataset import frames_of_split
from learned.methods import FusionConfig, method_config
from learned.train_config import MEASURED_BRANCH, MEASURED_FUSION, TrainConfig, train_config
from vio.errors import ConfigError

METHODS = ("endosfmlearner", "af-sfmlearner", "ra-depth", "endodac", "gyro-correlation")
"""The paper's four in the paper's order, then our own."""
STRATEGIES = ("concatenation", "summation", "gated", "aff", "iaff", "butd", "fourier")
"""The paper's order."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """One size of the whole study; the same for every run of a table."""

    name: str
    image_size: tuple[int, int]
    """(height, width) of all methods."""
    width: float
    """Factor on the channels of all networks."""
    transformer: str
    """EndoDAC's."""
    batch_size: int
    seeds: int
    """Trainings per variant, unless said otherwise."""
    steps: int | None = None
    """Of every training; None = `epochs`."""
    epochs: int | None = None
    """Over the training split."""
    train_frames: int | None = None
    """First frames of every training sequence that are used; None = all."""
    test_frames: int | None = None
    """First frames of every test sequence that are judged; None = all."""
    sequences: int | None = None
    """Sequences per data set and part; None = all."""


BUDGETS: dict[str, Budget] = {budget.name: budget for budget in (
    Budget(name="smoke", image_size=(64, 64), width=0.125, transformer="small", batch_size=2, seeds=1, steps=6,
           train_frames=16, test_frames=8, sequences=3),
    Budget(name="short", image_size=(96, 96), width=0.25, transformer="small", batch_size=4, seeds=3, steps=200,
           test_frames=30),
    Budget(name="full", image_size=(320, 320), width=1.0, transformer="base", batch_size=4, seeds=3, epochs=400),
)}
"""By name. `full` is the paper's: Adam at 1e-4 (the default of the four), batch 4, 400 epochs."""
VALIDATIONS, CHECKPOINTS = 10, 10
"""Per training."""
FEWEST_STEPS_TO_VALIDATE = 20


def budget_of(name: str, seeds: int | None = None) -> Budget:
    """A budget by name, perhaps with another number of seeds.

    Raises:
        ConfigError: no such budget, or fewer than one seed.
    """
    if name not in BUDGETS:
        raise ConfigError(f"benchmark: budget {name!r} is unknown, choose one of {', '.join(BUDGETS)}")
    if seeds is None:
        return BUDGETS[name]
    if seeds < 1:
        raise ConfigError(f"benchmark: {seeds} seeds; give at least 1")
    return replace(BUDGETS[name], seeds=seeds)


def decisions(budget: Budget, method: str, fusion: str | None, seed: int, frames: list[int]) -> TrainConfig:
    """Every decision of one training.

    With and without vibration all decisions but the vibration are the same. The vibration branch has no dropout and the
    Fourier fusion starts where its gain has a slope, for all methods: as published, the branch was measured not to
    learn, and such a comparison would be one of a network with itself (`learned.train_config.MEASURED_FUSION`).

    Args:
        budget: sizes and steps.
        method: of `METHODS`.
        fusion: of `STRATEGIES`; None = vision alone.
        seed: of the training.
        frames: number of frames of every training sequence.
    """
    strategy = MEASURED_FUSION if fusion in (None, "fourier") else FusionConfig(str(fusion))
    options: dict[str, Any] = {"image_size": budget.image_size, "branch": MEASURED_BRANCH}
    if method == "endodac":  # there are no pretrained weights, and a frozen random transformer learns nothing
        options |= {"transformer": budget.transformer, "train_transformer": True}
    config = method_config(method, vibration=fusion is not None, fusion=strategy, width=budget.width, **options)
    steps = budget.steps if budget.steps is not None else _epochs(budget, frames)
    validate_every = max(steps // VALIDATIONS, FEWEST_STEPS_TO_VALIDATE)
    return train_config(config, steps=steps, batch_size=budget.batch_size, seed=seed, log_every=max(steps // 100, 1),
                        validate_every=validate_every, checkpoint_every=max(steps // CHECKPOINTS, 1))


def _epochs(budget: Budget, frames: list[int]) -> int:
    """Steps of the budget's epochs: every frame of the training split with a neighbour on both sides is a triplet."""
    triplets = sum(max(frames_of_split(count, "train")[1] - 2, 0) for count in frames)
    return max(int(budget.epochs or 1) * (triplets // budget.batch_size), 1)
