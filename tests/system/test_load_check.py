"""`ftdrive loads check` on an emulated cell: a weight hangs on a string from the tool."""

import json

import pytest
from click.testing import CliRunner

from ftdrive.cli import cli


@pytest.mark.slow
def test_a_known_weight_on_a_string_is_read_right() -> None:
    words = ["loads", "check", "1.000", "--at", "tip=0,0,200", "--simulate", "--zero", "--json"]
    found = CliRunner().invoke(cli, words)
    assert found.exception is None, found.output
    answer = json.loads(found.stdout)
    assert abs(answer["scale_error"]) < 0.04  # the sensor of the cell is not perfect
    assert answer["scale_sigma"] < 0.01
    assert answer["off_m"] < 0.005
    assert answer["is_within"]
