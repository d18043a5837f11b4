"""The functions for a UR program: complete, for any first register. tests/wire runs them."""

import json

import pytest
from click.testing import CliRunner

from ftdrive.commands.export import urscript
from ftdrive.exports.program_functions import functions


@pytest.mark.parametrize("first", [24, 33])
def test_every_name_has_its_register(first: int) -> None:
    text = functions(first, example=True)
    assert "<" not in text.replace("<=", "").replace(" < ", "")
    assert f"read_input_integer_register({first + 4})" in text
    assert f"read_input_float_register({first + 14})" in text
    assert f"read_input_float_register({first + 15})" not in text
    assert "read_input_integer_register(23)" not in text


def test_the_command_prints_or_saves() -> None:
    plain = CliRunner().invoke(urscript, ["--first", "26"]).stdout
    assert plain == functions(26)
    answer = json.loads(CliRunner().invoke(urscript, ["--json", "--example"]).stdout)
    assert answer["text"] == functions(24, example=True)
