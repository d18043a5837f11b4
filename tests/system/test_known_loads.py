"""The matrix of an emulated sensor from known loads, as a user finds it: three runs, the solution, its file."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.cell.emulated import REAL_PACE, Station
from ftdrive.runs import load
from ftdrive.runs.run import Run
from tests.system.command_line import AVERAGE_S, CommandLine
from tests.ur_rtde import require_ur_rtde

pytestmark = pytest.mark.slow

ANSWERS = "yes\n" * 6 + "MOVE\n" + "yes\n" * 2
"""More than any of the runs asks."""
LOAD_KG = 2.0
IMPERFECT = ("--seed", "5", "--gain", "2", "--cross-talk", "1")
HOOKS_MM = {"side": (100, 0, 50), "tip": (0, 0, 200)}


@pytest.fixture
def _swings_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take as many periods of the weight in less time: it swings as much faster as the emulated arm moves."""
    monkeypatch.setattr(load, "_SWING_S", 0.5)


def short_averages(config: Path) -> Path:
    """Change the configuration to averages of 0.4 s, and return it."""
    config.write_text(config.read_text().replace(f"average_s = {AVERAGE_S}", "average_s = 0.4"))
    return config


def tripped_guards(run: Path) -> list[int]:
    """Return the hazards for which a guard stopped the arm in a run."""
    return [event["hazard"] for event in Run(run).events() if event["event"] == "guard-tripped"]


def hang(station: Station, name: str) -> tuple[str, ...]:
    """Hang the load, and return the options that describe it."""
    station.control(do="set-payload", payload_kg=station.truth["payload_kg"] + LOAD_KG)
    station.control(do="hang", mass_kg=LOAD_KG, at_mm=HOOKS_MM[name])
    return "--load", f"{LOAD_KG:.3f}", "--at", f"{name}={','.join(map(str, HOOKS_MM[name]))}"


@pytest.mark.usefixtures("_swings_fast")
def test_the_matrix_is_found_within_its_sigma(ftdrive: CommandLine) -> None:
    require_ur_rtde()
    with Station("robotous-serial", (*IMPERFECT, "--swing", "2")) as station:
        truth, cell = station.truth, ("--config", short_averages(ftdrive.connect(station)))
        runs = [ftdrive.json("calibrate", "--quick", *cell, typed=ANSWERS)]
        runs += [ftdrive.json("calibrate", *hang(station, name), *cell, typed=ANSWERS) for name in HOOKS_MM]
        assert station.control(do="state")["bad_inputs"] == []
    folders = [ftdrive.folder / run["run"] for run in runs]
    assert not any(map(tripped_guards, folders))
    assert [run["verdict"] for run in runs] == ["good"] * 3
    solution = ftdrive.json("loads", "solve", *folders)
    assert (solution["verdict"], solution["saved"]) == ("good", "sensor.json")
    found = SensorMatrix.load(ftdrive.folder / "sensor.json")
    error = (found.error - truth["sensor_error"]).ravel()
    squares = error @ np.linalg.solve(found.covariance[3:, 3:], error)
    assert chi2.cdf(squares, error.size) < 0.9973, "3 sigma"
    # The loads, and not the assumed sizes, know it.
    assert (found.sigma.diagonal() < 0.25 * SensorMatrix.usual().sigma.diagonal()).all()


@pytest.mark.timeout(1200)
def test_a_load_that_swings_as_slowly_as_a_real_one_leaves_the_means_within_their_covariance(
    ftdrive: CommandLine,
) -> None:
    # Of 2 degrees, more was once left in the means of a busy computer than their covariance says.
    with Station("robotous-serial", (*IMPERFECT, "--swing", "1", *REAL_PACE), control_path="script") as station:
        cell = ("--config", short_averages(ftdrive.connect(station)))
        run = ftdrive.json("calibrate", *hang(station, "tip"), *cell, typed=ANSWERS)
    assert (run["verdict"], tripped_guards(ftdrive.folder / run["run"])) == ("good", [])


@pytest.mark.usefixtures("_swings_fast")
@pytest.mark.parametrize(("mode", "mover"), [("manual", "hand-guide"), ("listen", "pendant-program")])
def test_a_run_with_a_load_beside_a_hand_or_a_program(mode: str, mover: str, ftdrive: CommandLine) -> None:
    with Station("serial", ["--seed", "5"]) as station:
        cell = ("--config", ftdrive.connect(station))
        known = hang(station, "tip")
        station.control(do=mover, rest_s=4)
        answer = ftdrive.json("calibrate", f"--{mode}", *known, *cell)
    assert answer["verdict"] != "rejected", answer["findings"]
    assert answer["mass_kg"] == pytest.approx(station.truth["mass_kg"] + LOAD_KG, rel=0.06)
    records = Run(ftdrive.folder / answer["run"]).records()
    assert len(records) >= 6
    assert all(record.swings for record in records)
