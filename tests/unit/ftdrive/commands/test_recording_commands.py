"""`record`, `convert` and `compensate`: when they end, with what exit code, and what is in the files then."""

import errno
import json
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ftdrive import cli
from ftdrive.cell.config import CellConfig
from ftdrive.recording import Recorder, load_recording
from ftdrive.recording import recorder as recorder_module
from ftdrive.recording.growing_file import GrowingFile
from ftdrive.stream.samples import Block, Stages, StreamEvent
from ftdrivers.errors import DeviceTimeout
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.recorded import block, calibration, info

END = KeyboardInterrupt()


class FakeStream:
    """Blocks and what follows them: an error, or nothing more."""

    cell: CellConfig

    def __init__(
        self, blocks: list[Block], end: BaseException = END, events: dict[int, StreamEvent] | None = None
    ) -> None:
        self.info, self.frame, self.warnings = info(), block(1).frame, ("the serial number is unknown",)
        self._blocks, self._end, self._events = blocks, end, events or {}
        self._read, self.clock, self.stages = 0, FakeClock(), Stages()

    def __enter__(self) -> "FakeStream":
        return self

    def __exit__(self, *_: object) -> None: ...

    def read(self) -> Block:
        if self._read == len(self._blocks):
            raise self._end
        self._read += 1
        return self._blocks[self._read - 1]

    def take_events(self) -> list[StreamEvent]:
        event = self._events.pop(self._read, None)
        return [] if event is None else [event]

    def status(self) -> Any:
        return SimpleNamespace(delay_s=0.0031, delay_sigma_s=0.0002)


Run = Callable[..., tuple[int, dict[str, Any] | None, str]]


