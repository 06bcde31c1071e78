"""Text tables of stamped rows: quick to read, and every complaint names the line of the file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation, Overflow
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio.calibration import short_name
from vio.errors import FormatError, VioError

Array = NDArray[np.float64]
QUATERNION_TOLERANCE = 1e-3
LARGEST_NS = 2**62  # so that no difference of two overflows; 146 years


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


def read_text(path: Path, error: type[VioError] = FormatError) -> str:
    """The whole text of a UTF-8 file.

    Raises:
        error: the file is missing or is not text.
    """
    name = short_name(path)
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise error(f"{name}: no such file") from None
    except UnicodeDecodeError:
        raise error(f"{name}: not a text file in UTF-8; save it again as UTF-8 text with plain numbers") from None
    except OSError as problem:
        raise error(f"{name}: cannot be read ({problem.strerror})") from None


def read_table(path: Path, error: type[VioError] = FormatError, drop_unfinished: bool = False) -> TextTable:
    """Split a text file into rows; blank lines, `#` comments and a title line are set apart.

    Args:
        path: the file.
        error: what to raise.
        drop_unfinished: leave out a last line without a line end: whoever wrote the file was cut off.

    Raises:
        error: the file is missing or is not text.
    """
    text = read_text(path, error)
    if drop_unfinished:
        text = text[: text.rfind("\n") + 1]
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
    return TextTable(short_name(path), " ".join(header), rows, lines)


def parse_floats(table: TextTable, columns: Sequence[int], delimiter: str | None, error: type[VioError]) -> Array:
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
            raise error(f"{table.at(k)}: stamp {field[:40]!r} is not a whole number of nanoseconds; separate columns "
                        "by commas and write stamps without a point") from None
    return check_increasing(stamps, table, error)


def parse_times(
    fields: Sequence[str], ns_per_unit: int, table: TextTable, error: type[VioError], repair: bool = False
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Decimal times, one per row, as int64 nanoseconds, never by way of floating point.

    Args:
        fields: the text of every time.
        ns_per_unit: 10^9 for seconds, 1 for nanoseconds.
        table: where they come from.
        error: what to raise.
        repair: drop the later ones of equal times instead of refusing them.

    Returns:
        The times that are kept, and which rows (N,) they are.

    Raises:
        error: a time that is no number, beyond 64 bits, or not later than the one before, naming its line.
    """
    stamps = np.empty(len(fields), np.int64)
    for k, field in enumerate(fields):
        try:
            exact = Decimal(field.strip()) * ns_per_unit
        except (InvalidOperation, Overflow):
            exact = Decimal("nan")
        if not (exact.is_finite() and -LARGEST_NS < exact < LARGEST_NS):
            raise error(f"{table.at(k)}: time {field.strip()[:40]!r} is no number of 64 bits in nanoseconds; write "
                        "decimals with a point")
        stamps[k] = round(exact)
    keep = np.ones(len(stamps), bool)
    if repair:
        keep[1:] = stamps[1:] != stamps[:-1]
    rows = np.flatnonzero(keep)
    kept = TextTable(table.name, table.header, [table.rows[k] for k in rows], [table.lines[k] for k in rows])
    return check_increasing(stamps[keep], kept, error), keep


def check_increasing(stamps: NDArray[np.int64], table: TextTable, error: type[VioError]) -> NDArray[np.int64]:
    """Return stamps (N,) if every one is later than the one before.

    Raises:
        error: one is not, naming its line.
    """
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
    with np.errstate(over="ignore"):  # infinite is not of unit length either
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


def _find_bad_row(table: TextTable, columns: Sequence[int], delimiter: str | None) -> str:
    for k, row in enumerate(table.rows):
        fields = row.split(delimiter)
        if len(fields) <= max(columns):
            return f"{table.at(k)}: {len(fields)} columns, expected at least {max(columns) + 1}"
        for column in columns:
            try:
                float(fields[column])
            except ValueError:
                return f"{table.at(k)}: {fields[column].strip()!r} in column {column + 1} is not a number"
    return f"{table.name}: not a table of numbers"
