"""The tables that `capsule-vio benchmark` measured into one folder, as one page of docs/results.

    capsule-vio simulate --dataset mm-wce --duration 6 --size 64 --out out/mm-wce
    capsule-vio benchmark methods --data out/mm-wce --budget smoke --out out/tables      # and the other tables
    python benchmarks/record_tables.py out/tables --name paper_tables_smoke
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path

from results import record

from learned.benchmark import TABLES
from learned.benchmark.markdown import SMOKE, markdown

LEFT_OUT = "## Paired differences"
"""Part of a table's page: one line per comparison and headline metric, too long for all tables together."""


def section(table: dict) -> str:
    """A table's page, one level deeper, without the list of its differences and what is said once for all."""
    page = markdown(table)
    kept, rest = page.split(LEFT_OUT)
    footer = rest.strip().splitlines()[-1]
    return re.sub(r"^#", "##", kept.replace(f"{SMOKE}\n\n", ""), flags=re.MULTILINE).strip() + f"\n\n{footer}"


def main() -> None:
    """Record what is there, and say what is not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--name", required=True)
    parser.add_argument("--note", default="", help="a remark for the page")
    args = parser.parse_args()
    sys.argv = [word for word in sys.argv if word not in ("--note", args.note)]  # a remark is no part of the command
    found = {name: args.out / f"{name}.json" for name in TABLES if (args.out / f"{name}.json").is_file()}
    tables = [json.loads(path.read_text(encoding="utf-8")) for path in found.values()]
    budgets = sorted({table["manifest"]["budget"]["name"] for table in tables})
    missing = [name for name in TABLES if name not in found]
    parts = [SMOKE] if budgets == ["smoke"] else []
    parts += [args.note] if args.note else []
    parts += [f"Not measured: {', '.join(missing)}."] if missing else []
    parts.append("What the budgets are, what is the same on both sides and what the intervals mean: "
                 "[benchmarks.md](../benchmarks.md). The paired differences of all metrics are in the JSON files that "
                 "the commands write.")
    record(args.name, f"The paper's tables at budget {', '.join(budgets)}",
           "\n\n".join([*parts, *(section(table) for table in tables)]))


if __name__ == "__main__":
    main()
