"""Commands in messages are those that the user can type; an error is one line, whatever a file is named."""

from pathlib import Path

import pytest

from ftdrive import cli


@pytest.fixture
def _started_by_uv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UV_RUN_RECURSION_DEPTH", "1")


@pytest.mark.usefixtures("_started_by_uv")
def test_errors_and_next_steps_name_commands_as_they_can_be_typed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["push"]) == 2
    assert cli.run(["history"]) == 0
    assert "with `uv run ftdrive calibrate`" in capsys.readouterr().err


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
