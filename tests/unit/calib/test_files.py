"""Files: what has no end, is too large or nested without end is refused before it is read."""

import os
from pathlib import Path
from unittest.mock import Mock

import pytest

from ftcalib import CalibrationDataset, files
from ftcalib.errors import BadDataset
from ftcalib.files import object_of, read_file, write_new


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")], ids=["pipe", "endless device"])
def test_what_has_no_end_is_not_opened(make: object, tmp_path: Path) -> None:
    path = tmp_path / "dataset.json"
    assert callable(make)
    make(path)
    for read in (read_file, CalibrationDataset.load):
        with pytest.raises(OSError, match="is a pipe or a device: save its content in a file"):
            read(path)


def test_a_file_above_the_limit_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "dataset.json"
    path.write_text("{}")
    monkeypatch.setattr(files, "MOST_BYTES", 1)
    with pytest.raises(OSError, match=r"dataset\.json has 0 MB, and the limit is"):
        read_file(path)


def test_a_line_without_an_end_is_not_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"one\n123456\nthree" + bytes(16_000_000))
    with files.open_file(path) as file:
        lines = files.read_lines(file, BadDataset, 10)
        assert [next(lines), file.tell(), next(lines)] == [b"one\n", 4, b"123456\n"]
        with pytest.raises(BadDataset, match=r"^line 12 is longer than .* damaged"):
            next(lines)


@pytest.mark.parametrize("depth", [200, 1000, 50_000])
def test_nested_brackets_are_no_defect(depth: int) -> None:
    """At a depth that can be parsed, the checksum may still be too deep."""
    content = '{"checksum": "x", "a": ' + "[" * depth + "]" * depth + "}"
    with pytest.raises(BadDataset):
        object_of(content.encode(), BadDataset)


def test_of_two_writers_of_one_name_each_ends_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, links = tmp_path / "report.html", Path.hardlink_to

    def meanwhile(new: Path, written: Path) -> None:
        monkeypatch.undo()
        with monkeypatch.context() as other:
            other.setattr(os, "getpid", lambda: 1)
            write_new(path, "first")
        links(new, written)

    monkeypatch.setattr(Path, "hardlink_to", meanwhile)
    with pytest.raises(FileExistsError, match="is never overwritten: choose another name"):
        write_new(path, "second")
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_a_disk_without_links_takes_files_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "hardlink_to", Mock(side_effect=PermissionError))
    write_new(tmp_path / "a", "text")
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("a", "text")]
