"""cells.toml: what it says becomes cells, every mistake is one sentence, and each result finds its cell."""

from pathlib import Path

import pytest

from ftdrive.errors import ConfigError
from ftdrive.fleet.cells import Owners, read_cells, refuse_ambiguous
from tests.unit.ftdrive.fleet.fleet_records import cell, result

HEAD = 'format = "ftdrive.config/1"\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two configurations, one with the serial number of its arm."""
    (tmp_path / "a").mkdir()
    (tmp_path / "a/ftdrive.toml").write_text(
        HEAD + '[robot]\nhost = "10.0.0.1"\nserial = "111"\n[tool]\nname = "drill"\n'
    )
    (tmp_path / "b.toml").write_text(HEAD + '[robot]\nhost = "10.0.0.2"\n[sensor]\nurl = "ati-can://can0"\n')
    (tmp_path / "empty.toml").write_text(HEAD)
    return tmp_path


def written(folder: Path, text: str, head: str = 'format = "ftdrive.cells/1"\n') -> Path:
    path = folder / "cells.toml"
    path.write_text(head + text)
    return path


def test_a_variable_that_would_be_the_same_in_all_cells_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FTDRIVE_ROBOT_HOST", "10.0.0.9")
    with pytest.raises(ConfigError, match="FTDRIVE_ROBOT_HOST is set and would replace a value of every cell"):
        read_cells(written(folder, _CELL))


_CELL = '[cells.a]\nconfig = "b.toml"\nverify_every_days = 7\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[cells.a\n", r"cells\.toml is not a TOML file"),
        ("", "no cell is listed: write a table"),
        ("[cells]\n", "no cell is listed"),
        (f"schedule = 3\n{_CELL}", "the key schedule is unknown"),
        (f"{_CELL}verify_every = 7\n", r"\[cells\.a\]: the key verify_every is unknown: the keys are config"),
        ("[cells]\na = 3\n", "is 3: write a table"),
        ('[cells."a/b"]\nconfig = "b.toml"\nverify_every_days = 7\n', "is not a valid cell name"),
        ("[cells.a]\nverify_every_days = 7\n", "config is None: give the path"),
        ('[cells.a]\nconfig = "c.toml"\nverify_every_days = 7\n', r"c\.toml does not exist: correct the path"),
        ('[cells.a]\nconfig = "empty.toml"\nverify_every_days = 7\n', r"has no \[robot\] host"),
        ('[cells.a]\nconfig = "b.toml"\n', "verify_every_days is None: give a number of days"),
        ('[cells.a]\nconfig = "b.toml"\nverify_every_days = 0\n', "verify_every_days is 0: give"),
        ('[cells.a]\nconfig = "b.toml"\nverify_every_days = true\n', "verify_every_days is True"),
        ('[cells.a]\nconfig = "b.toml"\nverify_every_days = nan\n', "verify_every_days is nan"),
        (f"{_CELL}arm_serial = 222\n", "arm_serial is 222: give it as a string"),
    ],
)
def test_each_mistake_is_one_sentence(folder: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        read_cells(written(folder, text))


def test_cells_whose_runs_cannot_be_separated_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"a and b have the same \[robot\] host host-a.*set arm_serial in each cell"):
        refuse_ambiguous([cell("a"), cell("b", robot_host="host-a")])
    with pytest.raises(ConfigError, match="a and b have the same arm_serial 1"):
        refuse_ambiguous([cell("a", arm_serial="1"), cell("b", arm_serial="1")])
    refuse_ambiguous([cell("a", arm_serial="1"), cell("b", arm_serial="2", robot_host="host-a"), cell("c")])


def test_a_result_belongs_to_a_cell_by_serial_number_then_by_host() -> None:
    owners = Owners([cell("a"), cell("b", arm_serial="222"), cell("c", arm_serial="333", robot_host="host-a")])
    assert owners.cell_of(result("a", 1)) == "a"
    assert owners.cell_of(result("a", 1, arm_serial="222")) == "b"
    assert owners.cell_of(result("a", 1, arm_serial="333")) == "c"
    assert owners.cell_of(result("b", 1)) is None  # another arm at the address of a cell that has a serial number
    assert owners.cell_of(result("a", 1, arm_serial=None, robot_host=None)) is None
