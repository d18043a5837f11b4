"""A calibration by a published method: its poses, its result, and the commands that continue from its run."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ftdrive.cli import cli
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.fleet.resolve import solve_run
from ftdrive.report.subject import read_subject
from ftdrive.runs.bundle import write_bundle
from ftdrive.runs.run import Run
from ftdrive.runs.source import SolveOptions, read_dataset
from ftdrive.session.session import method_of_poses
from tests.unit.ftdrive.fake_cell import Lab


@pytest.fixture(autouse=True)
def _few_simulations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ftcalib.solver.SIMULATIONS", 20)  # of the covariance of a published method


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


def test_the_test_set_is_a_bundle_or_a_table_of_either_orientation(lab: Lab, tmp_path: Path) -> None:
    outcome = lab.calibrate()
    assert outcome is not None
    dataset = read_dataset(outcome.run.folder)
    write_bundle(outcome.run.folder, bundle := tmp_path / "run.zip")
    names = [f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)] + ["fx", "fy", "fz", "tx", "ty", "tz"]
    rows = np.hstack([np.swapaxes(dataset.R_base_flange, 1, 2).reshape(-1, 9), dataset.wrench])
    np.savetxt(table := tmp_path / "poses.csv", rows, delimiter=",", header=",".join(names), comments="")
    for test in (bundle, table):
        command = ["solve", str(table), "--method", "all", "--test", str(test), "--json"]
        answer = CliRunner().invoke(cli, [*command, "--orientation", "R_flange_base"])
        document = json.loads(answer.stdout)
        assert (document["test_set"], document["as_published"]) == (str(test), False)
        assert document["methods"][0]["test"]["largest"]["force_N"] < 0.1


def test_methods_that_poses_alone_do_not_serve_are_refused() -> None:
    assert method_of_poses("yang") == "yang"
    with pytest.raises(ConfigError, match="no method 'SROM': choose one of ml, srom"):
        method_of_poses("SROM")
    with pytest.raises(ConfigError, match="needs the mass on the sensor"):
        method_of_poses("carlson-cayley")
