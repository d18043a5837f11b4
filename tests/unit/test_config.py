"""The cell's configuration file: what is wrong is said, with the key."""

from pathlib import Path

import pytest

from ftdrive.config import load
from ftdrive.errors import ConfigError

GOOD = 'format = "ftdrive.config/1"\n[robot]\nhost = "10.0.0.2"\n[sensor]\nurl = "ati-can://can0"\n'


def test_defaults_fill_what_is_not_said(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(GOOD + "[sampling]\naverage_s = 1\n")
    cell = load(path)
    assert (cell.robot.host, cell.sensor.sign, cell.sampling.average_s, cell.site.g_m_s2) == ("10.0.0.2", 1, 1, 9.80665)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "format"),
        (GOOD.replace("/1", "/2"), "ftdrive.config/2"),
        (GOOD.replace("host", "hots"), "hots"),
        (GOOD.replace("[robot]", "[robots]"), "robots"),
        (GOOD.replace('"10.0.0.2"', "10"), "host"),
        (GOOD.replace('host = "10.0.0.2"', ""), "host"),
        (GOOD + "[sampling]\nattempts = 1.5\n", "attempts"),
        (GOOD + "sign = true\n", "sign"),
        (GOOD + "[robot", "TOML"),
        (GOOD + '[site]\ng_m_s2 = "9.8"\n', "g_m_s2"),
    ],
)
def test_errors_name_the_key(text: str, word: str, tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=word):
        load(path)
