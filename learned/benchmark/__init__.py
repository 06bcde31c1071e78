"""The tables of the V²-SfMLearner paper, each measured by one command.

    from learned.benchmark import run_table
    table = run_table("methods", "DATA", "smoke", "OUT")      # OUT/methods.md, OUT/methods.json, OUT/runs/…

DATA is what `capsule-vio simulate --dataset mm-wce --out DATA` writes. What a budget costs and what it can show:
docs/benchmarks.md.
"""

from learned.benchmark.budgets import BUDGETS, Budget
from learned.benchmark.command import run_table
from learned.benchmark.tables import TABLES

__all__ = ["BUDGETS", "TABLES", "Budget", "run_table"]
