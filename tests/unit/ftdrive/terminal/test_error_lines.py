"""What an error prints: one line, whatever a file or a device is named."""

from pathlib import Path

import pytest

from ftdrive import cli
from ftdrive.words.text import in_one_line


def test_a_name_cannot_begin_a_second_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a\nerror: all is lost.csv", "b\r\nerror: all is lost.csv"):
        Path(name).write_text("1\n")
    with pytest.raises(SystemExit):
        cli.run(["solve", *map(str, Path().iterdir())])
    assert cli.run(["solve", "a\nerror: all is lost.csv"]) == 6
    lines = capsys.readouterr().err.splitlines()
    assert sorted(line[:8] for line in lines) == ["error: a", "error: a", "error: b"]


def test_a_command_keeps_its_line() -> None:
    assert in_one_line("it stopped; continue with\nftdrive calibrate --resume a") == (
        "it stopped; continue with\nftdrive calibrate --resume a"
    )
