"""A table as a page that people read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from learned.benchmark.scores import HEADLINES, METRICS, PER_IMAGE, PER_SEQUENCE, SIM3, Metric

DEPTH = tuple(m for m in METRICS if m.alignment == PER_IMAGE)
MOTION = tuple(m for m in METRICS if m.alignment in (PER_SEQUENCE, SIM3))
SMOKE = ("**Smoke shows that the command works, not who wins**: networks a fraction of their size that took a handful "
         "of steps on a few frames.")


def markdown(table: dict[str, Any]) -> str:
    """The page of a table that `learned.benchmark.results.table_of` made."""
    manifest = table["manifest"]
    budget = manifest["budget"]
    steps = sorted(set(manifest["steps"].values()))
    size = f"{budget['image_size'][1]} × {budget['image_size'][0]} px"
    many = f"{steps[0]}" if len(steps) == 1 else f"{steps[0]} to {steps[-1]}"
    head = (f"Stands for the paper's {table['paper']}. Budget `{budget['name']}`: {len(manifest['seeds'])} seed(s), "
            f"{many} steps at batch {budget['batch_size']}, {size}, width {budget['width']:g}; the same data, seeds "
            "and steps on both sides of every comparison.")
    rows = [*table["lines"], *table["guesses"]]
    return "\n\n".join([
        f"# {table['title']}", *([SMOKE] if budget["name"] == "smoke" else []), head,
        "## Verdict\n\n" + "\n".join(f"- {sentence}" for sentence in table["verdicts"])
        + "\n\nAt 95 %, one interval in twenty excludes 0 though there is nothing.",
        f"## Depth\n\nAligned by {PER_IMAGE} (truth over prediction); higher Acc is better, lower of the rest.\n\n"
        + _lines(rows, DEPTH),
        f"## Motion\n\nAligned by {PER_SEQUENCE}, the trajectory by {SIM3}; lower is better. The paper's ATE and ARE "
        "are means over adjacent frames, t-error and r-error their root mean squares, \"ATE, trajectory\" is the rmse "
        "of position.\n\n" + _lines(rows, MOTION),
        "## Paired differences\n\nCandidate minus baseline on the same test sequences and seeds, with bootstrap "
        "intervals.\n\n" + _comparisons(table["comparisons"]),
        _footer(manifest)]) + "\n"


def _grid(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _lines(rows: Sequence[dict[str, Any]], metrics: Sequence[Metric]) -> str:
    return _grid(["", "", *(m.label for m in metrics)],
                 [[row["row"], row["side"], *(_number(row["means"][m.key], m) for m in metrics)] for row in rows])


def _number(value: float | None, metric: Metric) -> str:
    return "–" if value is None else f"{value:.{metric.digits}f}"


def _comparisons(comparisons: Sequence[dict[str, Any]]) -> str:
    lines = []
    for comparison in comparisons:
        for metric in (m for m in METRICS if m.key in HEADLINES):
            found = comparison["differences"][metric.key]
            says = f"{metric.label}: no sequence determines it" if found is None else found["verdict"]
            lines.append(f"- {comparison['row']}, {says}.")
    return "\n".join(lines)


def _footer(manifest: dict[str, Any]) -> str:
    versions = "; ".join(", ".join(f"{name} {number or '(not installed)'}" for name, number in found.items())
                         for found in manifest["versions"])
    return (f"{len(manifest['steps'])} trainings on {len(manifest['data']['sha256'])} sequences of simulator "
            f"{manifest['data']['simulator_version']}, whose SHA-256 are in the JSON beside this page; {versions}.")
