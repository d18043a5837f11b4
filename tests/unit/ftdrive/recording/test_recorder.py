"""The recorder: what is in the files when something goes wrong, and what it does not do."""

import errno
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from ftdrive.errors import BadRecording, ConfigError
from ftdrive.recording import Recorder, load_recording, write_recording
from ftdrive.recording.files import grown_as, require_new_recordings
from ftdrive.recording.growing_file import GrowingFile
from ftdrive.recording.recording import Header
from ftdrive.recording.table_files import CsvFile, ParquetFile
from ftdrive.stream.samples import StreamEvent
from tests.unit.ftdrive.recorded import BASE_TCP, USUAL, block, info

ENDINGS = (".mcap", ".csv", ".parquet")


def partial_of(path: Path) -> Path:
    grown = grown_as(path)
    return grown.with_name(f"{grown.name}.partial")


class FullDisk:
    """A file on a disk with little room; the last write is a partial one."""

    def __init__(self, file: Any, room: int) -> None:
        self._file, self._room = file, room

    def write(self, data: bytes) -> int:
        left = self._room - self._file.tell()
        if left <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return int(self._file.write(data[:left]))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


@pytest.fixture
def fill_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    init = GrowingFile.__init__

    def fill(room: int) -> None:
        def full(file: GrowingFile, path: Path) -> None:
            init(file, path)
            file._file = FullDisk(file._file, room)  # type: ignore[assignment]

        monkeypatch.setattr(GrowingFile, "__init__", full)

    return fill


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_full_disk_leaves_partial_files_that_say_what_is_safe(
    ending: str, tmp_path: Path, fill_disk: Callable[[int], None]
) -> None:
    first, other = tmp_path / f"a{ending}", tmp_path / "b.csv"
    fill_disk(400_000)
    recorder = Recorder([first, other], info(), {})
    with pytest.raises(OSError, match="No space left") as failure:  # noqa: PT012  # some write fails
        for start in range(0, 5000, 100):
            recorder.add(block(100, start), [])
    recorder.end()
    assert not first.exists()
    assert not other.exists()
    assert recorder.saved == []
    for path, samples in recorder.partial.items():
        assert f"{path} contains {samples} samples" in str(failure.value)
        found = load_recording(path)
        assert found.cut
        assert 0 < len(found.rows) == samples < 5000
        np.testing.assert_array_equal(found.rows["seq"], found.rows["seq"][0] + np.arange(len(found.rows)))
    assert list(recorder.partial) == [partial_of(first), tmp_path / "b.csv.partial"]


@pytest.mark.parametrize("ending", ENDINGS)
def test_control_c_amid_a_write_waits_for_its_end(ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without, the files of one recording would hold different samples, or half a line."""
    paths = [tmp_path / f"a{ending}", tmp_path / "b.csv"]
    recorder = Recorder(paths, info(), {})
    recorder.add(block(100), [])
    append = CsvFile.append

    def interrupted(*given: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        append(*given)

    monkeypatch.setattr(CsvFile, "append", interrupted)
    with pytest.raises(KeyboardInterrupt):
        recorder.add(block(200, 100), [])
    monkeypatch.undo()
    recorder.end()
    assert [len(load_recording(path).rows) for path in recorder.saved] == [300, 300]
    assert recorder.saved == paths


@pytest.mark.parametrize("ending", ENDINGS)
def test_after_a_power_failure_the_partial_file_is_readable(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{ending}"
    recorder = Recorder([path], info(), {})
    mark = StreamEvent(5_000_000_000, "mark", "begin")
    for start in range(26):
        recorder.add(block(1, start, step_ns=1_000_000_000), [])
        recorder.add(None, [mark if start == 1 else StreamEvent(0, "frame", "the recorder notices it itself")])
    found = load_recording(partial_of(path))
    np.testing.assert_array_equal(found.rows["seq"], block(len(found.rows)).seq)
    assert len(found.rows) > 15
    assert list(found.events) == [mark]
    assert found.cut
    recorder.end()
    assert len(load_recording(path).rows) == 26


@pytest.mark.parametrize("ending", ENDINGS)
def test_nothing_is_overwritten(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{ending}"
    recorder = Recorder([path], info(), {})
    recorder.add(block(3), [])
    path.write_text("another program's")
    with pytest.raises(FileExistsError, match="never overwritten"):
        recorder.end()
    assert path.read_text() == "another program's"
    kept, samples = next(iter(recorder.partial.items()))
    assert len(load_recording(kept).rows) == samples == 3
    with pytest.raises(FileExistsError, match="never overwritten"):
        Recorder([path], info(), {})


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_what_cannot_be_converted_to_parquet_stays_in_mcap(
    failure: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fill_disk: Callable[[int], None]
) -> None:
    path, kept = tmp_path / "a.parquet", tmp_path / "a.parquet.mcap"
    recorder = Recorder([path, tmp_path / "b.csv"], info(), {})
    recorder.add(block(1100), [])
    if isinstance(failure, OSError):
        fill_disk(100_000)
    else:
        monkeypatch.setattr(ParquetFile, "append", Mock(side_effect=failure))
    with pytest.raises(OSError, match=rf"a\.parquet was not written .*`ftdrive convert {kept} {path}`"):
        recorder.end()
    assert (recorder.saved, recorder.partial) == ([tmp_path / "b.csv"], {kept: 1100})
    assert sorted(tmp_path.iterdir()) == [kept, tmp_path / "b.csv"]
    monkeypatch.undo()
    with pytest.raises(FileExistsError, match="never overwritten"):
        require_new_recordings([path])
    write_recording(path, load_recording(kept))
    assert len(load_recording(path).rows) == 1100


def test_without_a_sample_there_is_no_file(tmp_path: Path) -> None:
    recorder = Recorder([tmp_path / f"a{ending}" for ending in ENDINGS], info(), {})
    recorder.add(None, [StreamEvent(0, "mark", "x")])
    recorder.end()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("missing", "ending"), [("mcap", ".mcap"), ("pyarrow", ".parquet")])
def test_a_missing_package_is_named_with_its_extra(
    missing: str, ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, missing, None)
    with pytest.raises(ConfigError, match=r"of the extra record"):
        Recorder([tmp_path / f"a{ending}"], info(), {})
    (tmp_path / f"b{ending}").touch()
    with pytest.raises(ConfigError, match=r"of the extra record"):
        load_recording(tmp_path / f"b{ending}")
    assert not (tmp_path / f"a{ending}.partial").exists()


def test_a_newer_version_is_refused() -> None:
    document = Header(info(), BASE_TCP, USUAL).to_dict() | {"format": "ftdrive.recording/2"}
    with pytest.raises(BadRecording, match="use a newer program"):
        Header.from_dict(document)


def test_a_file_that_still_grows_is_not_to_be_deleted(tmp_path: Path) -> None:
    path = tmp_path / "peg.csv"
    recorder = Recorder([path], info(), {})
    recorder.add(block(500), [])
    with pytest.raises(FileExistsError, match=f"process {os.getpid()} is still recording to .*: choose another name"):
        require_new_recordings([path])
    recorder.end()
    path.rename(tmp_path / "peg.csv.partial")  # as a process leaves it that ends at once
    with pytest.raises(FileExistsError, match="an earlier recording was interrupted"):
        require_new_recordings([path])
