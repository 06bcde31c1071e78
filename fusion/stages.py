"""Named stages of a long computation: how long each took, and a word to whoever watches."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

DONE_BEFORE = {"fixed_scale": 0.42, "free_scale": 0.52, "gate": 0.6, "covariances": 0.83}
"""Share of the graph's time that has passed when a stage begins, as measured on 86,400 frames."""


def remaining_s(stage: str, elapsed_s: float) -> float | None:
    """About how long the graph still takes when a stage begins; None where that is not known."""
    done = DONE_BEFORE.get(stage)
    return None if done is None else elapsed_s * (1 - done) / done


class Stages:
    """Times stages; a stage entered twice adds up.

    Args:
        announce: called with the name of every stage as it begins.
    """

    def __init__(self, announce: Callable[[str], None] | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self._announce = announce

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Run the block as stage `name`."""
        if self._announce is not None:
            self._announce(name)
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begun
