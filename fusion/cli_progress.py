"""Progress on stderr: a line that rewrites itself on a terminal, plain lines otherwise."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from tqdm import tqdm


class Progress:
    """Stages, and how much of a known total is done.

    Args:
        remaining: seconds left when a stage begins, from its name and the seconds since the beginning; None = unknown.
    """

    def __init__(self, remaining: Callable[[str, float], float | None] | None = None) -> None:
        self.remaining, self.begun = remaining, time.monotonic()
        self.bar = tqdm(bar_format="{desc} {elapsed}", leave=False, disable=not sys.stderr.isatty())

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *error: object) -> None:
        self.bar.close()

    def __call__(self, stage: str) -> None:
        """Announce a stage."""
        left = None if self.remaining is None else self.remaining(stage, time.monotonic() - self.begun)
        text = f"… {stage.replace('_', ' ')}" + (f", about {left:.0f} s left" if left is not None and left > 1 else "")
        if self.bar.disable:
            sys.stderr.write(f"{text}\n")
            sys.stderr.flush()
        else:
            self.bar.set_description_str(text)

    def count(self, done: int, total: int) -> None:
        """Announce how much of a known total is done, in steps of a tenth where lines are plain."""
        if not self.bar.disable:
            self.bar.set_description_str(f"… {done} of {total}")
        elif done * 10 // total != (done - 1) * 10 // total:
            self(f"{done} of {total}")
