"""Files: what has no end, is too large or nested without end is refused before it is read."""

import os
from pathlib import Path

import pytest

from ftcalib import CalibrationDataset, files
from ftcalib.data.dataset import read_csv
from ftcalib.errors import BadDataset
from ftcalib.files import object_of, read_file


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")], ids=["pipe", "endless device"])
def test_what_has_no_end_is_not_opened(make: object, tmp_path: Path) -> None:
    path = tmp_path / "dataset.json"
    assert callable(make)
    make(path)
    for read in (read_file, CalibrationDataset.load, read_csv):
        with pytest.raises(OSError, match="is a pipe or a device: save its content in a file"):
            read(path)


def test_a_file_above_the_limit_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "dataset.json"
    path.write_text("{}")
    monkeypatch.setattr(files, "MOST_BYTES", 1)
    with pytest.raises(OSError, match=r"dataset\.json has 0 MB, more than"):
        read_file(path)


@pytest.mark.parametrize("depth", [*range(200, 1200, 40), 50_000])
def test_nested_brackets_are_no_defect(depth: int) -> None:
    """At a depth that can be parsed, the checksum may still be too deep."""
    content = '{"checksum": "x", "a": ' + "[" * depth + "]" * depth + "}"
    with pytest.raises(BadDataset):
        object_of(content.encode(), BadDataset)
