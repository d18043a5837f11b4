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
from ftmocks.sensors.bota import BotaBox

pytestmark = pytest.mark.slow  # every test needs a process of its own

WRENCH = np.array([3.0, -2.0, 12.0, 0.3, -0.2, 0.1])


@pytest.fixture
def url(cell_time: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setenv(CLOCK, cell_time.of_devices.path)  # the command knows nothing of an emulator of a test
    rng = np.random.default_rng(5)
    device = BotaBox(lambda n: WRENCH + 1e-3 * rng.normal(size=(n, 6)), seed=1, clock=cell_time.of_devices, boot_s=0.05)
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


def test_a_recording_that_was_broken_off_is_played_as_far_as_it_goes(recorded: list[str], tmp_path: Path) -> None:
    outcome = play(recorded[: len(recorded) * 3 // 4], tmp_path)
    played = answer_of(outcome)["played"]
    assert 0.2 < played["duration_s"] < 0.8
    assert played["samples"] > 10
    assert played["mean_force_N"] == pytest.approx(WRENCH[:3], abs=0.02)
    assert f"was interrupted: {played['duration_s']:.3g} s of 1 s were played" in outcome.stderr


def test_a_whole_recording_is_not_called_broken_off(recorded: list[str], tmp_path: Path) -> None:
    outcome = play(recorded, tmp_path)
    assert answer_of(outcome)["played"]["duration_s"] == 1
    assert outcome.stderr == ""
