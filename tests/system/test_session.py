"""A guided session as a user runs it, on an emulated cell: modes, a person who pushes, a sensor that stops, kill -9."""

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ftcalib import CalibrationResult
from ftcalib.accuracy import errors_in_sigma
from ftdrive.cell.emulated import Station
from ftdrive.planning.plan import Plan
from ftdrive.runs.run import Run
from tests.system.command_line import CommandLine, assert_found, end_of, listen_for, say, wait_until

QUESTIONS = "yes\nyes\nyes\n"
"""Tool free, ball free, emergency stop in reach."""
FIRST_MOTION = "MOVE\nyes\n"
"""The way to the first pose; the tour."""


@pytest.fixture
def station() -> Iterator[Station]:
    options = ["--seed", "5", "--payload", "1.5"]
    with Station("robotous-serial", options) as station:
        yield station


@pytest.fixture
def config(station: Station, ftdrive: CommandLine) -> Path:
    return ftdrive.connect(station)


def events_of(ftdrive: CommandLine) -> list[dict[str, Any]]:
    (path,) = ftdrive.folder.glob("runs/*/events.ndjson")
    return [json.loads(line) for line in path.read_text().splitlines()]


def moves_of(station: Station) -> int:
    return sum(event["what"] == "moves" for event in station.control(do="state", since=0)["events"])


def programs_of(station: Station) -> list[str]:
    """What happened to programs, and was asked for it."""
    diary = station.control(do="state", since=0)["events"]
    asked = [
        event["what"] for event in diary if event["by"] == "dashboard" and event["what"] in {"stop", "play", "pause"}
    ]
    return asked + [event["what"] for event in diary if event["by"] in {"program", "script port"}]


@pytest.mark.slow
@pytest.mark.parametrize("dry", [True, False], ids=["dry-run", "calibrate"])
def test_a_program_of_another_client_and_its_move_go_on(
    dry: bool, station: Station, config: Path, ftdrive: CommandLine
) -> None:
    q_rad = station.control(do="state")["q_rad"]
    goal = [*q_rad[:5], q_rad[5] - 3.0]
    station.control(do="foreign-program", q_rad=goal, speed_rad_s=0.01)
    wait_until(lambda: bool(station.control(do="state")["moving"]))
    before = station.control(do="state")
    programs = programs_of(station)
    options = ("--dry-run",) if dry else ()
    outcome = ftdrive.run("calibrate", "--config", config, *options, typed=QUESTIONS + FIRST_MOTION)
    assert outcome.returncode == 7, outcome.stderr
    assert "PLAYING" in outcome.stderr
    assert "[yes/no]" not in outcome.stderr, "it asks nothing before"
    after = station.control(do="state")
    assert (after["program"], after["runtime_state"], after["moving"]) == ("other", "PLAYING", True)
    assert after["q_rad"][5] < before["q_rad"][5]
    assert programs_of(station) == programs
    assert not (ftdrive.folder / "runs").exists()


@pytest.mark.slow
def test_a_new_tool_takes_four_long_poses(station: Station, config: Path, ftdrive: CommandLine) -> None:
    typed = QUESTIONS + FIRST_MOTION
    first = ftdrive.json("calibrate", "--config", config, "--minimal", typed=typed)
    before = moves_of(station)
    tool = ftdrive.json("calibrate", "--config", config, "--from", ftdrive.folder / first["run"], typed=typed)
    assert moves_of(station) - before == 5
    assert tool["provenance"]["parent"]["id"] == first["id"]
    assert tool["mass_kg"] == pytest.approx(first["mass_kg"], abs=0.01)
    runs = [Run(ftdrive.folder / one["run"]) for one in (first, tool)]
    usual, longer = ({one["average_s"] for one in run.events() if "average_s" in one} for run in runs)
    assert longer == {2 * average_s for average_s in usual}
    assert Plan.load(runs[1].plan_path).kind == "tool"


@pytest.mark.slow
def test_step_mode_moves_at_each_enter_and_a_completed_plan_may_run_by_itself(
    station: Station, config: Path, ftdrive: CommandLine
) -> None:
    typed = QUESTIONS + "\n" + FIRST_MOTION + "\n" * 6
    answer = ftdrive.json("calibrate", "--config", config, "--minimal", "--step", typed=typed)
    assert moves_of(station) == 7
    assert answer["drift_check"]["elapsed_s"] > 1
    assert len(answer["drift_check"]["change"]) == len(answer["drift_check"]["sigma"]) == 6
    found = {one["code"]: one["values"] for one in answer["findings"]}
    payload, lean = found["payload_mismatch"], found["base_leans"]
    assert (answer["verdict"], answer["hints"]) == ("usable", [])
    assert (payload["payload_kg"], payload["load_kg"]) == (1.5, pytest.approx(0.651, abs=0.01))
    assert lean["lean_deg"] == pytest.approx(1.63, abs=3 * lean["sigma_deg"])  # the noise is another in each run
    assert lean["side"] == "+y"  # gravity has a share along +y: alpha is 1.59°
    # The same posture gives the same plan, which has run to its end now.
    again = ftdrive.json("calibrate", "--config", config, "--minimal", "--fast", "--yes")
    assert again["mass_kg"] == pytest.approx(answer["mass_kg"], abs=0.01)
    assert station.control(do="state")["bad_inputs"] == []


