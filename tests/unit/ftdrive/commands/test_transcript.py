"""What `ftdrive transcript` measures and prints of a sensor, and what it cannot record."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from ftdrive.cli import cli
from ftdrive.errors import ConfigError


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
