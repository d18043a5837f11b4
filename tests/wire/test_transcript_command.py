"""`ftdrive transcript` at its edges: long recordings, broken-off ones, a driver with a wire of its own."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from ftdrive.cell.config import CLOCK
from ftdrive.commands import transcript
from ftdrive.errors import ConfigError
from ftdrivers.errors import BadTranscript
from ftmocks.sensors.bota import BotaBox

pytestmark = pytest.mark.slow  # every test needs a process of its own

WRENCH = np.array([3.0, -2.0, 12.0, 0.3, -0.2, 0.1])


@pytest.fixture
def url(cell_time: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setenv(CLOCK, cell_time.of_devices.path)  # the command knows nothing of an emulator of a test
    rng = np.random.default_rng(5)
    device = BotaBox(lambda n: WRENCH + 1e-3 * rng.normal(size=(n, 6)), seed=1, clock=cell_time.of_devices)
    yield f"bota://{device.start()}"
    device.stop()


def run(*arguments: str) -> Result:
    return CliRunner().invoke(transcript.transcript, arguments)


def answer_of(outcome: Result) -> dict[str, Any]:
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    answer: dict[str, Any] = json.loads(outcome.stdout)
    return answer


@pytest.mark.parametrize(("name", "words"), [("there", "never overwritten"), ("no/there", "create it first")])
def test_a_file_that_cannot_be_made_is_refused_before_the_sensor_is_opened(
    name: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "there").touch()
    monkeypatch.setattr(transcript, "_record_bytes", lambda *_, **__: pytest.fail("it was recorded"))
    error = run("record", "--sensor", "bota-serial:///dev/none", "-o", str(tmp_path / name)).exception
    assert isinstance(error, ConfigError)
    assert words in str(error)


@pytest.fixture
def recorded(url: str, tmp_path: Path) -> list[str]:
    path = tmp_path / "whole.jsonl"
    assert (
        answer_of(run("record", "--sensor", url, "-o", str(path), "--duration", "1", "--json"))["recorded"]["samples"]
        > 50
    )
    return on_time(path.read_text().splitlines())


def on_time(lines: list[str]) -> list[str]:
    """Shorten the pauses of a computer that has stalled while it recorded: no driver waits for what is behind them."""
    entries: list[dict[str, Any]] = [json.loads(line) for line in lines]
    steps = np.diff([entry["t_ns"] for entry in entries], prepend=entries[0]["t_ns"])
    times = entries[0]["t_ns"] + np.minimum(steps, 2_000_000_000).cumsum()
    return [json.dumps(entry | {"t_ns": int(t_ns)}) + "\n" for entry, t_ns in zip(entries, times, strict=True)]


def play(lines: list[str], tmp_path: Path) -> Result:
    path = tmp_path / "played.jsonl"
    path.write_text("".join(lines))
    return run("play", str(path), "--json")


def without_its_end(lines: list[str]) -> list[str]:
    return lines[: len(lines) * 3 // 4]


def interrupted(lines: list[str]) -> list[str]:
    return [*without_its_end(lines), json.dumps({"t_ns": 0, "event": "end", "error": "interrupted"}) + "\n"]


@pytest.mark.parametrize("cut", [without_its_end, interrupted])
def test_a_recording_that_was_broken_off_is_played_as_far_as_it_goes(
    cut: Any, recorded: list[str], tmp_path: Path
) -> None:
    outcome = play(cut(recorded), tmp_path)
    played = answer_of(outcome)["played"]
    assert 0.2 < played["duration_s"] < 0.8
    assert played["samples"] > 10
    assert played["mean_force_N"] == pytest.approx(WRENCH[:3], abs=0.02)
    assert f"was interrupted: {played['duration_s']:.3g} s of 1 s were played" in outcome.stderr


def test_a_whole_recording_is_not_called_broken_off(recorded: list[str], tmp_path: Path) -> None:
    outcome = play(recorded, tmp_path)
    assert answer_of(outcome)["played"]["duration_s"] == 1
    assert outcome.stderr == ""


@pytest.mark.slow
def test_what_was_broken_off_too_early_says_so(recorded: list[str], tmp_path: Path) -> None:
    outcome = play(recorded[:8], tmp_path)
    assert isinstance(outcome.exception, BadTranscript)
    assert "before the first sample" in str(outcome.exception)


OWN_WIRE = """
import time
import numpy as np
from ftdrivers.interfaces import DeviceInfo, FtSamples
from ftdrivers.streaming import StreamingSensor

class Sensor(StreamingSensor):
    @classmethod
    def from_url(cls, address, options, *, sign=1):
        return cls(f"Own sensor on {address}", sign=sign)

    def _connect(self):
        self.seq = 0
        return DeviceInfo("Own", "1", "1.0")

    def _read_block(self):
        time.sleep(0.005)
        self.seq += 1
        return FtSamples(np.array([time.monotonic_ns()]), np.array([np.nan]), np.array([self.seq]),
                         np.zeros((1, 0), np.int32), self.seq * np.ones((1, 6)), np.zeros(1, np.uint32))

    def _disconnect(self):
        pass
"""


def test_a_driver_with_a_wire_of_its_own_is_not_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    metadata = tmp_path / "site" / "own_wire_ft-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: own_wire_ft\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[ftdrive.sensors]\nown-wire = own_wire_ft:Sensor\n")
    (tmp_path / "site" / "own_wire_ft.py").write_text(OWN_WIRE)
    monkeypatch.syspath_prepend(tmp_path / "site")
    outcome = run("record", "--sensor", "own-wire:///dev/own0", "-o", str(tmp_path / "a.jsonl"), "--duration", "0.1")
    assert isinstance(outcome.exception, ConfigError)
    assert "neither pyserial nor python-can" in str(outcome.exception)
    assert [path.name for path in tmp_path.iterdir()] == ["site"]
    assert "Saved" not in outcome.stderr
