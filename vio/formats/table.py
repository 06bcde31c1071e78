"""Text tables of stamped rows: quick to read, and every complaint names the line of the file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio.calibration import short_name
from vio.errors import FormatError, VioError

Array = NDArray[np.float64]
QUATERNION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class TextTable:
    """The rows of one file that hold data."""

    name: str
    """Folder and file, for messages."""
    header: str
    """All comment and title lines, joined."""
    rows: list[str]
    lines: list[int]
    """Line in the file of every row, counted from 1."""

    def at(self, row: int) -> str:
        """Where a row is, for messages."""
        return f"{self.name} line {self.lines[row]}"


def read_table(path: Path, error: type[VioError] = FormatError) -> TextTable:
    """Split a text file into rows; blank lines, `#` comments and a title line are set apart.

    Raises:
        error: the file is missing or is not text.
    """
    name = short_name(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise error(f"{name}: no such file") from None
    except UnicodeDecodeError:
        raise error(f"{name}: not a text file; give comma or space separated numbers") from None
    except OSError as problem:
        raise error(f"{name}: cannot be read ({problem.strerror})") from None
    header: list[str] = []
    rows: list[str] = []
    lines: list[int] = []
    for number, line in enumerate(text.split("\n"), 1):
        row = line.strip()
        if row.startswith("#") or (not rows and row[:1].isalpha() and not row.lower().startswith(("nan", "inf"))):
            header.append(row)
        elif row:
            rows.append(row)
            lines.append(number)
    return TextTable(name, " ".join(header), rows, lines)


def parse_floats(table: TextTable, columns: range, delimiter: str | None, error: type[VioError]) -> Array:
    """The given columns of every row as floats (N, len(columns)); further columns are ignored.

    Raises:
        error: a row with too few columns, a value that is no number or not finite, naming its line.
    """
    if not table.rows:
        return np.zeros((0, len(columns)))
    try:
        values = np.loadtxt(table.rows, delimiter=delimiter, usecols=list(columns), ndmin=2, comments=None)
    except ValueError:
        raise error(_find_bad_row(table, columns, delimiter)) from None
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise error(f"{table.at(row)}: a value is not finite; drop or repair that row")
    return values


def parse_stamps(table: TextTable, error: type[VioError]) -> NDArray[np.int64]:
    """The first comma-separated column as int64 nanoseconds (N,), never by way of floating point.

    Raises:
        error: a stamp that is no integer, or not later than the one before, naming its line.
    """
    stamps = np.empty(len(table.rows), np.int64)
    for k, row in enumerate(table.rows):
        field = row.partition(",")[0]
        try:
            stamps[k] = int(field)
        except (ValueError, OverflowError):
            raise error(f"{table.at(k)}: stamp {field!r} is not a whole number of nanoseconds") from None
    bad = stamps[1:] <= stamps[:-1]
    if bad.any():
        k = int(np.argmax(bad)) + 1
        word = "repeats" if stamps[k] == stamps[k - 1] else "is earlier than"
        raise error(f"{table.at(k)}: stamp {stamps[k]} {word} {stamps[k - 1]} in line {table.lines[k - 1]}; "
                    "sort the rows and drop duplicates")
    return stamps


def check_quaternions(quaternions: Array, table: TextTable, error: type[VioError]) -> Array:
    """Return quaternions (N, 4) scaled to unit length.

    Raises:
        error: a length that is off by more than 1e-3, naming its line.
    """
    length = np.linalg.norm(quaternions, axis=1)
    bad = np.abs(length - 1) > QUATERNION_TOLERANCE
    if bad.any():
        row = int(np.argmax(bad))
        raise error(f"{table.at(row)}: quaternion of length {length[row]:.6g} (limit 1 ± {QUATERNION_TOLERANCE:g}); "
                    "check the order of the columns")
    return np.asarray(quaternions / length[:, None])


def write_stamped_rows(path: Path, header: str, t_ns: NDArray[np.int64], values: Array) -> None:
    """Write comma separated rows with 17 significant digits, so that reading gives back the same numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    line = "%d" + ",%.17g" * values.shape[1] + "\n"
    with path.open("w", encoding="utf-8") as file:
        file.write(header + "\n")
        file.writelines(line % (t, *row) for t, row in zip(t_ns.tolist(), values.tolist(), strict=True))


def _find_bad_row(table: TextTable, columns: range, delimiter: str | None) -> str:
    for k, row in enumerate(table.rows):
        fields = row.split(delimiter)
        if len(fields) < columns.stop:
            return f"{table.at(k)}: {len(fields)} columns, expected at least {columns.stop}"
        for column in columns:
            try:
                float(fields[column])
            except ValueError:
                return f"{table.at(k)}: {fields[column].strip()!r} in column {column + 1} is not a number"
    return f"{table.name}: not a table of numbers"
