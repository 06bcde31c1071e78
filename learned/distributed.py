"""One process among several, as `torchrun` starts them; alone without it."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.distributed as dist
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

POLL_S = 0.2


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
def team(device: str | None = None, alone: bool = False) -> Iterator[Team]:
    """Join the processes that torchrun's environment describes, and leave them at the end.

    Args:
        device: "cpu" or "cuda"; None = cuda where there is one.
        alone: train by oneself even so, on this process's own device, for the others do other work.
    """
    kind, size, own = _kind(device), int(os.environ.get("WORLD_SIZE", "1")), _own_device(device)
    if size == 1 or alone:
        yield Team(device=own if size > 1 else torch.device(kind))
        return
    dist.init_process_group("nccl" if kind == "cuda" else "gloo")
    try:
        yield Team(int(os.environ["RANK"]), size, own)
    finally:
        dist.destroy_process_group()


@dataclass(frozen=True)
class Shares:
    """Work in numbered pieces that the processes under torchrun take one after the other; all of it without torchrun.

    Made by `shares`. Pieces go to whoever is free, so that their results must not depend on who does them.
    """

    leads: bool = True
    """Whether this is the process that puts the results together."""
    store: Any = None
    """torch's key-value store that all processes see; None where there is only one."""
    size: int = 1

    def take(self, count: int) -> Iterator[int]:
        """Numbers below `count` that nobody else takes."""
        if self.store is None:
            yield from range(count)
            return
        while (piece := self.store.add("taken", 1) - 1) < count:
            yield piece

    def wait(self) -> None:
        """Return when all processes have come here: every piece is done. The leader, who may keep the store, is last.

        A process that fails never comes; torchrun then ends the others.
        """
        if self.store is None:
            return
        self.store.add("done", 1)
        while self.store.add("done", 0) < self.size:
            time.sleep(POLL_S)
        self.store.add("gone", 1)
        while self.leads and self.store.add("gone", 0) < self.size:
            time.sleep(POLL_S)


def shares(what: str) -> Shares:
    """The processes that torchrun's environment describes, about to share work that all of them know.

    Args:
        what: name of the work, another one for every time within the life of the processes.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return Shares()
    store, rank, size = next(iter(rendezvous("env://")))
    return Shares(rank == 0, PrefixStore(what, store), size)


def _kind(device: str | None) -> str:
    return device or ("cuda" if torch.cuda.is_available() else "cpu")


def _own_device(device: str | None) -> torch.device:
    """Every process's own among several."""
    kind = _kind(device)
    return torch.device(kind, int(os.environ.get("LOCAL_RANK", "0"))) if kind == "cuda" else torch.device(kind)


def leads() -> bool:
    """Whether this process is the first of those that torchrun started, or the only one."""
    return os.environ.get("RANK", "0") == "0"
