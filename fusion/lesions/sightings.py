"""What was seen where: lists of lesions and landmarks, as simple CSV or as Kvasir-Capsule's `metadata.csv`.

Simple CSV: comma separated, UTF-8, a header with `label` and one or both of `frame` (counted from 0) and `timestamp_s`
(seconds after the recording's first frame), of which every row fills one; optional `u`, `v` (pixel), `kind`
(`finding`, the default, or `landmark`) and `id` (unique). Further columns are ignored.

Kvasir-Capsule (Smedsrud et al., Scientific Data 8, 2021): `;` between the columns `filename;video_id;frame_number;
finding_category;finding_class;x1;y1;...;x4;y4`. Rows without a box are one field short. A box is four corners, of
which the mean is taken. Anatomical classes become landmarks; classes that speak of no place in the gut are left out.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vio.errors import LesionError

Kind = Literal["finding", "landmark"]

KVASIR_HEADER = ("filename", "video_id", "frame_number", "finding_category", "finding_class")
KVASIR_FIELDS = 13
KVASIR_LANDMARKS = {"pylorus", "ampulla of vater", "ileocecal valve", "ileo-cecal valve"}
NO_PLACE = {"normal clean mucosa", "reduced mucosal view"}
"""Kvasir-Capsule's classes that describe the view, not a place."""
LONGEST_LABEL = 200


@dataclass(frozen=True)
class Sighting:
    """One row: something seen in one frame."""

    label: str
    kind: Kind
    frame: int | None
    """Frame number in the recording, counted from 0; None where the time is given."""
    timestamp_s: float | None
    """Seconds after the recording's first frame; None where the frame is given."""
    pixel: tuple[float, float] | None
    """u, v; None = the centre of the image."""
    where: str
    """File and line, for messages."""
    id: str | None = None
    """As given in the file; None = to be numbered."""


def read_sightings(path: str | Path, video: str | None = None) -> list[Sighting]:
    """Read a list of sightings, in the order of the file.

    Args:
        path: simple CSV or Kvasir-Capsule's `metadata.csv`.
        video: which `video_id` of a Kvasir-Capsule file; needed when it lists several.

    Raises:
        LesionError: the file is missing, no UTF-8, has another delimiter, lacks a column, or holds an unusable row.
    """
    path = Path(path)
    text = _text(path)
    header = text.split("\n", 1)[0].strip()
    if tuple(name.strip().lower() for name in header.split(";")[:5]) == KVASIR_HEADER:
        found = list(_kvasir(path.name, text, video))
    else:
        found = list(_simple(path.name, text))
    if not found:
        raise LesionError(f"{path.name}: lists nothing that has a place; give at least one row with label and frame")
    _check_ids(found)
    return found


def _text(path: Path) -> str:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise LesionError(f"{path.name}: no such file; give a CSV with the columns label and frame") from None
    except OSError as error:
        raise LesionError(f"{path.name}: cannot be read ({error.strerror or error})") from None
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[:error.start].count(b"\n") + 1
        raise LesionError(f"{path.name} line {line}: not UTF-8; save the file as UTF-8 text") from None
    if "\0" in text:
        raise LesionError(f"{path.name}: holds zero bytes, so it is no text; save it as CSV in UTF-8")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _rows(name: str, text: str, delimiter: str) -> Iterator[tuple[str, list[str]]]:
    """(file and line, fields) of every row that is not empty, the header first."""
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    try:
        for fields in reader:
            if any(field.strip() for field in fields):
                yield f"{name} line {reader.line_num}", [field.strip() for field in fields]
    except csv.Error as error:
        raise LesionError(f"{name} line {reader.line_num}: not valid CSV ({error}); repair the quotes") from None


def _simple(name: str, text: str) -> Iterator[Sighting]:
    rows = _rows(name, text, ",")
    columns = _columns(name, next(rows, ("", []))[1])
    for where, fields in rows:
        if len(fields) > len(columns) and any(fields[len(columns):]):
            raise LesionError(f"{where}: {len(fields)} fields under {len(columns)} columns; quote labels that hold "
                              "commas")
        row = dict(zip(columns, fields + [""] * len(columns), strict=False))
        frame, timestamp = _moment(row, where)
        kind = row.get("kind", "").lower() or "finding"
        if kind != "finding" and kind != "landmark":
            raise LesionError(f"{where}: kind is {kind[:40]!r}; write finding or landmark")
        pixel = _pixel(row.get("u", ""), row.get("v", ""), where)
        named = _label(row["id"], where) if row.get("id") else None
        yield Sighting(_label(row["label"], where), "landmark" if kind == "landmark" else "finding", frame, timestamp,
                       pixel, where, named)


