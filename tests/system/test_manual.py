"""Another client moves the emulated arm and the session only looks, to a result near the truth."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from ftdrive.cell import emulated
from ftdrive.cli import cli


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["manual", "listen"])
def test_the_operator_of_the_emulated_cell_brings_it_to_its_end(
    mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    request, words = emulated.MOVED_BY[mode]
    monkeypatch.setattr(emulated, "MOVED_BY", {mode: ({**request, "rest_s": 1.2}, words)})  # in a hurry
    cell = ["--simulate", "--sensor", "emulated://serial", f"--{mode}"]
    arguments = ["calibrate", *cell, "--runs", str(tmp_path), "--json"]
    outcome = CliRunner().invoke(cli, arguments)
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    assert words in outcome.stderr
    answer = json.loads(outcome.stdout.splitlines()[-1])
    assert answer["verdict"] != "rejected"
    truth = json.loads((Path(answer["run"]) / "run.json").read_text())["station"]["truth"]
    assert answer["mass_kg"] == pytest.approx(truth["mass_kg"], abs=3 * answer["sigma"]["mass_kg"])
