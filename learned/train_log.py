"""What happened at which step: a CSV file, and TensorBoard where its package is installed."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from vio.atomic import atomic_write


class TrainLog:
    """Rows of numbers by step. A resumed run drops the rows that lie after its checkpoint and writes on.

    Args:
        path: the CSV file; its columns are those of the first row.
        resume_step: the last step that stays; None starts the file anew.
        tensorboard: also write TensorBoard's format beside it, when the package is installed.
    """

    def __init__(self, path: Path, resume_step: int | None = None, tensorboard: bool = True) -> None:
        self.path = path
        self._columns: list[str] = []
        self._keep_until(resume_step)
        self._board: Any = None
        if tensorboard and find_spec("tensorboard") is not None:
            from torch.utils.tensorboard import SummaryWriter

            self._board = SummaryWriter(str(path.parent / "tensorboard"), purge_step=resume_step)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Append one row, at once on disk."""
        row = {"step": step, **values}
        with self.path.open("a", encoding="utf-8", newline="") as file:
            if not self._columns:
                self._columns = list(row)
                csv.writer(file).writerow(self._columns)
            csv.writer(file).writerow([_text(row.get(name, "")) for name in self._columns])
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(f"{self.path.stem}/{name}", value, step)

    def _keep_until(self, step: int | None) -> None:
        rows: list[list[str]] = []
        if step is not None and self.path.is_file():
            with self.path.open(encoding="utf-8", newline="") as file:
                rows = list(csv.reader(file))
        if rows:
            self._columns = rows[0]
            rows = [rows[0], *(row for row in rows[1:] if row and row[0].isdigit() and int(row[0]) <= (step or 0))]
        with atomic_write(self.path) as out:
            out.write("".join(",".join(row) + "\r\n" for row in rows).encode())


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
