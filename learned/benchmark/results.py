"""From the results of runs to a table in values that JSON can hold: lines, guesses, paired differences, verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from learned.benchmark.budgets import Budget
from learned.benchmark.conditions import CLEAN
from learned.benchmark.data_set import DataSet
from learned.benchmark.runs import Run
from learned.benchmark.scores import HEADLINES, METRICS, Metric
from learned.benchmark.statistics import COVERAGE, DRAWS, FEWEST_SEQUENCES, Difference, paired_difference
from learned.benchmark.tables import VISION, Comparison, Line, TablePlan, Variant

Array = NDArray[np.float64]
Parts: TypeAlias = Mapping[tuple[Variant, int], Mapping[str, dict[str, Any]]]
"""Results by variant and seed, then by condition."""

SCHEMA = 1
GUESS = "no network: constant depth, rest"
GUESSES = {"abs_rel": "the same depth everywhere", "are_paper_deg": "a guess of no rotation"}
"""What variants have to beat, by metric. Translation is left out: a scale fitted to truth lets any motion beat rest."""


def table_of(plan: TablePlan, budget: Budget, data: DataSet, runs: list[Run], parts: Parts) -> dict[str, Any]:
    """The whole table.

    Args:
        plan: of the table.
        budget: that its runs had.
        data: that they were trained and judged on.
        runs: all of them.
        parts: their results.
    """
    seeds = list(range(budget.seeds))
    comparisons = [_comparison(plan, comparison, parts, seeds) for comparison in plan.comparisons]
    return {"schema": SCHEMA, "table": plan.name, "title": plan.title, "paper": plan.paper,
            "lines": [_line(line, parts, seeds) for line in plan.lines],
            "guesses": _guesses(plan, parts), "comparisons": comparisons,
            "verdicts": [*verdicts(comparisons, budget.seeds), *_learned_anything(plan, parts, seeds)],
            "metrics": {m.key: {"label": m.label, "alignment": m.alignment, "higher_is_better": m.higher_is_better}
                        for m in METRICS},
            "manifest": _manifest(budget, data, runs, parts)}


def cells(line: Line, key: str, parts: Parts, seeds: list[int]) -> Array:
    """(seeds, sequences) values of one metric, mean over the line's conditions; NaN where one has none."""
    paths = list(parts[line.variant, seeds[0]][line.conditions[0]]["scores"])
    values = [[[parts[line.variant, seed][name]["scores"][path][key] for name in line.conditions] for path in paths]
              for seed in seeds]
    return np.asarray(np.array(values, float).mean(axis=2))


def _line(line: Line, parts: Parts, seeds: list[int]) -> dict[str, Any]:
    return {"row": line.row, "side": line.side, "method": line.variant.method, "fusion": line.variant.fusion,
            "means": {m.key: _mean(cells(line, m.key, parts, seeds)) for m in METRICS},
            "snr": _snr(line, parts, seeds)}


