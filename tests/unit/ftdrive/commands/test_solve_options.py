"""`ftdrive solve` before it reads anything: which options go together."""

from pathlib import Path
from shutil import copy

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


@pytest.mark.parametrize(
    ("options", "following"),
    [
        ("--up 0,0,1", ["report poses.csv --up 0,0,1", "solve poses.csv --up 0,0,1 -o calibration.json"]),
        ("--from old.json --all", ["solve poses.csv --from old.json -o calibration.json"]),
        ("-o new.json", ["report new.json", "live --calibration new.json"]),
    ],
)
def test_what_is_typed_next_has_the_options_that_were_given(
    options: str, following: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    copy(Path(__file__).parents[4] / "examples" / "poses.csv", "poses.csv")
    for typed in ("-o old.json", options):
        outcome = CliRunner().invoke(cli, ["solve", "poses.csv", *typed.split()])
    commands = [line.partition(" (")[0].strip() for line in outcome.stderr.partition("Next\n")[2].splitlines()]
    assert [one.removeprefix("ftdrive ") for one in commands if one.startswith("ftdrive ")] == following
