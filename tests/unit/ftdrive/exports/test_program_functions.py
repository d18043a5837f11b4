"""The functions for a UR program: complete, for any first register. tests/wire runs them."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from ftdrive.commands.export import urscript
from ftdrive.exports.program_functions import functions


@pytest.mark.parametrize(("first", "doubles"), [(24, 22), (26, 22), (27, 15), (33, 15)])
def test_every_name_has_its_register(first: int, doubles: int) -> None:
    text = functions(first, example=True)
    assert "<" not in text.replace("<=", "").replace(" < ", "")
    assert f"read_input_integer_register({first + 4})" in text
    assert ("def ftd_bias" in text) == (doubles == 22), "the tracked bias has no room behind a later register"
    assert f"read_input_float_register({first + doubles - 1})" in text
    assert f"read_input_float_register({first + doubles})" not in text
    assert "read_input_integer_register(23)" not in text


def test_the_command_prints_or_saves(tmp_path: Path) -> None:
    plain = CliRunner().invoke(urscript, ["--first", "26"]).stdout
    assert plain == functions(26)
    answer = json.loads(CliRunner().invoke(urscript, ["--json", "--example"]).stdout)
    assert (answer["text"], answer["file"]) == (functions(24, example=True), None)
    path = tmp_path / "ftd.script"
    saved = CliRunner().invoke(urscript, ["-o", str(path)]).stdout
    assert "".join(saved.split()) == f"Saved{path}"
    assert path.read_text() == functions(24)
    answer = json.loads(CliRunner().invoke(urscript, ["--json", "-o", str(tmp_path / "two.script")]).stdout)
    assert answer["file"] == str(tmp_path / "two.script")