def _columns(name: str, header: list[str]) -> list[str]:
    columns = [column.lower() for column in header]
    if "label" not in columns:
        for delimiter, called in ((";", "semicolons"), ("\t", "tabs")):
            if len(header) == 1 and delimiter in header[0]:
                raise LesionError(f"{name}: its columns are separated by {called}; separate them by commas "
                                  "(Kvasir-Capsule's metadata.csv alone has semicolons)")
        raise LesionError(f"{name}: no column `label` in its header; columns are label, frame or timestamp_s, and "
                          "optionally u, v, kind, id")
    if "frame" not in columns and "timestamp_s" not in columns:
        raise LesionError(f"{name}: neither a column `frame` nor `timestamp_s` in its header; add one of them")
    if ("u" in columns) != ("v" in columns):
        raise LesionError(f"{name}: only one of the columns `u` and `v`; a pixel needs both")
    twice = next((column for column in columns if column and columns.count(column) > 1), None)
    if twice is not None:
        raise LesionError(f"{name}: column {twice[:40]!r} is there twice; name every column once")
    return columns


def _moment(row: dict[str, str], where: str) -> tuple[int | None, float | None]:
    frame, timestamp = row.get("frame", ""), row.get("timestamp_s", "")
    if bool(frame) == bool(timestamp):
        which = "both frame and timestamp_s" if frame else "neither frame nor timestamp_s"
        raise LesionError(f"{where}: gives {which}; give one of them")
    if frame:
        return _frame(frame, where), None
    return None, _number(timestamp, "timestamp_s", where)


def _kvasir(name: str, text: str, video: str | None) -> Iterator[Sighting]:
    rows = list(_rows(name, text, ";"))[1:]
    for where, fields in rows:
        if len(fields) not in (KVASIR_FIELDS - 1, KVASIR_FIELDS):
            raise LesionError(f"{where}: {len(fields)} fields; Kvasir-Capsule's rows have {KVASIR_FIELDS}, or "
                              f"{KVASIR_FIELDS - 1} without a box")
    videos = list(dict.fromkeys(fields[1] for _, fields in rows))
    if video is None and len(videos) > 1:
        raise LesionError(f"{name}: lists {len(videos)} videos ({', '.join(v[:40] for v in videos[:3])}, …); say which "
                          "one this recording is, with --video")
    if video is not None and video not in videos:
        raise LesionError(f"{name}: no video {video[:40]!r} in it; it lists {', '.join(v[:40] for v in videos[:5])}")
    for where, fields in rows:
        label = _label(fields[4], where)
        if (video is None or fields[1] == video) and label.lower() not in NO_PLACE:
            anatomy = fields[3].lower() == "anatomy" or label.lower() in KVASIR_LANDMARKS
            kind: Kind = "landmark" if anatomy else "finding"
            yield Sighting(label, kind, _frame(fields[2], where), None, _box_centre(fields[5:], where), where)


def _box_centre(corners: list[str], where: str) -> tuple[float, float] | None:
    filled = [field for field in corners if field]
    if not filled:
        return None
    if len(filled) != 8:
        raise LesionError(f"{where}: {len(filled)} numbers for a box; give x and y of its four corners, or none")
    values = [_number(field, "a corner of the box", where) for field in filled]
    return sum(values[0::2]) / 4, sum(values[1::2]) / 4


def _pixel(u: str, v: str, where: str) -> tuple[float, float] | None:
    if not u and not v:
        return None
    return _number(u, "u", where), _number(v, "v", where)


def _frame(text: str, where: str) -> int:
    try:
        frame = int(text)
    except ValueError:
        raise LesionError(f"{where}: frame is {text[:40]!r}; give a whole number, counted from 0") from None
    if frame < 0:
        raise LesionError(f"{where}: frame is {frame}; frames are counted from 0")
    return frame


def _number(text: str, what: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise LesionError(f"{where}: {what} is {text[:40]!r}; give a number") from None
    if not math.isfinite(value):
        raise LesionError(f"{where}: {what} is {text[:40]!r}; give a finite number")
    return value


def _label(text: str, where: str) -> str:
    """One line of text; what a terminal or a spreadsheet would take for a command is dropped or made a space."""
    label = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    if not label:
        raise LesionError(f"{where}: the label is empty; say what was seen")
    if len(label) > LONGEST_LABEL:
        raise LesionError(f"{where}: a label of {len(label)} characters (limit {LONGEST_LABEL}); shorten it")
    return label


def _check_ids(found: list[Sighting]) -> None:
    seen: dict[str, str] = {}
    for sighting in found:
        if sighting.id is not None:
            if sighting.id in seen:
                raise LesionError(f"{sighting.where}: id {sighting.id[:40]!r} is also in {seen[sighting.id]}; give "
                                  "every row an id of its own, or leave the column out")
            seen[sighting.id] = sighting.where
