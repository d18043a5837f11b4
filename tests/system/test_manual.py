"""Another client moves the emulated arm and the session only looks: over real wires, to a result within its sigmas."""

import json
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from click.testing import CliRunner

from ftcalib import solve
from ftcalib.routine import PoseRecord, TourPose, dataset_from, drift_check
from ftdrive.cell import emulated
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.cell.emulated import Station
from ftdrive.cli import cli
from ftdrive.planning.search.constant_tour import NUMBERS, constant_tour
from ftdrive.runs.run import Run
from ftdrive.session.events import Estimated, Event, PoseTaken
from ftdrive.session.guards import Limits
from ftdrive.session.hand_guided import HandGuided
from ftdrive.session.journal import Journal
from ftdrive.session.live_fit import Judge
from ftdrive.session.open_cell import OpenCell
from ftdrive.session.operator import Key, Question
from ftdrive.session.pose_book import PoseBook
from ftdrive.terminal.report import errors_in_sigma
from ftdrivers.errors import StreamBroken
from ftdrivers.interfaces import ArmState, ArmStatus, RobotArm
from tests.system.command_line import assert_found

QUICK = (2, 4, 5, 7, 10, 12, 13, 15, 18, 20, 21, 23)
"""Of the paper's 24 orientations, as well conditioned as all of them."""


class Mover:
    """The other client: takes the arm from pose to pose, and on as soon as each was measured."""

    def __init__(self, arm: RobotArm, stops: Sequence[TourPose]) -> None:
        self._arm, self._stops = arm, stops
        self._taken = threading.Semaphore(0)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mover")

    def _run(self) -> None:
        for stop in self._stops:
            self._arm.move_to([float(angle) for angle in stop.q_rad], timeout_s=60, guard=lambda: None)
            if not self._taken.acquire(timeout=60) or self._over.is_set():
                return
        self._over.wait(60)

    @property
    def plays(self) -> bool:
        return self._thread.is_alive()

    def measured(self) -> None:
        self._taken.release()

    def __enter__(self) -> "Mover":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._taken.release()
        self._thread.join(90)


class Spectator:
    """Our arm, for reading only."""

    def __init__(self, arm: RobotArm, mover: Mover) -> None:
        self._arm, self._mover = arm, mover

    def state(self) -> ArmState:
        return self._arm.state()

    def status(self) -> ArmStatus:
        return replace(self._arm.status(), program="playing" if self._mover.plays else "stopped")


class Person:
    """Lets the mover go on after each pose."""

    has_keys = True

    def __init__(self, taken: Callable[[], None]) -> None:
        self._taken = taken

    def show(self, event: Event) -> None:
        if isinstance(event, PoseTaken):
            self._taken()

    def ask(self, question: Question) -> str:
        raise AssertionError(question)

    def pressed(self) -> Key | None:
        return None


class Fit:
    """Enough from the sixth pose on."""

    def __init__(self) -> None:
        self._poses = 0

    def add(self, record: PoseRecord) -> Estimated:
        self._poses = max(self._poses, record.stop)
        return Estimated(
            poses=self._poses,
            values={},
            sigma={},
            residual_sigma=None,
            residual_force_N=None,
            faces=(0, 0, 0, 0, 0, 0),
            cond9=1.0,
            cond_u1=1.0,
            empty_cap_deg=1.0,
            light="green" if self._poses >= 6 else "amber",
            hint="",
        )


@pytest.fixture
def station() -> Iterator[Station]:
    with Station("serial", ["--seed", "11"]) as station:
        yield station


def watch(station: Station, run: Run, *, commit: Callable[[PoseRecord], None] | None = None) -> None:
    """Collect while the other client takes the arm through some poses and back to the first."""
    cell = station.cell
    with closing(build_arm(cell)) as theirs, closing(build_arm(cell)) as ours, build_sensor(cell) as sensor:
        theirs.open(control=True)
        ours.open()
        tour = [
            TourPose(number, q)
            for number, q in zip(NUMBERS, constant_tour(ours.state().q_rad), strict=True)
            if number in QUICK
        ]
        mover = Mover(theirs, [*tour, tour[0]])
        person = Person(mover.measured)
        with mover:
            arm: Any = Spectator(ours, mover)
            opened = OpenCell(arm, sensor, cell.clock, Journal(person), Limits())
            kept, fit = cast(Run, SimpleNamespace(commit=commit or run.commit)), cast(Judge, Fit())
            book = PoseBook(opened, kept, fit, np.array([0.0, 0.0, -1.0]))
            HandGuided(opened, book, cell.sampling, listen=True).run((), "the coverage is green")
            assert mover.plays  # it was we who found the end


@pytest.mark.slow
def test_watching_finds_the_truth(station: Station, tmp_path: Path) -> None:
    run = Run.create(tmp_path, "manual", {})
    watch(station, run)
    records = run.records()
    assert all(record.steady for record in records)
    assert [record.stop for record in records] == list(range(1, 14))
    dataset = dataset_from(records, {})
    assert len(dataset) == 12
    result = solve(dataset)
    assert_found(errors_in_sigma(result, station.truth))
    drift = drift_check(records)
    assert drift is not None
    assert np.all(np.abs(drift.change) < 6 * drift.sigma)


def test_a_lost_sensor_ends_it_with_the_poses_on_disk(station: Station, tmp_path: Path) -> None:
    run = Run.create(tmp_path, "manual", {})

    def commit(record: PoseRecord) -> None:
        run.commit(record)
        if record.stop == 2:
            station.control(do="unplug", device="sensor")

    with pytest.raises(StreamBroken):
        watch(station, run, commit=commit)
    assert len(run.records()) == 2


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
    assert answer["mass_kg"] == pytest.approx(truth["mass_kg"], rel=0.01)
