"""`capsule-vio benchmark`: one table from the data set to a page and a file of numbers, run by run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from learned.benchmark.budgets import Budget, budget_of, decisions
from learned.benchmark.data_set import Entry, read_data_set
from learned.benchmark.markdown import markdown
from learned.benchmark.results import table_of
from learned.benchmark.runs import Progress, Run, finish, runs_of
from learned.benchmark.tables import BASELINE, Variant, plan_table
from learned.distributed import shares
from learned.methods import assemble
from vio.atomic import atomic_write
from vio.errors import OutputError


class Silent:
    """Progress that nobody wants to hear of."""

    def __call__(self, stage: str) -> None:
        """Say nothing."""

    def count(self, done: int, total: int) -> None:
        """Say nothing."""


def run_table(table: str, data: str | Path, budget: str, out: str | Path, *, seeds: int | None = None,
              method: str = BASELINE, device: str | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Measure a table, or go on measuring it, and write `OUT/TABLE.json` and `OUT/TABLE.md`.

    Under `torchrun` the processes share the runs: each trains whole runs by itself, so that a table does not depend on
    how many processes there are, and the first one writes it.

    Args:
        table: of `TABLES`.
        data: what `capsule-vio simulate --dataset mm-wce` wrote.
        budget: of `BUDGETS`.
        out: folder; what runs of any table in it have finished is used again.
        seeds: trainings per variant; None = the budget's.
        method: of the tables that look at one method.
        device: "cpu" or "cuda"; None = cuda where there is one.
        progress: who is told.

    Returns:
        What `OUT/TABLE.json` holds.

    Raises:
        BenchmarkError: no such table, data that are missing or changed, finished runs of other decisions.
        ConfigError: no such budget, or a library that a method needs is missing.
        OutputError: the folder cannot be written.
        VioError: recordings that cannot be trained on, see `learned.training.train`.
    """
    tell = progress or Silent()
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out.name} is a file; choose another --out")
    plan, size, found = plan_table(table, method), budget_of(budget, seeds), read_data_set(data)
    runs = runs_of(plan.variants, size, found)
    tell("checking the data")
    found.check(_used(runs), tell.count)
    _check_buildable(plan.variants, size)
    sharing = shares(f"{table} {out.resolve()}")
    for k in sharing.take(len(runs)):
        tell(f"run {k + 1} of {len(runs)}: {runs[k].name}")
        finish(runs[k], found, out, device, tell)
    sharing.wait()
    parts = {(run.variant, run.seed): finish(run, found, out, device, tell) for run in runs}
    result = table_of(plan, size, found, runs, parts)
    if sharing.leads:
        _write(result, out)
    return result


def _used(runs: list[Run]) -> list[Entry]:
    return list(dict.fromkeys(entry for run in runs for entry in (*run.train_on, *run.judge_on)))


def _check_buildable(variants: tuple[Variant, ...], budget: Budget) -> None:
    """Fail now, not after days, where a method lacks a library."""
    for method in dict.fromkeys(variant.method for variant in variants):
        assemble(decisions(budget, method, None, 0, []).method)


def _write(result: dict[str, Any], out: Path) -> None:
    for ending, text in ((".json", json.dumps(result, indent=1, allow_nan=False) + "\n"), (".md", markdown(result))):
        with atomic_write(out / f"{result['table']}{ending}") as file:
            file.write(text.encode())


def summary(result: dict[str, Any], out: str | Path) -> str:
    """Verdicts and where the rest lies, for a terminal."""
    paths = [str(Path(out) / f"{result['table']}{ending}") for ending in (".md", ".json")]
    return "\n".join([result["title"], *result["verdicts"], *paths])
