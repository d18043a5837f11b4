"""What `stream` prints."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig
from ftdrive.commands import stream
from ftdrive.commands.options import CellOptions
from ftdrive.commands.options import SourceOptions as Chosen
from ftdrive.stream.samples import WrenchFrame
from tests.unit.ftdrive.stream.simulated import calibrated
from tests.unit.ftdrive.stream.test_pump import Source


def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *arguments: str) -> tuple[dict[str, Any], str]:
    opened: dict[str, Any] = {}

    def open_(_: object, **options: Any) -> Any:
        opened.update(options)
        source: Any = Source("a")
        source.warnings = ["the arm reports no serial number"]
        return nullcontext(source)

    monkeypatch.setattr("ftdrive.library.Stream", open_)
    monkeypatch.setattr(Chosen, "calibration", lambda _: calibrated())
    monkeypatch.setattr(CellOptions, "cell", lambda _: CellConfig(RobotConfig("a"), SensorConfig("b")))
    calibration = tmp_path / "calibration.json"
    calibration.touch()
    outcome = CliRunner().invoke(stream.stream, ["--calibration", str(calibration), "--port", "0", *arguments])
    if isinstance(outcome.exception, Exception):
        raise outcome.exception
    assert outcome.stdout == ""
    return opened, outcome.stderr


def test_it_prints_what_is_served_and_how_to_open_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    opened, printed = run(monkeypatch, tmp_path, "--axes", "base", "--about", "flange", "--udp", "localhost:9871")
    assert opened["frame"] == WrenchFrame("base", "flange")
    assert "the arm reports no serial number" in printed
    assert printed.count("ws://127.0.0.1:") == 2
    assert "port 9871, JSON" in printed
    assert "app.foxglove.dev" in printed
    assert "Unprotected" not in printed


@pytest.mark.parametrize(("host", "protected"), [("localhost", True), ("127.0.0.2", True), ("0.0.0.0", False)])
def test_an_address_that_others_reach_is_said_to_be_unprotected(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, host: str, protected: bool
) -> None:
    _, printed = run(monkeypatch, tmp_path, "--host", host)
    assert ("There is no password and no encryption" in printed) is not protected
    assert "ws://0.0.0.0" not in printed