@pytest.fixture
def run_record(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Record a stream with these options; return the exit code, the object on stdout, and stderr."""
    monkeypatch.chdir(tmp_path)
    calibration().save(tmp_path / "c.json")

    def run(stream: FakeStream, *options: str) -> tuple[int, dict[str, Any] | None, str]:
        def opened(cell: Any, *_: Any, **__: Any) -> FakeStream:
            stream.cell = cell
            return stream

        monkeypatch.setattr("ftdrive.library.open_stream", opened)
        given = ["--calibration", "c.json", "--robot", "10.0.0.2", "--sensor", "ati-can://can0", "--json", *options]
        code = cli.run(["record", *given])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out else None, err

    return run


def blocks(n: int, size: int = 100) -> list[Block]:
    return [block(size, start) for start in range(0, n * size, size)]


SILENT = DeviceTimeout("sensor silent for 0.3 s", "check its cable")
STALE = StreamEvent(5_300_000_000, "stale", "sensor: silent")
GAP = StreamEvent(5_100_000_000, "gap", "7 samples lost", {"lost": 7, "seq": 1})
LATE_GAP = StreamEvent(5_150_000_000, "gap", "7 samples lost", {"lost": 7, "seq": 1})


@pytest.mark.parametrize(
    ("end", "events", "options", "code", "counts", "words"),
    [
        (END, {}, (), 130, (300, 0, 0), "Saved a.mcap: 300 samples, 0.30 s, 1000 Hz, gaps: 0"),
        (SILENT, {3: STALE}, (), 4, (300, 0, 0), "error: sensor silent for 0.3 s; check its cable"),
        (END, {2: GAP}, ("--count", "300"), 8, (300, 1, 7), "error: gaps: 1, samples lost: 7"),
        (END, {2: LATE_GAP}, ("--count", "120"), 0, (120, 0, 0), "Saved a.mcap: 120 samples"),
    ],
    ids=["ctrl-c", "lost link", "gap", "gap after the end"],
)
def test_whatever_ends_a_recording_keeps_its_data(
    run_record: Run,
    end: BaseException,
    events: dict[int, StreamEvent],
    options: tuple[str, ...],
    code: int,
    counts: tuple[int, ...],
    words: str,
) -> None:
    found, answer, err = run_record(FakeStream(blocks(3), end, dict(events)), "-o", "a.mcap", *options)
    assert found == code
    assert answer is not None
    assert tuple(answer[name] for name in ("samples", "gaps", "lost")) == counts
    assert answer["rate_Hz"] == pytest.approx(1000.0, rel=1e-4)
    assert words in err
    recording = load_recording(Path("a.mcap"))
    assert (recording.cut, len(recording.rows)) == ("", counts[0])
    assert [event.kind for event in recording.events if event.kind == "stale"] == ["stale"] * (end is SILENT)


def test_a_full_disk_completes_no_file_and_names_what_is_safe(run_record: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    add, written = GrowingFile.add, Counter[Path]()

    def full(file: GrowingFile, content: bytes) -> int:
        written[file.path] += 1
        if file.path.suffix == ".csv" and written[file.path] > 5:
            raise OSError(errno.ENOSPC, "No space left on device")
        return add(file, content)

    monkeypatch.setattr(GrowingFile, "add", full)
    code, answer, err = run_record(FakeStream(blocks(30)), "-o", "a.mcap", "-o", "a.csv")
    assert code == 6
    assert answer is not None
    assert answer["files"] == []
    assert "Saved" not in err
    assert answer["partial"].keys() == {"a.mcap.partial", "a.csv.partial"}
    for path, samples in answer["partial"].items():
        assert f"{path} contains {samples} samples" in err
        assert len(load_recording(Path(path)).rows) == samples > 0
    assert not Path("a.mcap").exists()
    assert not Path("a.csv").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["-o", "a.bag"], "name it .mcap, .csv or .parquet"),
        (["-o", "a.csv", "-o", "a.csv"], "the same file"),
        (["-o", "a.csv", "--simulate"], "--robot cannot be combined with --simulate"),
        (["-o", "c.json"], "never overwritten"),
        (
            ["-o", "a.csv", "--stages", "smoothing=3"],
            "--stages has no setting 'smoothing': give NAME=VALUE with one of",
        ),
        (["-o", "a.csv", "--stages", "lowpass_Hz=fast"], "lowpass_Hz cannot be 'fast': set a frequency"),
    ],
)
def test_what_cannot_be_done_is_refused_before_any_work(run_record: Run, options: list[str], words: str) -> None:
    code, answer, err = run_record(FakeStream([], AssertionError("the stream was read")), *options)
    assert (code, answer) == (2, None)
    assert words in " ".join(err.split())


@pytest.fixture(scope="module")
def three_seconds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "a.mcap"
    recorder = Recorder([path], info(), {})
    recorder.add(block(3000), [])
    recorder.add(None, [StreamEvent(0, "delay", "…", {"value": 0.0031, "sigma": 0.0002})])
    recorder.end()
    return path


@pytest.fixture
def recorded(three_seconds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    calibration().save(tmp_path / "c.json")
    return Path(shutil.copy(three_seconds, tmp_path))


KEYS = {"force_rms_N", "force_max_N", "torque_rms_Nm", "torque_max_Nm"}


def test_compensate_answers_as_documented(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--calibration", "c.json", "--axes", "base", "--json", "-o", "b.parquet"]
    assert cli.run(["compensate", str(recorded), *options]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["schema_version"] == 1
    assert (answer["samples"], answer["gaps"]) == (3000, 0)
    assert answer["delay_s"] == {"value": 0.0031, "sigma": 0.0002}
    assert answer["raw"].keys() == answer["compensated"].keys() == KEYS
    assert answer["compensated"]["force_rms_N"] == pytest.approx(np.sqrt(3) * 0.05, rel=0.1)
    assert answer["raw"]["force_rms_N"] > 10
    assert (answer["axes"], answer["about"], answer["calibration"], answer["file"]) == (
        "base",
        "sensor",
        "c.json",
        "b.parquet",
    )
    assert str(load_recording(Path("b.parquet")).header.frame) == "base axes, about the sensor origin"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "ending"),
    [
        ("compensate", ".mcap"),
        ("convert", ".parquet"),
        pytest.param("compensate", ".csv", marks=pytest.mark.slow),
    ],
)
def test_damage_and_control_c_keep_what_was_before(
    command: str, ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    path, target = Path(f"a{ending}"), Path(f"b{ending}")
    recorder = Recorder([path], info(), {})
    for start in (0, 8200, 16_400):
        recorder.add(block(8200 if start < 16_400 else 1000, start, step_ns=2_000_000), [])
    recorder.end()
    call = [command, str(path), *(["-o"] if command == "compensate" else []), str(target), "--json"]
    append = recorder_module.RecordingFiles.append
    written, pressed = [0], [False]

    def interrupted(*given: Any) -> None:
        append(*given)
        written[0] += len(given[1])
        if written[0] > 8_000 and not pressed[0]:
            pressed[0] = True
            raise KeyboardInterrupt

    monkeypatch.setattr(recorder_module.RecordingFiles, "append", interrupted)
    assert cli.run(call) == 130
    kept = json.loads(capsys.readouterr().out)["samples"]
    assert len(load_recording(target).rows) == written[0] == kept
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    target.unlink()
    content = bytearray(path.read_bytes())
    content[len(content) * (97 if ending == ".parquet" else 50) // 100] ^= 1  # in its second row group
    path.write_bytes(content)
    assert cli.run(call) == 6
    out, err = capsys.readouterr()
    kept = json.loads(out)["samples"]
    assert f"Saved {target}: the first {kept} samples" in err
    assert "is incomplete" in err
    found = load_recording(target)
    assert (len(found.rows), found.cut) == (kept, "")
    assert 8192 <= kept <= 16_400
    np.testing.assert_array_equal(found.rows["seq"], (1 << 33) + np.arange(kept))


KILLED = """
import os, signal, sys
from ftdrive.cli import main
from ftdrive.recording.growing_file import GrowingFile

add = GrowingFile.add

def killed_amid(file, *contents):
    if file.samples == 16384:
        content = b"".join(contents)
        add(file, content[: len(content) // 2])
        os.kill(os.getpid(), signal.SIGKILL)
    return add(file, *contents)

GrowingFile.add = killed_amid
sys.exit(main())
"""


@pytest.mark.slow
def test_kill_9_amid_a_write_leaves_all_blocks_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    path, target = Path("a.parquet"), "b.mcap"
    recorder = Recorder([path], info(), {})
    for start in range(0, 24_600, 8200):
        recorder.add(block(8200, start, step_ns=2_000_000), [])
    recorder.end()
    command = ["compensate", str(path), "-o", target]
    killed = [sys.executable, "-c", KILLED, "-q", *command]  # without the line of a command that takes over 2 s
    outcome = subprocess.run(killed, capture_output=True, text=True, check=False)
    assert (outcome.returncode, outcome.stdout, outcome.stderr) == (-signal.SIGKILL, "", "")
    assert not Path(target).exists()
    assert cli.run(command) == 6
    assert f"`ftdrive convert {target}.partial NEW.mcap`" in " ".join(capsys.readouterr().err.split())
    assert cli.run(["convert", f"{target}.partial", "kept.mcap", "--json"]) == 0
    out, err = capsys.readouterr()
    assert err.count(f"{target}.partial is incomplete") == 1
    assert re.search(r"\): \d+\.\d s are saved\.", " ".join(err.split()))
    Path(f"{target}.partial").unlink()
    assert cli.run(command) == 0
    kept, whole = load_recording("kept.mcap").rows, load_recording(target).rows
    assert json.loads(out)["samples"] == len(kept) == 16384
    assert kept.tobytes() == whole[: len(kept)].tobytes()


def test_parquet_without_its_end_is_made_again(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["convert", str(recorded), "b.parquet"]) == 0
    partial = Path("b.parquet").rename("b.parquet.partial")
    partial.write_bytes(partial.read_bytes()[:-1000])
    for command, code, words in (
        (["convert", str(partial), "c.csv"], 6, "its end is missing, without which Parquet cannot be read"),
        (["convert", str(recorded), "b.parquet"], 6, "b.parquet.partial exists, but its end is missing: delete it"),
    ):
        assert cli.run(command) == code
        assert words in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in Path().iterdir() if path.name.startswith(("b.", "c.csv"))] == [partial.name]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "RECORDING"),
        (["a.mcap", "--wrench", "c.json"], "RECORDING cannot be combined with --wrench"),
        (["a.mcap", "--delay", "auto"], "are for recordings of other programs"),
        (["a.mcap", "--wrench-topic", "/w"], "are only for a ROS bag"),
        (
            ["--wrench", "c.json", "--orientation-file", "c.json", "--calibration", "c.json", "--delay", "x"],
            "--delay is",
        ),
    ],
)
@pytest.mark.usefixtures("recorded")
def test_compensate_refuses_what_it_would_ignore(
    options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["compensate", *options]) == 2
    assert words in capsys.readouterr().err


def test_compensate_refuses_the_calibration_of_another_sensor(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    devices = {"sensor": {"model": "Mini45", "serial": "FT9"}}
    replace(calibration(), provenance={"devices": devices}).save(Path("other.json"))
    assert cli.run(["compensate", str(recorded), "--calibration", "other.json"]) == 2
    assert "FT9" in capsys.readouterr().err


@pytest.mark.slow
def test_live_replays_a_recording_with_its_calibration_or_another(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--speed", "1e9", "--once", "--json", "--axes", "base"]
    assert cli.run(["live", "--replay", str(recorded), *options]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert np.linalg.norm(answer["compensated"]["force_N"]) < 0.1
    assert cli.run(["live", "--replay", str(recorded), "--calibration", "c.json", *options]) == 0
    assert json.loads(capsys.readouterr().out)["compensated"] == answer["compensated"]
    Path("d.csv").write_text("t\n")
    assert cli.run(["live", "--replay", "d.csv", "--once"]) == 6
