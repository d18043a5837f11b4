"""What `ftdrive transcript` measures and prints of a sensor, and what it cannot record."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from ftdrive.cli import cli
from ftdrive.errors import ConfigError
from ftdrivers.interfaces import DeviceInfo


class Sensor:
    def __init__(self, *, silent: bool = False) -> None:
        self.pieces_s: list[float] = []
        self.silent = silent

    def collect(self, duration_s: float) -> Any:
        self.pieces_s.append(duration_s)
        count = 0 if self.silent else 2 if len(self.pieces_s) == 1 else 1
        return SimpleNamespace(wrench=np.tile([1.0, -2.0, 3.0, 0.1, -0.2, 0.3], (count, 1)) * len(self.pieces_s))

    def identify(self) -> DeviceInfo:
        return DeviceInfo("Mini45", "FT9", "2.1")

    def health(self) -> Any:
        return SimpleNamespace(lost=4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("record",), "no sensor is given"),
        (("record", "--sensor", "ur-ft://10.0.0.1"), "is read over RTDE, which is not recorded"),
        (("record", "--sensor", "netft://10.0.0.1"), "is neither on a serial port nor on a CAN bus"),
        (("play",), "no transcript is given"),
    ],
)
def test_what_cannot_be_recorded_or_played_is_refused(arguments: tuple[str, ...], words: str, tmp_path: Path) -> None:
    output = ("-o", str(tmp_path / "t.jsonl")) if arguments[0] == "record" else ()
    outcome = CliRunner().invoke(cli, ["transcript", *arguments, *output])
    assert isinstance(outcome.exception, ConfigError)
    assert words in str(outcome.exception)
    assert not list(tmp_path.iterdir())
