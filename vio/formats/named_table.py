"""Tables with a title line: columns found by name, delimiter found by looking, times kept exact.

A column of time is named `t_ns`, `t_us`, `t_ms` or `t_s`; the unit is always part of the name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio.calibration import short_name
from vio.errors import FormatError, VioError
from vio.formats.table import TextTable, parse_floats, parse_times, read_text

Array = NDArray[np.float64]

DELIMITERS = (",", ";", "\t")
NS_PER_UNIT = {"t_ns": 1, "t_us": 1_000, "t_ms": 1_000_000, "t_s": 1_000_000_000}
OTHER_NAMES = {"timestamp [ns]": "t_ns", "time(s)": "t_s"}
"""What EuRoC and VR-Caps call the time."""


@dataclass(frozen=True)
class NamedTable:
    """Rows of a file and where each named column is."""

    table: TextTable
    columns: dict[str, int]
    delimiter: str
    error: type[VioError]

    def times_ns(self) -> NDArray[np.int64]:
        """The column of time as int64 nanoseconds (N,), strictly increasing.

        Raises:
            VioError: no such column or several, or an unusable time, naming its line.
        """
        there = [name for name in NS_PER_UNIT if name in self.columns]
        if len(there) != 1:
            raise self.error(f"{self.table.name}: {'no' if not there else 'more than one'} column of time; name one of "
                             f"{', '.join(NS_PER_UNIT)} (the unit is part of the name); {self._found()}")
        return parse_times(self.texts(there[0]), NS_PER_UNIT[there[0]], self.table, self.error)[0]

    def texts(self, name: str) -> list[str]:
        """One column as text, without quotes.

        Raises:
            VioError: no such column, or a row that is too short.
        """
        column = self._column(name)
        out = []
        for k, row in enumerate(self.table.rows):
            fields = row.split(self.delimiter)
            if len(fields) <= column:
                raise self.error(f"{self.table.at(k)}: {len(fields)} columns, expected at least {column + 1}")
            out.append(fields[column].strip().strip('"'))
        return out

    def floats(self, names: Sequence[str]) -> Array:
        """Columns as numbers (N, len(names)).

        Raises:
            VioError: no such column, or a value that is no finite number, naming its line.
        """
        return parse_floats(self.table, [self._column(name) for name in names], self.delimiter, self.error)

    def _column(self, name: str) -> int:
        if name not in self.columns:
            raise self.error(f"{self.table.name}: no column {name!r}; {self._found()}")
        return self.columns[name]

    def _found(self) -> str:
        return f"found {', '.join(repr(name) for name in self.columns)} separated by {self.delimiter!r}"


def read_named_table(path: Path, error: type[VioError] = FormatError) -> NamedTable:
    """Read a table whose first line names its columns, separated by comma, semicolon or tab.

    Raises:
        error: no text, no rows, a name that occurs twice, or no delimiter in the title line.
    """
    lines = [(k, line.strip()) for k, line in enumerate(read_text(path, error).split("\n"), 1) if line.strip()]
    name = short_name(path)
    if len(lines) < 2:
        raise error(f"{name}: {'no rows below the title line' if lines else 'empty'}; give a title line and rows")
    title = lines[0][1].lstrip("# ")
    delimiter = max(DELIMITERS, key=title.count)
    names = [field.strip().strip('"').lower() for field in title.split(delimiter)]
    names = [OTHER_NAMES.get(field, field) for field in names]
    if len(names) == 1 and names[0] not in NS_PER_UNIT:
        raise error(f"{name} line {lines[0][0]}: the title line {title[:40]!r} has no comma, semicolon or tab; "
                    "separate the columns with one of them and name them in the first line")
    twice = sorted({field for field in names if names.count(field) > 1})
    if twice:
        raise error(f"{name} line {lines[0][0]}: column {twice[0]!r} occurs twice; rename one")
    rows = [(k, row) for k, row in lines[1:] if not row.startswith("#")]
    table = TextTable(name, title, [row for _, row in rows], [k for k, _ in rows])
    return NamedTable(table, {field: k for k, field in enumerate(names)}, delimiter, error)
