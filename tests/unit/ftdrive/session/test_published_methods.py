"""A calibration by a published method: its poses, its result, and the commands that continue from its run."""

import json

import pytest
from click.testing import CliRunner

from ftdrive.cli import cli
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.fleet.resolve import solve_run
from ftdrive.report.subject import read_subject
from ftdrive.runs.run import Run
from ftdrive.runs.source import SolveOptions
from ftdrive.session.session import method_of_poses
from tests.unit.ftdrive.fake_cell import Lab


@pytest.fixture(autouse=True)
def _few_simulations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ftcalib.solver.SIMULATIONS", 20)  # of the covariance of a published method


@pytest.mark.slow
def test_the_run_keeps_its_method_and_every_solve_uses_it(lab: Lab) -> None:
    outcome = lab.calibrate(method="lrom")
    assert outcome is not None
    assert outcome.result.method == "lrom"
    assert Run(outcome.run.folder).method == "lrom"
    assert outcome.run.solve_command.endswith(" --method lrom")
    again = json.loads(solve_run(outcome.run.folder))  # as a fleet does
    assert again["method"] == "lrom"
    outcome.run.calibration_path.unlink()
    subject = read_subject(outcome.run.folder, SolveOptions())  # as a report does
    assert subject.result.method == "lrom"
    assert subject.reproduce == outcome.run.solve_command


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "sets", "words"),
    [
        ("srom", None, "the tour has 6 of them: plan all 24"),
        ("srom", "A+H", "the tour has 12 other poses: choose --method mixed"),
    ],
)
def test_a_tour_without_the_special_orientations_is_refused_before_it_moves(
    method: str, sets: str | None, words: str, lab: Lab
) -> None:
    with pytest.raises(PlanRefused, match=words):
        lab.calibrate(method=method, sets=sets)
    assert lab.arm.moves == []


@pytest.mark.slow
def test_case_8_and_its_table_come_from_one_run(lab: Lab) -> None:
    outcome = lab.calibrate(method="mixed", sets="A+H")
    assert outcome is not None
    assert (outcome.result.method, outcome.result.n_poses) == ("mixed", 36)
    folder = str(outcome.run.folder)
    answer = CliRunner().invoke(cli, ["solve", folder, "--method", "all", "--test", folder, "--json"])
    methods = {one["method"]: one for one in json.loads(answer.stdout)["methods"]}
    assert methods["mixed"]["test"]["largest"]["force_N"] < 0.1
    assert "test" not in methods["srom"]
    printed = CliRunner().invoke(cli, ["solve", folder, "--method", "carlson-eigen", "--as-published"])
    assert "method carlson-eigen as published" in printed.stdout
    incomplete = CliRunner().invoke(cli, ["solve", folder, "--table-iii"]).exception
    assert "poses of Table III are missing" in str(incomplete)


def test_methods_that_poses_alone_do_not_serve_are_refused() -> None:
    assert method_of_poses("yang") == "yang"
    with pytest.raises(ConfigError, match="no method 'SROM': choose one of ml, srom"):
        method_of_poses("SROM")
    with pytest.raises(ConfigError, match="needs the mass on the sensor"):
        method_of_poses("carlson-cayley")
