"""What `ftdrive transcript` measures and prints of a sensor, and what it cannot record."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from click.testing import CliRunner

from ftdrive.cli import cli
from ftdrive.commands.transcript import _describe_bytes
from ftdrive.errors import ConfigError
from ftdrivers.errors import DeviceTimeout
from ftdrivers.interfaces import DeviceInfo
from ftdrivers.transcript import _watch


class Sensor:
    """Has two samples in the first piece, and one in each other."""

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


def test_a_long_recording_is_collected_in_pieces() -> None:
    sensor = Sensor()
    seen = _watch(cast("Any", sensor), 150.0)
    assert sensor.pieces_s == [50.0, 50.0, 50.0]
    assert (seen["samples"], seen["lost"], seen["duration_s"], seen["error"]) == (4, 4, 150.0, None)
    mean = (2 * 1 + 2 + 3) / 4
    assert seen["mean_force_N"] == pytest.approx([mean, -2 * mean, 3 * mean])
    assert seen["mean_torque_Nm"] == pytest.approx([0.1 * mean, -0.2 * mean, 0.3 * mean])
    assert _describe_bytes(seen) == (
        "Mini45, serial FT9: 4 samples, mean (1.750, -3.500, 5.250) N, (0.1750, -0.3500, 0.5250) N·m"
    )
    assert (_describe_bytes({"error": "it is gone"}), _describe_bytes({})) == ("it is gone", "interrupted")


def test_a_silent_sensor_is_an_error() -> None:
    with pytest.raises(DeviceTimeout, match="no sample arrived in 2 s"):
        _watch(cast("Any", Sensor(silent=True)), 2.0)


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
