"""`ftdrive solve` before it reads anything: which options go together."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from ftdrive.cli import cli
from ftdrive.errors import ConfigError

PAIR = ("--wrench", "a.csv", "--orientation-file", "b.csv")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "no data"),
        (PAIR[:2], "give both"),
        (("a.csv", *PAIR), "and no DATASET"),
        (("a.csv", "--together"), "two runs or more"),
        ((*PAIR, "--together"), "poses at rest"),
        (("a.csv", "--from", "old.json", "--method", "srom"), "need --method ml"),
        (("a.csv", "b.csv", "--together", "--from", "old.json"), "are mutually exclusive"),
        (("a.csv", "b.csv", "-o", "new.json"), "one dataset and one method"),
        (("a.csv", "--test", "b.csv"), "add --method all"),
        (("a.csv", "--method", "all", "--test", "b.csv", "--table-iii"), "leave out --method, --test"),
        (("a.csv", "--mass-kg", "1", "--table-iii"), "and known values"),
        (("a.csv", "--method", "srom", "--as-published"), "leave it out"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    arguments: tuple[str, ...], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.csv", "b.csv", "old.json"):
        Path(name).touch()
    error = CliRunner().invoke(cli, ["solve", *arguments]).exception
    assert isinstance(error, ConfigError)
    assert words in str(error)
    assert not Path("new.json").exists()


def test_each_of_several_sources_that_fail_is_named_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b", "empty"):
        Path(name).mkdir()
    for path in ("first.csv", "a/poses.csv", "b/poses.csv"):
        Path(path).write_text("p,q\n1,2\n")
    printed = CliRunner().invoke(cli, ["solve", "first.csv", "empty"]).output
    assert [printed.count(name) for name in ("error: ", "first.csv", "empty")] == [2, 1, 1]
    alike = CliRunner().invoke(cli, ["solve", "a/poses.csv", "b/poses.csv"]).output
    assert [alike.count(path) for path in ("a/poses.csv", "b/poses.csv")] == [1, 1]
