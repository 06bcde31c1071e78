"""Whole or not there: files and folders under success, failure, a full disk, and folders that are not ours."""

import errno
import stat
from pathlib import Path

import pytest

from vio.atomic import atomic_folder, atomic_write
from vio.errors import OutputError


def full_disk() -> OSError:
    return OSError(errno.ENOSPC, "No space left on device")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_appears_whole_with_its_folders(tmp_path: Path):
    target = tmp_path / "a" / "b" / "out.bin"
    with atomic_write(target) as file:
        file.write(b"one")
        assert not target.exists()
    assert target.read_bytes() == b"one" and names(target.parent) == ["out.bin"]
    assert stat.S_IMODE(target.stat().st_mode) == 0o644
    with atomic_write(target) as file:
        file.write(b"two")
        assert target.read_bytes() == b"one"
    assert target.read_bytes() == b"two"


@pytest.mark.parametrize(("error", "raised"), [(full_disk(), OutputError), (KeyError("k"), KeyError),
                                              (KeyboardInterrupt(), KeyboardInterrupt)])
def test_a_failed_file_leaves_the_old_one_and_nothing_else(tmp_path: Path, error, raised):
    target = tmp_path / "out.bin"
    target.write_bytes(b"old")
    with pytest.raises(raised), atomic_write(target) as file:
        file.write(b"half")
        raise error
    assert target.read_bytes() == b"old" and names(tmp_path) == ["out.bin"]


def test_unwritable_places_are_named_without_their_path(tmp_path: Path):
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    for target in (tmp_path / "file" / "out.bin", tmp_path / "folder"):
        with pytest.raises(OutputError, match=f"^cannot write {target.name}: ") as caught, atomic_write(target) as file:
            file.write(b"x")
        assert str(tmp_path) not in str(caught.value) and "\n" not in str(caught.value)
    assert names(tmp_path) == ["file", "folder"]


def fill(path: Path, text: str, error: BaseException | None = None) -> None:
    with atomic_folder(path, "marker.json") as folder:
        (folder / "marker.json").write_text("{}")
        (folder / "sub").mkdir()
        (folder / "sub" / "data").write_text(text)
        if error is not None:
            raise error


def test_a_folder_appears_whole_and_replaces_its_own_kind(tmp_path: Path):
    target = tmp_path / "deep" / "run"
    fill(target, "one")
    fill(target, "two")
    assert (target / "sub" / "data").read_text() == "two" and names(target.parent) == ["run"]
    assert stat.S_IMODE(target.stat().st_mode) == 0o755
    (tmp_path / "empty").mkdir()
    fill(tmp_path / "empty", "three")
    assert (tmp_path / "empty" / "sub" / "data").read_text() == "three"


@pytest.mark.parametrize(("error", "raised"), [(full_disk(), OutputError), (ValueError("v"), ValueError)])
@pytest.mark.parametrize("exists", [True, False])
def test_a_failed_folder_leaves_what_was_there(tmp_path: Path, error, raised, exists):
    target = tmp_path / "run"
    if exists:
        fill(target, "old")
    with pytest.raises(raised):
        fill(target, "half", error)
    assert names(tmp_path) == (["run"] if exists else [])
    assert not exists or (target / "sub" / "data").read_text() == "old"


def test_folders_and_files_that_are_not_ours_stay(tmp_path: Path):
    foreign, file = tmp_path / "photos", tmp_path / "thesis.txt"
    foreign.mkdir()
    (foreign / "holiday.jpg").write_bytes(b"x")
    file.write_text("chapter 1")
    for target in (foreign, file):
        with pytest.raises(OutputError, match=f"{target.name} exists and was not written by .*choose another --out"):
            fill(target, "x")
    assert names(foreign) == ["holiday.jpg"] and file.read_text() == "chapter 1" and len(names(tmp_path)) == 2


def test_when_the_last_rename_fails_the_old_folder_comes_back(tmp_path: Path, monkeypatch):
    target = tmp_path / "run"
    fill(target, "old")
    rename = Path.rename

    def refuse(self: Path, to: Path) -> Path:
        if Path(to) == target and self.name != "replaced":
            raise full_disk()
        return rename(self, to)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(OutputError, match="No space left"):
        fill(target, "new")
    assert names(tmp_path) == ["run"] and (target / "sub" / "data").read_text() == "old"