@pytest.mark.slow
def test_a_push_stops_the_arm_until_a_person_says_go_on(station: Station, config: Path, ftdrive: CommandLine) -> None:
    process = ftdrive.start("calibrate", "--config", config, "--quick")
    say(process, QUESTIONS + FIRST_MOTION)
    ftdrive.wait_for_poses(process, 8)  # what a free tool weighs has to be known first
    station.control(do="push", wrench=[0, 40, 0, 0, 0, 0])
    said = listen_for(process, "/quit]")
    assert "unexpected contact" in said
    assert not station.control(do="state")["moving"]
    kept = len(ftdrive.poses())
    say(process, "resume\n")
    assert "not yet: unexpected contact" in listen_for(process, "/quit]")
    station.control(do="push", wrench=[0, 0, 0, 0, 0, 0])
    code, said = end_of(process, "resume\nyes\nyes\n")
    assert code == 0, said
    assert len(ftdrive.poses()) == 13 > kept
    trips = [event for event in events_of(ftdrive) if event["event"] == "guard-tripped"]
    assert {trip["hazard"] for trip in trips} == {14}
    result = CalibrationResult.load(ftdrive.poses()[0].parent.parent / "calibration.json")
    assert result.mass_kg == pytest.approx(station.truth["mass_kg"], abs=6 * float(result.sigma["mass_kg"]))


@pytest.mark.slow
def test_after_a_protective_stop_and_a_frozen_sensor_the_operator_goes_on(
    station: Station, config: Path, ftdrive: CommandLine
) -> None:
    process = ftdrive.start("calibrate", "--config", config, "--minimal")
    say(process, QUESTIONS + FIRST_MOTION)
    ftdrive.wait_for_poses(process, 2)
    station.control(do="protective-stop")
    listen_for(process, "/quit]")
    say(process, "resume\n")
    assert "not yet" in listen_for(process, "/quit]")

    def unlocked() -> bool:
        station.control(do="unlock")
        return bool(station.control(do="state")["safety_mode"] == "NORMAL")

    wait_until(unlocked)
    say(process, "resume\nyes\nyes\n")
    ftdrive.wait_for_poses(process, 4)
    station.control(do="freeze-sensor", on=True)
    listen_for(process, "/quit]")
    assert not station.control(do="state")["moving"]
    station.control(do="freeze-sensor", on=False)
    code, said = end_of(process, "resume\nyes\nyes\n")
    assert code == 0, said
    assert len(ftdrive.poses()) == 7
    diary = station.control(do="state", since=0)["events"]
    ours = [event["what"] for event in diary if event["by"] == "dashboard"]
    assert not [what for what in ours if what.startswith(("unlock", "play"))]
    trips = [event["hazard"] for event in events_of(ftdrive) if event["event"] == "guard-tripped"]
    assert trips[0] == 10
    assert 15 in trips[1:]


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on_and_finds_the_truth(
    station: Station, config: Path, ftdrive: CommandLine
) -> None:
    process = ftdrive.start("calibrate", "--config", config, "--minimal")
    say(process, QUESTIONS + FIRST_MOTION)
    ftdrive.wait_for_poses(process, 3)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    kept = {path.name: path.read_bytes() for path in ftdrive.poses()}
    run = ftdrive.poses()[0].parent.parent
    resumed = ftdrive.json("calibrate", "--resume", run, typed=QUESTIONS + "MOVE\n")
    assert (ftdrive.folder / resumed["run"]).resolve() == run.resolve()
    assert {name: (run / "poses" / name).read_bytes() for name in kept} == kept
    assert len(ftdrive.poses()) == 7
    assert_found(errors_in_sigma(CalibrationResult.load(run / "calibration.json"), station.truth))
    assert ftdrive.json("replay", run)["mass_kg"] == resumed["mass_kg"]

    # Its plan has not run to its end in one session: another run begins like a first one.
    assert ftdrive.run("calibrate", "--config", config, "--minimal", "--yes").returncode == 130
