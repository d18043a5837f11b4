"""Runs with a known load that hangs from a hook; `test_demo.py` solves such runs for the matrix of the sensor."""

import pytest

from ftdrive.cell.emulated import REAL_PACE, Station
from ftdrive.runs import load
from ftdrive.runs.run import Run
from tests.system.command_line import AVERAGE_S, CommandLine

pytestmark = pytest.mark.slow

ANSWERS = "yes\n" * 6 + "MOVE\n" + "yes\n" * 2
"""More than any of the runs asks."""
LOAD_KG = 2.0


def hang(station: Station) -> tuple[str, ...]:
    """Hang the load at the tip, and return the options that describe it."""
    station.control(do="set-payload", payload_kg=station.truth["payload_kg"] + LOAD_KG)
    station.control(do="hang", mass_kg=LOAD_KG, at_mm=(0, 0, 200))
    return "--load", f"{LOAD_KG:.3f}", "--at", "tip=0,0,200"


@pytest.mark.timeout(1200)
def test_a_load_that_swings_as_slowly_as_a_real_one_leaves_the_means_within_their_covariance(
    ftdrive: CommandLine,
) -> None:
    # Of 2 degrees, more was once left in the means of a busy computer than their covariance says.
    with Station("robotous-serial", ["--seed", "5", "--swing", "1", *REAL_PACE], control_path="script") as station:
        config = ftdrive.connect(station)
        config.write_text(config.read_text().replace(f"average_s = {AVERAGE_S}", "average_s = 0.4"))
        run = ftdrive.json("calibrate", *hang(station), "--config", config, typed=ANSWERS)
    assert run["verdict"] == "good"
    assert not [event for event in Run(ftdrive.folder / run["run"]).events() if event["event"] == "guard-tripped"]


@pytest.mark.parametrize(("mode", "mover"), [("manual", "hand-guide"), ("listen", "pendant-program")])
def test_a_run_with_a_load_beside_a_hand_or_a_program(
    mode: str, mover: str, ftdrive: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(load, "_SWING_S", 0.5)  # the weight swings as much faster as the emulated arm moves
    with Station("serial", ["--seed", "5"]) as station:
        cell = ("--config", ftdrive.connect(station))
        known = hang(station)
        station.control(do=mover, rest_s=4)
        answer = ftdrive.json("calibrate", f"--{mode}", *known, *cell)
    assert answer["verdict"] != "rejected", answer["findings"]
    assert answer["mass_kg"] == pytest.approx(station.truth["mass_kg"] + LOAD_KG, rel=0.06)
    records = Run(ftdrive.folder / answer["run"]).records()
    assert len(records) >= 6
    assert all(record.swings for record in records)
