"""The plans of the paper's tables: which variants are trained on what, and what is compared with what."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from learned.benchmark.budgets import METHODS, STRATEGIES
from learned.benchmark.conditions import CLEAN, CORRUPTED, Condition
from learned.errors import BenchmarkError
from vio.corruptions import CORRUPTIONS, SEVERITIES

VISION, VIBRATION = "vision-only", "vision–vibration"
FIRST, SECOND = "mm-wce-1", "mm-wce-2"
JOINT = (FIRST, SECOND)
LEVELS = (1, 2, 3, 4, 5)
BASELINE = "af-sfmlearner"
"""The method of the paper's ablations."""


@dataclass(frozen=True)
class Variant:
    """A training without its seed."""

    method: str
    fusion: str | None
    """Of `STRATEGIES`; None = vision alone."""
    sets: tuple[str, ...]
    """Trained on their training sequences, judged on their test sequences."""
    level: int | None = None
    """Of vibration, in training and test; None = all."""
    conditions: tuple[Condition, ...] = (CLEAN,)
    """What the test images are shown as."""

    @property
    def name(self) -> str:
        """Of its files; tables that need the same training share it."""
        level = "" if self.level is None else f"_level-{self.level}"
        return f"{self.method}_{self.fusion or 'vision'}_{'+'.join(self.sets).replace('/', '-')}{level}"


@dataclass(frozen=True)
class Line:
    """One line of a table: a variant, averaged over some conditions."""

    row: str
    side: str
    variant: Variant
    conditions: tuple[str, ...] = (CLEAN.name,)


@dataclass(frozen=True)
class Comparison:
    """Candidates against baselines, all numbers of lines; several = their sequences, which differ, taken together."""

    row: str
    baselines: tuple[int, ...]
    candidates: tuple[int, ...]


@dataclass(frozen=True)
class TablePlan:
    """One table."""

    name: str
    title: str
    paper: str
    """Which of the paper's it stands for."""
    lines: tuple[Line, ...]
    comparisons: tuple[Comparison, ...]

    @property
    def variants(self) -> tuple[Variant, ...]:
        """What has to be trained, each once."""
        return tuple(dict.fromkeys(line.variant for line in self.lines))


def plan_table(name: str, method: str = BASELINE) -> TablePlan:
    """The plan of a table.

    Args:
        name: of `TABLES`.
        method: of the tables that have one; `methods` takes all.

    Raises:
        BenchmarkError: no such table or method.
    """
    if name not in TABLES:
        raise BenchmarkError(f"benchmark: table {name!r} is unknown, choose one of {', '.join(TABLES)}")
    if method not in METHODS:
        raise BenchmarkError(f"benchmark: method {method!r} is unknown, choose one of {', '.join(METHODS)}")
    title, paper, plan = _PLANS[name]
    lines, comparisons = plan(method)
    return TablePlan(name, title if name == "methods" else f"{title}: {method}", paper, tuple(lines),
                     tuple(comparisons))


Plan = tuple[list[Line], list[Comparison]]


def _pairs(rows: Sequence[tuple[str, Callable[[str | None], Variant]]], together: str | None = None) -> Plan:
    """Vision-only and vision–vibration, row by row, and all rows together where their test sequences differ."""
    lines = [Line(row, side, variant(fusion)) for row, variant in rows
             for side, fusion in ((VISION, None), (VIBRATION, "fourier"))]
    comparisons = [Comparison(row, (2 * k,), (2 * k + 1,)) for k, (row, _) in enumerate(rows)]
    if together is not None:
        comparisons.append(Comparison(together, tuple(range(0, len(lines), 2)), tuple(range(1, len(lines), 2))))
    return lines, comparisons


def _of(method: str, *sets: str, level: int | None = None) -> Callable[[str | None], Variant]:
    return lambda fusion: Variant(method, fusion, sets, level)


def _methods(_: str) -> Plan:
    return _pairs([(f"{method}, {data}", _of(method, data)) for data in JOINT for method in METHODS])


def _intensity(method: str) -> Plan:
    return _pairs([(f"level {level}", _of(method, *JOINT, level=level)) for level in LEVELS], "all levels")


def _vibration_types(method: str) -> Plan:
    return _pairs([(kind, _of(method, f"vibration-types/{kind}")) for kind in ("peristalsis", "collision")],
                  "both kinds")


def _fusion(method: str) -> Plan:
    lines = [Line(VISION, VISION, Variant(method, None, (FIRST,)))]
    lines += [Line(name, VIBRATION, Variant(method, name, (FIRST,))) for name in STRATEGIES]
    return lines, [Comparison(name, (0,), (k + 1,)) for k, name in enumerate(STRATEGIES)]


def _corruptions(method: str) -> Plan:
    sides = [(VISION, Variant(method, None, JOINT, conditions=(CLEAN, *CORRUPTED))),
             (VIBRATION, Variant(method, "fourier", JOINT, conditions=(CLEAN, *CORRUPTED)))]
    rows: list[tuple[str, tuple[str, ...]]] = [("clean", (CLEAN.name,))]
    rows += [(kind, tuple(c.name for c in CORRUPTED if c.kind == kind)) for kind in CORRUPTIONS]
    rows += [(f"severity {s}", tuple(c.name for c in CORRUPTED if c.severity == s)) for s in SEVERITIES]
    rows.append(("all 60", tuple(c.name for c in CORRUPTED)))
    lines = [Line(row, side, variant, names) for row, names in rows for side, variant in sides]
    return lines, [Comparison(row, (2 * k,), (2 * k + 1,)) for k, (row, _) in enumerate(rows)]


_PLANS: dict[str, tuple[str, str, Callable[[str], Plan]]] = {
    "methods": ("Methods with and without vibration", "results on MM-WCE-1 and MM-WCE-2", _methods),
    "intensity": ("Vibration levels 1 to 5", "ablation on vibration intensity", _intensity),
    "vibration-types": ("Peristalsis and collision", "ablation on vibration types", _vibration_types),
    "fusion": ("Fusion strategies", "ablation on fusion strategy (MM-WCE-1)", _fusion),
    "corruptions": ("Twelve corruptions in five severities", "robustness experiments", _corruptions),
}
TABLES = tuple(_PLANS)
"""Names of the tables."""
