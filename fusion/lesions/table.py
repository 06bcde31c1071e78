"""Located lesions as a value and on disk: `lesions.csv` and `lesions.json` of the contract (docs/conventions.md)."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.lesions.measures import LEVEL, Interval
from vio.atomic import atomic_write
from vio.errors import FormatError, OutputError

Array = NDArray[np.float64]

SCHEMA = 1
COLUMNS = (
    "id", "label", "kind", "frame", "timestamp_s", "x_mm", "y_mm", "z_mm", "sd_major_mm", "sd_mid_mm", "sd_minor_mm",
    "arc_length_mm", "arc_lo_mm", "arc_hi_mm", "nearest_landmark", "from_landmark_mm", "from_landmark_lo_mm",
    "from_landmark_hi_mm", "percent_path", "percent_path_lo", "percent_path_hi", "percent_time", "status",
)
FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")
"""What makes a spreadsheet run a cell instead of showing it."""


@dataclass(frozen=True)
class Lesion:
    """One lesion or landmark; what cannot be known is None and `status` says why."""

    id: str
    label: str
    kind: str
    frame: int
    """Of the sighting in the middle, counted in the recording."""
    timestamp_s: float
    point_m: Array
    """(3,) in the world."""
    sd_axes_m: Array
    """(3,) standard deviations along the axes of the ellipsoid, largest first."""
    cov_m2: Array
    """(3, 3) in world axes."""
    arc_m: Interval | None
    """From the first frame along the travelled centreline."""
    nearest_landmark: str | None
    from_landmark_m: Interval | None
    """Beyond the nearest landmark; negative before it."""
    percent_path: Interval | None
    percent_time: float | None
    status: str
    sightings: tuple[tuple[int, float], ...]
    """Frame and time [s] of every sighting that was merged."""

    def to_dict(self) -> dict[str, Any]:
        """The columns of the contract as plain values."""
        values = [self.id, self.label, self.kind, self.frame, self.timestamp_s, *_mm(self.point_m),
                  *_mm(self.sd_axes_m), *_parts(self.arc_m, 1e3), self.nearest_landmark,
                  *_parts(self.from_landmark_m, 1e3), *_parts(self.percent_path, 1.0), self.percent_time, self.status]
        return dict(zip(COLUMNS, values, strict=True))


@dataclass(frozen=True)
class LesionTable:
    """All lesions and landmarks of one recording, in order of time."""

    name: str
    """Of the recording."""
    lesions: tuple[Lesion, ...]
    between: tuple[str, str] | None
    """Labels of the landmarks that percentages refer to."""

    def __len__(self) -> int:
        return len(self.lesions)

    def to_dict(self) -> dict[str, Any]:
        """Content of `lesions.json`: the contract's columns per lesion, with covariance and sightings beside them."""
        rows = [lesion.to_dict() | {
            "cov_mm2": (1e6 * lesion.cov_m2).tolist(),
            "sightings": [{"frame": frame, "timestamp_s": time} for frame, time in lesion.sightings],
        } for lesion in self.lesions]
        return {"schema": SCHEMA, "interval": LEVEL, "percent_between": self.between and list(self.between),
                "lesions": rows}


def write_lesions(table: LesionTable, folder: str | Path) -> tuple[Path, Path]:
    """Write `lesions.csv` and `lesions.json` into a folder, each whole or not at all, and return their paths.

    Raises:
        OutputError: the folder cannot be written, or holds a `lesions.csv` that is not ours, such as the list itself.
    """
    folder = Path(folder)
    _check_ours(folder / "lesions.csv")
    as_json = json.dumps(table.to_dict(), indent=2, allow_nan=False) + "\n"
    for name, text in (("lesions.csv", _csv(table)), ("lesions.json", as_json)):
        with atomic_write(folder / name) as file:
            file.write(text.encode())
    return folder / "lesions.csv", folder / "lesions.json"


def _check_ours(path: Path) -> None:
    if path.exists() and not (path.is_file() and path.read_bytes().startswith(",".join(COLUMNS).encode() + b"\n")):
        raise OutputError(f"{path.name} exists there and was not written by capsule-vio; choose another --out")


def read_lesions(folder: str | Path) -> list[dict[str, Any]] | None:
    """Rows of a folder's `lesions.json` for showing; None where there is none.

    Raises:
        FormatError: the file is not one that `write_lesions` wrote.
    """
    path = Path(folder) / "lesions.json"
    if not path.is_file():
        return None
    remedy = "run `capsule-vio locate` again"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise FormatError(f"{path.parent.name}/{path.name}: not valid JSON; {remedy}") from None
    rows = content.get("lesions") if isinstance(content, dict) and content.get("schema") == SCHEMA else None
    if not isinstance(rows, list) or not all(isinstance(row, dict) and _complete(row) for row in rows):
        raise FormatError(f"{path.parent.name}/{path.name}: not lesions of schema {SCHEMA}; {remedy}")
    return rows


def _complete(row: dict[str, Any]) -> bool:
    """All columns there, text where text is due and finite numbers or nothing elsewhere."""
    texts = {"id", "label", "kind", "nearest_landmark", "status"}
    return set(COLUMNS) <= set(row) and all(
        isinstance(row[key], str) if key in texts and key != "nearest_landmark" else
        row[key] is None or (isinstance(row[key], str) if key in texts else _is_number(row[key])) for key in COLUMNS)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _csv(table: LesionTable) -> str:
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for lesion in table.lesions:
        writer.writerow([_cell(value) for value in lesion.to_dict().values()])
    return out.getvalue()


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, str):
        return "'" + value if value.startswith(FORMULA_STARTS) else value
    return str(value) if isinstance(value, int) else f"{value:.9g}"


def _mm(metres: Array) -> list[float]:
    return [1e3 * float(value) for value in metres]


def _parts(interval: Interval | None, factor: float) -> list[float | None]:
    return [None] * 3 if interval is None else [None if v is None else factor * v for v in interval]