def _mean(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None


def _snr(line: Line, parts: Parts, seeds: list[int]) -> dict[str, float] | None:
    """Geometric mean SNR by test sequence, which must move with the vibration; None where a variant has none."""
    logs: dict[str, list[float]] = {}
    for seed in seeds:
        for path, value in (parts[line.variant, seed][line.conditions[0]]["mean_log_snr"] or {}).items():
            logs.setdefault(path, []).append(value)
    return {path: float(np.exp(np.mean(values))) for path, values in logs.items()} or None


def _guesses(plan: TablePlan, parts: Parts) -> list[dict[str, Any]]:
    """What needs no network, once per choice of test sequences."""
    found = {}
    for line in plan.lines:
        where = (line.variant.sets, line.variant.level)
        if where in found or CLEAN.name not in line.conditions:
            continue
        level = "" if line.variant.level is None else f", level {line.variant.level}"
        found[where] = {"row": f"{', '.join(line.variant.sets)}{level}", "side": GUESS,
                        "means": _guess(line.variant, parts)}
    return list(found.values())


def _guess(variant: Variant, parts: Parts) -> dict[str, float | None]:
    per_sequence = parts[variant, 0][CLEAN.name]["guess"].values()
    return {m.key: _mean(np.array([scores[m.key] for scores in per_sequence], float)) for m in METRICS}


def _comparison(plan: TablePlan, comparison: Comparison, parts: Parts, seeds: list[int]) -> dict[str, Any]:
    """All metrics of one comparison."""
    def together(numbers: tuple[int, ...], key: str) -> Array:
        return np.concatenate([cells(plan.lines[k], key, parts, seeds) for k in numbers], axis=1)
    baseline = plan.lines[comparison.baselines[0]].side
    candidate = comparison.row if plan.name == "fusion" else plan.lines[comparison.candidates[0]].side
    differences: dict[str, Any] = {}
    for metric in METRICS:
        found = paired_difference(together(comparison.baselines, metric.key),
                                  together(comparison.candidates, metric.key),
                                  f"{plan.name} {comparison.row} {metric.key}")
        differences[metric.key] = None if found is None else asdict(found) | {
            "verdict": verdict(metric, found, baseline, candidate)}
    return {"row": comparison.row, "baseline": baseline, "candidate": candidate, "differences": differences}


def verdict(metric: Metric, found: Difference, baseline: str, candidate: str) -> str:
    """Who wins one metric, and whether the interval excludes 0: one sentence."""
    if found.mean == 0:
        return f"{metric.label}: no difference at all"
    wins = (found.mean > 0) == metric.higher_is_better
    text = f"{metric.label}: {candidate if wins else baseline} is better by {abs(found.mean):.3g}"
    if found.low is None or found.high is None:
        return (f"{text}; {found.sequences} sequence{'s are' if found.sequences > 1 else ' is'} too few for an "
                f"interval (at least {FEWEST_SEQUENCES})")
    interval = f"{found.low:+.3g} to {found.high:+.3g}"
    says = "excludes 0" if found.excludes_zero else "includes 0, so these data do not tell the two apart"
    return f"{text}; the 95 % interval of the difference, {interval}, {says}"


def verdicts(comparisons: list[dict[str, Any]], seeds: int) -> list[str]:
    """One sentence per headline metric over all comparisons of a table, and what the intervals leave out."""
    sentences = []
    for metric in (m for m in METRICS if m.key in HEADLINES):
        found = [c["differences"][metric.key] for c in comparisons if c["differences"][metric.key] is not None]
        sign = 1 if metric.higher_is_better else -1
        better = [d for d in found if sign * d["mean"] > 0]
        worse = [d for d in found if sign * d["mean"] < 0]
        sentences.append(f"{metric.label}: with vibration better in {len(better)} of {len(found)} comparisons "
                         f"(interval excludes 0 in {_sure(better)}), {VISION} better in {len(worse)} (in "
                         f"{_sure(worse)}).")
    if seeds == 1:
        sentences.append("One seed: the intervals speak of other test sequences, not of other trainings, which may "
                         "differ by more.")
    return sentences


def _learned_anything(plan: TablePlan, parts: Parts, seeds: list[int]) -> list[str]:
    """How many lines beat what needs no network; where few do, the comparison is one of networks that know nothing."""
    lines = [line for line in plan.lines if line.conditions == (CLEAN.name,)]
    sentences = []
    for metric, what in ((m, GUESSES[m.key]) for m in METRICS if m.key in GUESSES):
        better = 0
        for line in lines:
            mean, guessed = (_mean(cells(line, metric.key, parts, seeds)), _guess(line.variant, parts)[metric.key])
            better += mean is not None and guessed is not None and mean < guessed
        sentences.append(f"{metric.label}: {better} of {len(lines)} variants beat {what}.")
    return sentences


def _sure(differences: list[dict[str, Any]]) -> int:
    return sum(d["low"] is not None and (d["low"] > 0 or d["high"] < 0) for d in differences)


def _manifest(budget: Budget, data: DataSet, runs: list[Run], parts: Parts) -> dict[str, Any]:
    """What the table was made of."""
    every = [part for conditions in parts.values() for part in conditions.values()]
    used = {entry.path: entry.sha256 for run in runs for entry in (*run.train_on, *run.judge_on)}
    return {"budget": asdict(budget), "seeds": list(range(budget.seeds)),
            "versions": [dict(found) for found in sorted({tuple(part["versions"].items()) for part in every}, key=str)],
            "data": {"simulator_version": data.simulator_version, "sha256": dict(sorted(used.items()))},
            "steps": {run.name: next(iter(parts[run.variant, run.seed].values()))["trained"]["steps"] for run in runs},
            "bootstrap": {"draws": DRAWS, "coverage": COVERAGE,
                          "kind": "percentile, seeds and sequences resampled, stretched for few cells"}}
