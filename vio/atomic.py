"""Files and folders that are either whole or not there."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from vio.errors import OutputError


@contextmanager
def atomic_write(path: str | Path) -> Iterator[IO[bytes]]:
    """Open a temporary file beside `path` that replaces it only when the block succeeds.

    Raises:
        OutputError: the folder cannot be written or the disk is full.
    """
    path = Path(path)
    temporary: str | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            yield file
        Path(temporary).chmod(0o644)
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(_complaint(path, error)) from None
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path, marker: str) -> Iterator[Path]:
    """Fill a temporary folder that becomes `path` only when the block succeeds.

    An existing folder is replaced only when it holds `marker`, the file that shows it is our own output.

    Raises:
        OutputError: `path` exists and is not ours, cannot be written, or the disk is full.
    """
    path = Path(path)
    if path.exists() and not (path.is_dir() and (not any(path.iterdir()) or (path / marker).is_file())):
        raise OutputError(f"{path.name} exists and was not written by capsule-vio (no {marker}); choose another --out")
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        yield temporary
        temporary.chmod(0o755)
        _replace_folder(temporary, path)
    except OSError as error:
        raise OutputError(_complaint(path, error)) from None
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def _replace_folder(source: Path, target: Path) -> None:
    if not target.exists():
        source.rename(target)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{target.name}.old.", dir=target.parent))
    target.rename(old / "replaced")
    try:
        source.rename(target)
    except OSError:
        (old / "replaced").rename(target)
        old.rmdir()
        raise
    shutil.rmtree(old, ignore_errors=True)


def _complaint(path: Path, error: OSError) -> str:
    return f"cannot write {path.name}: {error.strerror or error}; choose a writable place with space"
