"""Many recordings compensated, in this process."""

import json
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ftdrive import __version__
from ftdrive.errors import ConfigError
from ftdrive.fleet.compensate import (
    compensate_all,
    compensated_bytes,
    compensated_file,
    recordings_of,
    require_own_results,
    task_of,
)
from ftdrive.fleet.workers import Answer, OtherVersion, Workers
from ftdrive.live.samples import WrenchFrame
from ftdrive.recording import Recorder, read_recording, write_recording
from ftdrive.recording.compensation import compensate_recording
from tests.unit.ftdrive.recorded import block, calibration, info

FRAME = WrenchFrame("base")


def record(path: Path, samples: int = 400) -> Path:
    path.parent.mkdir(exist_ok=True)
    recorder = Recorder([path], info(), {})
    recorder.write(block(samples))
    recorder.close()
    return path


def at_once(function: Callable[..., list[Answer]], *arguments: Any) -> "Future[list[Answer]]":
    future = Future[list[Answer]]()
    future.set_result(function(*arguments))
    return future


@pytest.mark.parametrize("ending", [".mcap", ".csv", ".parquet"])
def test_the_bytes_are_those_of_the_same_work_without_workers_and_come_again(ending: str, tmp_path: Path) -> None:
    source = record(tmp_path / f"a{ending}")
    numbers, _ = compensate_recording(read_recording(source), FRAME, tmp_path / f"b{ending}")
    task = task_of(None, FRAME, "keep")
    content, _, line = compensated_bytes(source.read_bytes(), source.name, task).rpartition(b"\n")
    assert content == (tmp_path / f"b{ending}").read_bytes()
    assert json.loads(line) == numbers
    path, _, here = compensated_file(source, tmp_path, task).rpartition(b"\n")
    assert (Path(path.decode()).read_bytes(), here) == (content, line)
    again = compensated_bytes(source.read_bytes(), "renamed" + ending, task)
    assert again == content + b"\n" + line
    assert tempfile.gettempdir().encode() not in again


def test_calibration_and_bias_are_those_of_the_options(tmp_path: Path) -> None:
    source = record(tmp_path / "a.mcap", 2500)
    run = tmp_path / "run"
    run.mkdir()
    calibration().save(run / "calibration.json")
    task = task_of(run, FRAME, "estimate")
    found = json.loads(compensated_bytes(source.read_bytes(), source.name, task).rpartition(b"\n")[2])
    assert found["calibration"] == f"{run}, bias estimated"
    assert (found["axes"], found["about"]) == ("base", "sensor")
    assert max(map(abs, found["bias_change"]["value"])) < 0.05
    assert 0 < max(found["bias_change"]["sigma"]) < 0.05


@pytest.mark.parametrize("share_files", [True, False])
def test_each_recording_is_one_call_and_a_failure_concerns_one(share_files: bool, tmp_path: Path) -> None:
    fine, few = (record(tmp_path / "in" / name) for name in ("fine.csv", "few.csv"))
    empty = tmp_path / "in" / "empty.mcap"
    read = read_recording(fine)
    write_recording(empty, replace(read, rows=read.rows[:0]))
    damaged = tmp_path / "in" / "damaged.parquet"
    damaged.write_bytes(b"PAR1")
    lost = tmp_path / "in" / "lost.csv"
    cut = tmp_path / "in" / "cut.csv"
    cut.write_text(fine.read_text().removesuffix("# end\n"))
    output = tmp_path / "out"
    output.mkdir()
    (output / "few.csv").write_text("of another command")
    calls = list[int]()

    def submit(each: Any, function: Any, group: Sequence[Any]) -> "Future[list[Answer]]":
        calls.append(len(group))
        return at_once(each, function, group)

    recordings = [fine, few, empty, damaged, lost, cut]
    task = task_of(None, FRAME, "keep")
    found = dict(compensate_all(recordings, output, task, Workers(1, submit, BrokenExecutor, 8, share_files)))
    assert set(calls) <= {0, 1}
    assert sum(calls) == 6 - (not share_files)
    assert isinstance(good := found[fine], dict)
    assert (good["samples"], good["cut"]) == (400, "")
    assert isinstance(short := found[cut], dict)
    assert "'# end'" in short["cut"]
    assert "exists already and is never overwritten" in str(found[few])
    assert str(found[empty]).startswith("it contains no sample")
    assert "it was cut within it" in str(found[damaged])
    assert "No such file" in str(found[lost])
    assert not any("ftdrive-compensate-" in str(one) for one in found.values())
    assert sorted(one.name for one in output.iterdir()) == ["cut.csv", "few.csv", "fine.csv"]
    assert read_recording(output / "fine.csv").header.frame == FRAME


def test_a_recording_of_other_devices_and_a_short_one_are_refused(tmp_path: Path) -> None:
    source = record(tmp_path / "a.csv")
    other = replace(calibration(), provenance={"devices": {"sensor": {"model": "Mini45", "serial": "FT9"}}})
    other.save(tmp_path / "other.json")
    with pytest.raises(ConfigError, match=r"^a\.csv is of other devices than the calibration: .*FT9"):
        compensated_bytes(source.read_bytes(), source.name, task_of(tmp_path / "other.json", FRAME, "keep"))
    (tmp_path / "out").mkdir()
    task = task_of(None, FRAME, "estimate")
    found = dict(compensate_all([source], tmp_path / "out", task, Workers(1, at_once, BrokenExecutor)))
    assert str(found[source]).startswith("0.4 s are too short for a bias")
    assert not list((tmp_path / "out").iterdir())


def test_a_full_temporary_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    with pytest.raises(OSError, match=r"missing on the worker: .* or set TMPDIR"):
        compensated_bytes(b"", "a.csv", task_of(None, FRAME, "keep"))


def test_a_worker_of_another_version_ends_it(tmp_path: Path) -> None:
    task = task_of(None, FRAME, "keep").replace(__version__.encode(), b"0.0.1")
    source = record(tmp_path / "a.csv")
    with pytest.raises(OtherVersion, match=r"ftdrive 0\.0\.1: install the same"):
        list(compensate_all([source], tmp_path, task, Workers(1, at_once, BrokenExecutor)))


def test_which_files_are_recordings(tmp_path: Path) -> None:
    for name in ("a.csv", "b.mcap", "c.parquet", "d.txt", "e.csv.partial", "f/g.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "folder.csv").mkdir()
    found = recordings_of([tmp_path, tmp_path / "f" / ".." / "a.csv", tmp_path / "f"])
    assert found == [tmp_path / name for name in ("a.csv", "b.mcap", "c.parquet", "f/g.csv")]
    for name, words in (
        ("d.txt", "has no ending of a recording"),
        ("e.csv.partial", "is incomplete: save it with `ftdrive convert`"),
        ("folder.csv", "contains no .mcap, .csv or .parquet file"),
    ):
        with pytest.raises(ConfigError, match=words):
            recordings_of([tmp_path / name])


def test_results_need_a_path_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "in")
    one, other = tmp_path / "in" / "a.csv", tmp_path / "b" / "a.csv"
    require_own_results([one], tmp_path / "new")
    with pytest.raises(ConfigError, match=r"b/a\.csv have the same name: compensate them into two folders"):
        require_own_results([one, other], tmp_path / "new")
    with pytest.raises(ConfigError, match="would have the path of the recording: choose another folder"):
        require_own_results([one], tmp_path / "link")
