"""Where benchmarks record what they measured: one Markdown page each under docs/results."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def record(name: str, title: str, body: str) -> None:
    """Print a result and write it to docs/results/NAME.md, with the command and the versions that made it."""
    libraries = ", ".join(f"{lib} {version(lib)}" for lib in ("gtsam", "numpy", "scipy", "filterpy"))
    command = "python " + " ".join(["benchmarks/" + Path(sys.argv[0]).name, *sys.argv[1:]])
    footer = f"Measured with `{command}`; {libraries}, Python {platform.python_version()}, {os.cpu_count()} cores."
    page = f"# {title}\n\n{body}\n\n{footer}\n"
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / f"{name}.md").write_text(page, encoding="utf-8")
    print(page)
