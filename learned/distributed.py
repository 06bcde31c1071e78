"""One process among several, as `torchrun` starts them; alone without it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.distributed as dist


@dataclass(frozen=True)
class Team:
    """Who trains."""

    rank: int = 0
    size: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def leads(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def gathered(self, value: Any) -> list[Any]:
        """Every process's value, in the order of their ranks."""
        if self.size == 1:
            return [value]
        values: list[Any] = [None] * self.size
        dist.all_gather_object(values, value)
        return values

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """Mean over the processes, key by key."""
        every = self.gathered(values)
        return {name: sum(one[name] for one in every) / len(every) for name in values}


@contextmanager
def team(device: str | None = None) -> Iterator[Team]:
    """Join the processes that torchrun's environment describes, and leave them at the end.

    Args:
        device: "cpu" or "cuda"; None = cuda where there is one.
    """
    kind = device or ("cuda" if torch.cuda.is_available() else "cpu")
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield Team(device=torch.device(kind))
        return
    rank, local = int(os.environ["RANK"]), int(os.environ.get("LOCAL_RANK", "0"))
    dist.init_process_group("nccl" if kind == "cuda" else "gloo")
    try:
        yield Team(rank, size, torch.device(kind, local) if kind == "cuda" else torch.device(kind))
    finally:
        dist.destroy_process_group()


def leads() -> bool:
    """Whether this process is the first of those that torchrun started, or the only one."""
    return os.environ.get("RANK", "0") == "0"
