"""The state machine on a fake cell: states, questions, holds, keys, resume; each fault injected on the way."""

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.routine import PoseRecord, Sampling
from drivers.errors import DeviceFault, DeviceTimeout, DriverError, StreamBroken
from drivers.interfaces import ArmState, ArmStatus, DeviceInfo, ForceTorqueSensor, FtSamples, Guard, Health, RobotArm
from ftdrive.config import CellConfig, RobotConfig, SensorConfig, ToolConfig, WorkcellConfig
from ftdrive.errors import ConfigError, Declined, NotAccepted, PlanRefused
from ftdrive.planning import view
from ftdrive.planning.arm_model import ArmModel, Cylinder
from ftdrive.planning.cell import certifier_for
from ftdrive.planning.certify import Certifier
from ftdrive.planning.motion import Speeds, tips
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, guess_of, plan_tour
from ftdrive.runs import Run
from ftdrive.session import guided, machine, preflight
from ftdrive.session.completed import has_completed
from ftdrive.session.events import (
    Asked,
    Checked,
    Estimated,
    Event,
    GuardTripped,
    Noted,
    Planned,
    PoseTaken,
    RunOpened,
    State,
    StateChanged,
)
from ftdrive.session.guided import Options
from ftdrive.session.operator import Key, Question
from ftdrive.session.operators import in_words
from ftdrive.session.outcome import Outcome

Array = NDArray[np.float64]

SPEED = 4000.0
"""The fake arm is this many times faster than it should be."""
STATUS = ArmStatus(0, 0.0, "running", "normal", "playing", None, 1.0, 1.0, 1.5, (0.0, 0.0, 0.05), (0.0,) * 6)
MODEL = ArmModel("UR5e", [Cylinder(0.0, 0.2, 0.1)])
NOISE = np.repeat([0.02, 0.001], 3)


class FakeArm(RobotArm):
    """Joints that go where they are sent, in steps; faults by `at_move`."""

    def __init__(self) -> None:
        self.q = USUAL_POSTURE_RAD + np.radians([0, 0, 0, 3.0, -2, 4])
        self._status = STATUS
        self.push_rad = np.zeros(6)
        self.moves: list[tuple[Array, float, float]] = []
        self.stops = 0
        self.opened = 0
        self.control = False
        self.at_move: dict[int, Callable[[], None]] = {}
        self.forbidden: Array | None = None
        self.halted = threading.Event()
        self.gone: DriverError | None = None
        self.gone_status: dict[str, Any] = {}

    def open(self, *, control: bool = False) -> None:
        self.opened += 1
        self.control = control

    def close(self) -> None:
        pass

    def identify(self) -> DeviceInfo:
        return DeviceInfo("UR5e", "A1", "5.15")

    def state(self) -> ArmState:
        if self.gone:
            if self.gone_status:
                self.set_status(**self.gone_status)
            raise self.gone
        q = self.q + self.push_rad
        at = MODEL.frames(q)
        return ArmState(time.monotonic_ns(), 0.0, q, np.zeros(6), at.R_base_flange[0], at.flange_m[0])

    def status(self) -> ArmStatus:
        return self._status

    def set_status(self, **different: Any) -> None:
        self._status = replace(STATUS, **different)

    def lose_power(self) -> None:
        """An emergency stop, of which the joints tell before the status does."""
        self.gone_status = {"fault": "emergency stop: …", "safety_mode": "robot emergency stop"}
        self.gone = DeviceFault("the joints are not measured")

    def power_up(self) -> None:
        self.gone_status, self.gone = {}, None
        self.set_status()

    def within_safety_limits(self, q_rad: Sequence[float]) -> bool:
        return self.forbidden is None or not np.allclose(q_rad, self.forbidden)

    def move_to(
        self,
        q_rad: Sequence[float],
        *,
        timeout_s: float,
        guard: Guard,
        speed_rad_s: float | None = None,
        acceleration_rad_s2: float | None = None,
    ) -> None:
        assert self.control
        assert timeout_s > 0
        assert speed_rad_s is not None
        assert acceleration_rad_s2 is not None
        goal = np.array(q_rad)
        self.moves.append((goal, speed_rad_s, acceleration_rad_s2))
        self.halted.clear()
        start, steps = self.q, 4
        fault = self.at_move.pop(len(self.moves), None)
        for step in range(1, steps + 1):
            guard()
            if self.halted.is_set():
                raise DeviceFault("the arm was told to stop before it had arrived.")
            self.q = start + step / steps * (goal - start)
            if fault is not None and step == 2:
                fault()
                deadline = time.monotonic() + 20  # held here until something stops it
                while not self.halted.is_set():
                    guard()
                    assert time.monotonic() < deadline
                    time.sleep(0.002)
            time.sleep(0.001)

    def wait_until_still(self, *, timeout_s: float, guard: Guard) -> None:
        assert timeout_s > 0
        guard()

    def stop(self) -> None:
        self.stops += 1
        self.halted.set()


class FakeSensor(ForceTorqueSensor):
    """Feels 1.2 kg hanging on the arm's flange, and what pushes."""

    def __init__(self, arm: FakeArm) -> None:
        self.arm = arm
        self.rng = np.random.default_rng(1)
        self.push = np.zeros(6)
        self.noise = NOISE
        self.failure: DriverError | None = None
        self.stuck = False
        self.heals = False
        self.collecting: Callable[[], None] = lambda: None
        self._newest = np.zeros(6)
        self._seq = 0
        self.events: tuple[tuple[int, str], ...] = ()

    def open(self) -> None:
        if self.heals:
            self.failure, self.stuck = None, False

    def close(self) -> None:
        pass

    def identify(self) -> DeviceInfo:
        return DeviceInfo("fake", "S1", "1")

    def _wrench(self) -> Array:
        if not self.stuck:
            at = MODEL.frames(self.arm.q).R_base_flange[0]
            force = at.T @ [0, 0, -1.2 * 9.81]
            free = np.add(np.r_[force, np.cross([0.01, 0, 0.06], force)], [1, 2, 3, 0.1, 0.2, 0.3])
            self._newest = free + self.push + self.rng.normal(0, self.noise)
        return self._newest

    def collect(self, duration_s: float) -> FtSamples:
        self.check()
        n = max(40, int(duration_s * 100))
        self.collecting()
        rows = np.array([self._wrench() for _ in range(n)])
        now = time.monotonic_ns()
        self._seq += n
        return FtSamples(
            now - (np.arange(n)[::-1] * 1_000_000).astype(np.int64),
            np.full(n, np.nan),
            np.arange(n, dtype=np.int64),
            np.zeros((n, 0), np.int32),
            rows,
            np.zeros(n, np.uint32),
        )

    def latest(self, *, timeout_s: float) -> FtSamples:
        assert timeout_s == 0
        self.check()
        self._seq += 1
        return FtSamples(
            np.array([time.monotonic_ns()]),
            np.array([np.nan]),
            np.array([self._seq]),
            np.zeros((1, 0), np.int32),
            self._wrench()[None],
            np.zeros(1, np.uint32),
        )

    def check(self) -> None:
        if self.failure is not None:
            raise self.failure

    def health(self) -> Health:
        return Health(self._seq, 0, 0, 1000.0, 0.001, events=self.events)


@dataclass
class Scripted:
    """An operator that agrees to everything, but for what a test says."""

    answers: dict[str, list[str]] = field(default_factory=dict)
    on_event: Callable[[Event], None] = lambda _: None
    keys: list[Key] = field(default_factory=list)
    told: list[Event] = field(default_factory=list)
    asked: list[Question] = field(default_factory=list)

    def tell(self, event: Event) -> None:
        self.told.append(event)
        self.on_event(event)

    def ask(self, question: Question) -> str:
        self.asked.append(question)
        for word, answers in self.answers.items():
            if word in question.text and answers:
                return answers.pop(0)
        if "resume" in question.answers:
            raise Declined("nobody")
        return question.answers[0]

    def pressed(self) -> Key | None:
        return self.keys.pop(0) if self.keys else None

    def states(self) -> list[State]:
        return [event.state for event in self.told if isinstance(event, StateChanged)]

    def of(self, kind: type[Any]) -> list[Any]:
        return [event for event in self.told if isinstance(event, kind)]


class Lab:
    """A fake cell and what a test wants of it."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.arm = FakeArm()
        self.sensor = FakeSensor(self.arm)
        self.operator = Scripted()
        self.cell = CellConfig(
            RobotConfig("fake"),
            SensorConfig("fake://"),
            ToolConfig(cylinders_mm=((0.0, 200.0, 100.0),)),
            WorkcellConfig(measured=True),
            Sampling(average_s=0.3, noise_record_s=0.0),
        )
        monkeypatch.setattr(guided, "build_arm", lambda _: self.arm)
        monkeypatch.setattr(guided, "build_sensor", lambda _: self.sensor)
        monkeypatch.setattr(preflight, "_LINK_S", 0.02)
        monkeypatch.setattr("shutil.which", lambda _: None)

    def calibrate(self, **options: Any) -> Outcome | None:
        return guided.calibrate(self.cell, self.operator, Options(self.folder / "runs", poses=6, **options))

    def run(self) -> Run:
        (folder,) = (self.folder / "runs").iterdir()
        return Run(folder)

    def stops(self) -> list[int]:
        return [record.stop for record in self.run().records()]


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    yield Lab(tmp_path, monkeypatch)
    assert not [thread for thread in threading.enumerate() if thread.name == "guards"]


def test_the_states_follow_one_another_and_all_is_written_down(lab: Lab) -> None:
    outcome = lab.calibrate()
    assert outcome is not None
    assert outcome.result.mass_kg == pytest.approx(1.2, abs=0.01)
    states = lab.operator.states()
    one = [State.MOVE, State.SETTLE, State.SAMPLE]
    assert states == [State.IDLE, State.PREFLIGHT, State.APPROACH, *one[1:], *one * 6, State.CLOSE, State.REPORT]
    assert [event.stop for event in lab.operator.of(PoseTaken)] == [1, 2, 3, 4, 5, 6, 7]
    run = lab.run()
    lines = (run.folder / "events.ndjson").read_text().splitlines()
    assert len(lines) == len(lab.operator.told)
    assert outcome.drift is not None
    assert {path.name for path in run.folder.iterdir()} >= {"plan.json", "run.json", "dataset.json", "calibration.json"}


def test_questions_come_in_order_and_the_first_motion_wants_a_word(lab: Lab) -> None:
    lab.calibrate()
    texts = [question.text for question in lab.operator.asked]
    order = ["tool free", "ball of 0.3", "emergency stop in reach", "Type MOVE", "Begin"]
    assert [next(word for word in order if word in text) for text in texts] == order
    assert all(question.assumed is None for question in lab.operator.asked)
    assert len(lab.operator.of(Asked)) == 5


def test_the_diary_says_where_nobody_was_asked(lab: Lab) -> None:
    lab.calibrate(yes=True)  # a first run: --yes answers nothing
    assert {event.by for event in lab.operator.of(Asked)} == {"person"}
    lab.operator.told.clear()
    lab.operator.asked.clear()
    lab.operator.answers["tool free"] = ["no"]
    lab.arm.q = lab.arm.q + np.radians([0, 0, 0, 0, 0, 5.0])
    lab.calibrate(yes=True)
    assert lab.operator.asked == []
    answered = [(event.answer, event.by) for event in lab.operator.of(Asked)]
    assert answered == [(answer, "--yes") for answer in ("yes", "yes", "yes", "MOVE", "yes")]
    assert all(in_words(event).endswith(f"{event.answer} (--yes)") for event in lab.operator.of(Asked))


@pytest.mark.parametrize("word", ["tool free", "ball", "emergency stop in reach", "MOVE"])
def test_without_an_answer_nothing_moves(word: str, lab: Lab) -> None:
    lab.operator.answers[word] = ["no"]
    with pytest.raises(Declined):
        lab.calibrate()
    assert lab.arm.moves == []


def test_the_first_run_is_slow_whatever_was_asked_and_the_second_may_be_fast(lab: Lab) -> None:
    lab.calibrate(fast=True)
    assert max(speed for _, speed, _ in lab.arm.moves) <= np.radians(30) + 1e-9
    assert max(acceleration for *_, acceleration in lab.arm.moves) <= np.radians(40) + 1e-9
    lab.arm.moves.clear()
    lab.operator.asked.clear()
    lab.calibrate(fast=True)
    assert max(speed for _, speed, _ in lab.arm.moves) > np.radians(31)
    assert all(question.assumed is not None for question in lab.operator.asked)
    lab.arm.moves.clear()
    lab.calibrate()
    assert max(speed for _, speed, _ in lab.arm.moves) <= np.radians(30) + 1e-9


def test_a_plan_for_any_speed_is_driven_at_no_more_than_is_allowed(lab: Lab) -> None:
    certifier = certifier_for(lab.cell, "UR5e")
    speeds = Speeds(float(np.radians(180)), float(np.radians(80)), None)
    path = lab.folder / "plan.json"
    plan_tour(certifier, USUAL_POSTURE_RAD, 6, speeds=speeds, guess=guess_of(certifier)).save(path)
    lab.calibrate(plan=path)
    assert has_completed("A1", str(Plan.load(path).to_dict()["sha256"]))
    lab.arm.moves.clear()
    lab.calibrate(plan=path, fast=True)
    fastest = 0.0
    for (start, *_), (goal, speed, _) in pairwise(lab.arm.moves):
        assert speed <= np.radians(60) + 1e-9
        way = start + np.linspace(0, 1, 200)[:, None] * (goal - start)
        path_m = np.linalg.norm(np.diff(tips(MODEL, way), axis=0), axis=2).max() * 199
        fastest = max(fastest, path_m * speed / np.abs(goal - start).max())
    assert fastest == pytest.approx(0.25, rel=0.01)
    lab.cell = replace(lab.cell, robot=replace(lab.cell.robot, speed_deg_s=20.0, acceleration_deg_s2=30.0))
    lab.arm.moves.clear()
    lab.calibrate(plan=path, fast=True)
    assert max(speed for _, speed, _ in lab.arm.moves[1:]) <= np.radians(20) + 1e-9
    assert max(acceleration for *_, acceleration in lab.arm.moves[1:]) <= np.radians(30) + 1e-9


def test_how_long_to_average_is_chosen_from_the_noise_of_the_sensor(lab: Lab) -> None:
    lab.cell = replace(lab.cell, sampling=Sampling())
    lab.calibrate()
    assert {pose.average_s for pose in lab.operator.of(PoseTaken)} == {1.0}
    lab.operator.told.clear()
    lab.sensor.noise = np.repeat([0.8, 0.001], 3)  # of 100 samples a second: 2 s give 0.057 N
    lab.calibrate()
    (average_s,) = {pose.average_s for pose in lab.operator.of(PoseTaken)}
    assert 1.5 <= average_s <= 4.0
    assert f"average {average_s:.1f} s at each pose" in " ".join(note.words for note in lab.operator.of(Noted))


@pytest.mark.parametrize("sampling", [Sampling(), Sampling(average_s=0.3, noise_record_s=0.0)])
def test_what_is_predicted_before_it_moves_comes_true(sampling: Sampling, lab: Lab) -> None:
    lab.cell = replace(lab.cell, sampling=sampling, tool=replace(lab.cell.tool, mass_kg=1.2))
    outcome = lab.calibrate()
    assert outcome is not None
    (words,) = [
        note.words for note in lab.operator.of(Noted) if "predicted from that for 1.2 kg, one sigma" in note.words
    ]
    told_g = float(words.split("mass ")[1].split(" g")[0])
    assert told_g == pytest.approx(1e3 * float(outcome.result.sigma["mass_kg"]), rel=0.7)


def test_the_first_limit_of_contact_names_the_mass_it_assumes(lab: Lab) -> None:
    lab.cell = replace(lab.cell, tool=replace(lab.cell.tool, mass_kg=1.2))
    lab.arm.at_move[4] = lambda: setattr(lab.sensor, "push", np.array([60.0, 0, 0, 0, 0, 0]))
    with pytest.raises(DeviceFault, match=r"a tool of 1.2 kg is assumed \(\[tool\] mass_kg\)"):
        lab.calibrate()


def test_a_run_that_was_ended_does_not_count_as_complete(lab: Lab) -> None:
    lab.operator.answers["Begin"] = ["no"]
    with pytest.raises(Declined):
        lab.calibrate()
    plan = Plan.load(lab.run().plan_path)
    assert not has_completed("A1", str(plan.to_dict()["sha256"]))
    assert len(lab.arm.moves) == 1


def test_only_a_run_with_every_pose_counts_as_complete(lab: Lab) -> None:
    lab.operator.answers["Pose 3 of 7"] = ["s"]
    lab.operator.answers["Pose 7 of 7"] = ["s"]
    lab.calibrate(mode="step")
    run = lab.run()
    key = "A1", str(Plan.load(run.plan_path).to_dict()["sha256"])
    assert not has_completed(*key)
    lab.operator.answers["Pose 7 of 7"] = ["s"]
    lab.calibrate(resume=run.folder, mode="step", fast=True)
    assert lab.stops() == [1, 2, 3, 4, 5, 6]
    assert not has_completed(*key)
    lab.calibrate(resume=run.folder)
    assert has_completed(*key)


def test_a_run_in_which_nothing_moved_does_not_count_as_complete(lab: Lab) -> None:
    lab.operator.answers["Pose "] = ["s"] * 6
    with pytest.raises(Declined, match="ended before the first pose"):
        lab.calibrate(mode="step")
    assert lab.arm.moves == []
    assert not has_completed("A1", str(Plan.load(lab.run().plan_path).to_dict()["sha256"]))


def test_a_dry_run_shows_all_and_moves_nothing(lab: Lab) -> None:
    assert lab.calibrate(dry_run=True) is None
    assert lab.arm.moves == []
    assert lab.operator.asked == []
    assert not (lab.folder / "runs").exists()
    assert len(lab.operator.of(Checked)) == len(preflight.CHECKS)


def test_the_plan_is_shown_before_the_checks_and_kept_where_asked(lab: Lab) -> None:
    lab.cell = replace(lab.cell, workcell=WorkcellConfig(measured=False))
    path = lab.folder / "plan.json"
    with pytest.raises(NotAccepted):
        lab.calibrate(dry_run=True, output=path)
    (shown,) = lab.operator.of(Planned)
    assert lab.operator.told.index(shown) < lab.operator.told.index(lab.operator.of(Checked)[0])
    words = in_words(shown)
    for figure in ("wrist 3", "Nearest", "ball of 0.3", "Predicted", "1 move (wrist 1 ", "proven clear by"):
        assert figure in words
    assert "whole arm" not in words
    told = json.loads(json.dumps(shown.to_dict(), allow_nan=False))
    assert told["event"] == "planned"
    assert told["plan"] == json.loads(path.read_text())
    np.testing.assert_allclose(told["way_rad"], [lab.arm.q, told["plan"]["steps"][0]["q_rad"]])
    assert not Plan.load(path).measured
    lab.cell = replace(lab.cell, workcell=WorkcellConfig(measured=True))
    with pytest.raises(FileExistsError):
        lab.calibrate(dry_run=True, output=path)
    assert lab.calibrate(dry_run=True, output=lab.folder / "measured.json") is None
    assert Plan.load(lab.folder / "measured.json").measured


def test_a_way_that_moves_the_whole_arm_asks_for_its_room(lab: Lab) -> None:
    path = lab.folder / "plan.json"
    lab.calibrate(dry_run=True, output=path)
    lab.arm.q = lab.arm.q + np.radians([20.0, 0, 0, 0, 0, 0])
    lab.calibrate(plan=path)
    texts = [question.text for question in lab.operator.asked]
    assert all(
        any(word in text and "base 20°" in text and "whole arm" in text for text in texts)
        for word in ("Is the ball of", "Type MOVE")
    )


@pytest.mark.parametrize(("away_deg", "assumed"), [((0.0, 0.0), True), ((0.0, 9.0), True), ((9.0, 0.0), False)])
def test_a_way_of_the_whole_arm_is_confirmed_by_a_person_though_the_plan_is_known(
    away_deg: tuple[float, float], assumed: bool, lab: Lab
) -> None:
    lab.calibrate()
    plan = lab.run().plan_path
    lab.operator.asked.clear()
    elbow, wrist = away_deg
    lab.arm.q = lab.arm.q + np.radians([0, 0, elbow, 0, 0, wrist])
    lab.calibrate(plan=plan, fast=True)
    texts = {question.text: question.assumed is not None for question in lab.operator.asked}
    assert [texts[text] for text in texts if text.startswith("Is the")] == [assumed] * 3
    (way,) = [texts[text] for text in texts if "Type MOVE" in text]
    assert way == assumed


def test_a_run_that_goes_on_from_elsewhere_is_confirmed_by_a_person(lab: Lab) -> None:
    lab.calibrate()  # trusted from here on
    for joint, assumed in ((5, True), (0, False)):
        lab.operator.asked.clear()
        lab.operator.told.clear()
        lab.arm.moves.clear()
        lab.arm.at_move[4] = lambda: lab.operator.keys.append(Key.STOP)
        with pytest.raises(Declined):
            lab.calibrate()
        lab.arm.q = lab.arm.q + np.radians(9.0) * (np.arange(6) == joint)
        lab.operator.asked.clear()
        lab.calibrate(resume=Path(lab.operator.of(RunOpened)[-1].folder))
        assert [question.assumed is not None for question in lab.operator.asked] == [assumed] * 4


def test_the_browser_is_waited_for(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[str] = []

    @contextmanager
    def shown(plan: Plan, certifier: Certifier, way_rad: Array) -> Iterator[str]:
        assert len(plan.steps) == 6
        assert certifier.arm.name == "UR5e"
        assert len(way_rad) == 2
        served.append("open")
        yield "http://here"
        served.append("closed")

    monkeypatch.setattr(view, "shown", shown)
    monkeypatch.setattr(view, "open_in_browser", served.append)
    lab.operator.answers["http://here"] = ["yes", "no"]
    assert lab.calibrate(dry_run=True, view=True) is None
    assert served == ["open", "http://here", "closed"]
    assert [question.assumed for question in lab.operator.asked] == [None]
    with pytest.raises(Declined):
        lab.calibrate(view=True)
    assert lab.arm.moves == []


def test_step_mode_waits_for_enter_before_each_move(lab: Lab) -> None:
    lab.operator.answers["Pose 3 of 7"] = ["s"]
    lab.operator.answers["Pose 5 of 7"] = ["r", ""]
    lab.calibrate(mode="step")
    third = np.array(Plan.load(lab.run().plan_path).steps[2].q_rad)
    assert min(np.abs(goal - third).max() for goal, *_ in lab.arm.moves) > np.radians(5)  # never sent there
    (way,) = [question for question in lab.operator.asked if "the way to pose 4" in question.text]
    assert way.text.startswith("The arm goes")  # certified anew, shown, and confirmed
    assert lab.arm.moves[2][1] <= np.radians(15) + 1e-9
    asked = [question.text.split(",")[0] for question in lab.operator.asked if question.text.startswith("Pose")]
    assert asked == [f"Pose {stop} of 7" for stop in (1, 2, 3, 4, 5, 4, 5, 6, 7)]
    assert lab.stops() == [1, 2, 4, 5, 6, 7]
    assert (lab.run().folder / "poses" / "04-2.npz").exists()


def test_a_first_pose_that_is_skipped_is_not_returned_to(lab: Lab) -> None:
    lab.operator.answers["Pose 1 of 7"] = ["s"]
    lab.calibrate(mode="step")
    assert lab.stops() == [2, 3, 4, 5, 6]
    first = np.array(Plan.load(lab.run().plan_path).steps[0].q_rad)
    assert min(np.abs(goal - first).max() for goal, *_ in lab.arm.moves) > np.radians(5)
    assert "skipped: pose 1 and 7" in said(lab)


def test_step_mode_says_what_enter_does(lab: Lab) -> None:
    lab.operator.answers["Pose 3 of 7"] = ["r", ""]
    lab.calibrate(mode="step")
    steps = Plan.load(lab.run().plan_path).steps
    asked = [question.text for question in lab.operator.asked if question.text.startswith("Pose")]
    assert "Enter plans the way and shows it" in asked[0]
    for text, start, goal in ((asked[1], 0, 1), (asked[4], 1, 2), (asked[5], 2, 3)):
        turn_deg = np.degrees(np.abs(np.subtract(steps[goal].q_rad, steps[start].q_rad)))
        joints = ", ".join(str(joint + 1) for joint in np.flatnonzero(turn_deg > 0.5))
        assert f"joint{'s' if ',' in joints else ''} {joints}, largest turn {turn_deg.max():.0f}°" in text
        assert "at 30°/s" in text  # slow, as in any first run
    assert "the arm stands there, Enter measures" in asked[3]  # pose 2 again, where the arm is
    assert "moves" not in asked[3]


# ------------------------------------------------------------------------------------------ what is checked before


def said(lab: Lab) -> str:
    return "\n".join(event.words for event in lab.operator.of(Noted))


def refuse(lab: Lab, words: str) -> None:
    with pytest.raises(NotAccepted, match=words):
        lab.calibrate()
    assert lab.arm.moves == []
    assert lab.operator.asked == []


def test_a_workcell_nobody_measured_is_refused(lab: Lab) -> None:
    lab.cell = replace(lab.cell, workcell=WorkcellConfig())
    refuse(lab, "measured = true")


@pytest.mark.parametrize(
    ("different", "words"),
    [
        ({"fault": "protective stop: clear it", "safety_mode": "protective stop"}, "protective stop"),
        ({"payload_kg": 0.0}, "nothing hangs"),
        (
            {"p_flange_payload_m": (0.0, 0.0, -0.15)},
            r"centre at \(0, 0, -150\) mm from the flange, where the tool is not",
        ),
        ({"p_flange_payload_m": (0.3, 0.0, 0.05)}, r"centre at \(300, 0, 50\) mm"),
    ],
)
def test_a_controller_that_is_not_ready_is_refused(different: dict[str, Any], words: str, lab: Lab) -> None:
    lab.arm.set_status(**different)
    refuse(lab, words)


def test_a_tour_that_would_wind_up_the_cable_is_refused(lab: Lab, tmp_path: Path) -> None:
    lab.arm.q[5] = np.radians(-90)
    made_there = tmp_path / "there.json"
    assert lab.calibrate(dry_run=True, output=made_there) is None
    assert "wrist 3 stands at -90°" in next(e.words for e in lab.operator.of(Checked) if e.name == "cable")
    lab.arm.q[5] = np.radians(160)
    lab.operator.told.clear()
    refuse_plan = pytest.raises(NotAccepted, match=r"wrist 3 stands at 160°.*jog it to between -?\d+° and -?\d+°")
    with refuse_plan:
        lab.calibrate(plan=made_there)
    assert lab.arm.moves == []


def test_a_payload_that_is_not_that_of_the_tool_is_refused(lab: Lab) -> None:
    lab.cell = replace(lab.cell, tool=replace(lab.cell.tool, mass_kg=3.0))
    refuse(lab, "1.50 kg, sensor and tool are 3.00 kg")


def test_a_pose_the_controller_forbids_is_refused(lab: Lab) -> None:
    assert lab.calibrate(dry_run=True) is None
    lab.arm.forbidden = lab.arm.q.round(12)
    lab.arm.within_safety_limits = lambda q_rad: q_rad[4] < 2.0  # type: ignore[method-assign]  # this arm only
    refuse(lab, "safety limits forbid")


def test_another_model_or_tcp_is_refused(lab: Lab) -> None:
    right = lab.arm.state

    def elsewhere() -> ArmState:
        state = right()
        return replace(state, p_base_flange_m=np.add(state.p_base_flange_m, [0, 0, 0.02]))

    lab.arm.state = elsewhere  # type: ignore[method-assign]  # this arm only
    refuse(lab, "check the model and the active TCP")


def test_a_stuck_sensor_is_refused(lab: Lab) -> None:
    lab.sensor.stuck = True
    refuse(lab, "did not change")


def test_a_sensor_that_stumbles_once_is_opened_again(lab: Lab) -> None:
    def stumble() -> None:
        lab.sensor.collecting = lambda: None
        raise StreamBroken("a write took too long")

    lab.sensor.collecting = stumble
    assert lab.calibrate(dry_run=True) is None
    assert "trying once more" in " ".join(event.words for event in lab.operator.of(Noted))
    lab.sensor.failure = StreamBroken("gone for good")
    with pytest.raises(StreamBroken):
        lab.calibrate(dry_run=True)


def test_a_folder_that_cannot_be_written_is_refused(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(preflight, "TemporaryFile", full)
    refuse(lab, "No space left")


def test_a_plan_for_another_tool_is_refused(lab: Lab) -> None:
    lab.calibrate()
    plan = lab.run().plan_path
    lab.arm.moves.clear()
    lab.operator.asked.clear()
    lab.cell = replace(lab.cell, tool=ToolConfig(cylinders_mm=((0.0, 210.0, 100.0),)))
    with pytest.raises(NotAccepted, match="another tool"):
        lab.calibrate(plan=plan)
    assert lab.arm.moves == []


# ----------------------------------------------------------------------------------------------------- what stops it

FAULTS: dict[str, tuple[int, Callable[[Lab], None], Callable[[Lab], None], type[Exception]]] = {
    "a joint pushed off": (
        2,
        lambda lab: setattr(lab.arm, "push_rad", np.radians([0, 1.0, 0, 0, 0, 0])),
        lambda lab: setattr(lab.arm, "push_rad", np.zeros(6)),
        DeviceFault,
    ),
    "the TCP changed": (
        8,
        lambda lab: lab.arm.set_status(tcp_offset=(0.0, 0.0, 0.0, 0.3, 0.0, 0.0)),
        lambda lab: lab.arm.set_status(),
        DeviceFault,
    ),
    "a protective stop": (
        10,
        lambda lab: lab.arm.set_status(fault="protective stop: …", safety_mode="protective stop"),
        lambda lab: lab.arm.set_status(),
        DeviceFault,
    ),
    "an emergency stop": (
        11,
        lambda lab: lab.arm.set_status(fault="emergency stop: …", safety_mode="robot emergency stop"),
        lambda lab: lab.arm.set_status(),
        DeviceFault,
    ),
    "an emergency stop between two looks": (
        11,
        lambda lab: lab.arm.lose_power(),
        lambda lab: lab.arm.power_up(),
        DeviceFault,
    ),
    "reduced mode": (
        12,
        lambda lab: lab.arm.set_status(safety_mode="reduced"),
        lambda lab: lab.arm.set_status(),
        DeviceFault,
    ),
    "a push before the tool is known": (
        14,
        lambda lab: setattr(lab.sensor, "push", np.array([150.0, 0, 0, 0, 0, 0])),
        lambda lab: setattr(lab.sensor, "push", np.zeros(6)),
        DeviceFault,
    ),
    "a silent sensor": (
        15,
        lambda lab: setattr(lab.sensor, "failure", StreamBroken("gone")),
        lambda lab: setattr(lab.sensor, "failure", None),
        StreamBroken,
    ),
    "a stuck sensor": (
        15,
        lambda lab: setattr(lab.sensor, "stuck", True),
        lambda lab: setattr(lab.sensor, "stuck", False),
        DeviceFault,
    ),
    "a silent controller": (
        16,
        lambda lab: setattr(lab.arm, "gone", DeviceTimeout("silent")),
        lambda lab: setattr(lab.arm, "gone", None),
        DeviceTimeout,
    ),
    "somebody else's program": (
        21,
        lambda lab: lab.arm.set_status(program="stopped"),
        lambda lab: lab.arm.set_status(),
        DeviceFault,
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_on_the_way_stops_the_arm_and_resume_goes_on(fault: str, lab: Lab) -> None:
    hazard, inject, mend, _ = FAULTS[fault]
    lab.arm.at_move[4] = lambda: inject(lab)

    def on_event(event: Event) -> None:
        if isinstance(event, StateChanged) and event.state is State.HOLD:
            assert lab.arm.halted.is_set()
            assert lab.stops() == [1, 2, 3]
            mend(lab)

    lab.operator.on_event = on_event
    lab.operator.answers["Type resume"] = ["resume"]
    outcome = lab.calibrate()
    assert outcome is not None
    (trip,) = lab.operator.of(GuardTripped)
    assert trip.hazard == hazard
    assert lab.arm.opened == 2
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]
    states = lab.operator.states()
    stop = states.index(State.STOP)
    assert states[stop : stop + 3] == [State.STOP, State.HOLD, State.APPROACH]
    assert outcome.result.mass_kg == pytest.approx(1.2, abs=0.01)
    # The way on was asked for, planned from where the arm stood, and slow.
    assert any("the way to pose 4" in question.text for question in lab.operator.asked)
    assert lab.arm.moves[4][1] <= np.radians(15) + 1e-9


def test_a_protective_stop_that_the_driver_tells_names_its_usual_causes_too(lab: Lab) -> None:
    def stop() -> None:
        lab.arm.set_status(fault="protective stop: …", safety_mode="protective stop")
        raise DeviceFault("the arm stopped: protective stop")

    lab.arm.at_move[4] = stop
    with pytest.raises(DeviceFault, match="wrong payload or centre of mass"):
        lab.calibrate()
    assert lab.operator.of(GuardTripped)[0].hazard == 10


def test_a_stop_that_nobody_answers_is_told_while_it_goes_on(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    told, told_meanwhile, stop = threading.Event(), list[bool](), lab.arm.stop

    def unanswered() -> None:
        if lab.arm.gone:
            told_meanwhile.append(told.wait(5.0))
        stop()

    def on_event(event: Event) -> None:
        if isinstance(event, GuardTripped):
            told.set()

    monkeypatch.setattr(lab.arm, "stop", unanswered)
    lab.operator.on_event = on_event
    lab.arm.at_move[4] = lambda: setattr(lab.arm, "gone", DeviceTimeout("silent"))
    with pytest.raises(DeviceTimeout):
        lab.calibrate()
    assert told_meanwhile
    assert all(told_meanwhile)
    holds = [event for event in lab.operator.of(StateChanged) if event.state is State.HOLD]
    assert "it ends the one move it was given" in holds[0].words


@pytest.mark.parametrize("fault", FAULTS)
def test_with_nobody_there_the_reason_is_raised_and_the_poses_are_kept(fault: str, lab: Lab) -> None:
    hazard, inject, _, error = FAULTS[fault]
    lab.arm.at_move[4] = lambda: inject(lab)
    with pytest.raises(error):
        lab.calibrate()
    assert lab.stops() == [1, 2, 3]
    assert lab.operator.of(GuardTripped)[0].hazard == hazard
    assert f"--resume {lab.run().folder}" in lab.operator.of(Noted)[-1].words


def test_a_push_once_the_tool_is_known(lab: Lab) -> None:
    def push() -> None:
        lab.sensor.push = np.array([0, 0, 0, 0, 2.0, 0])

    lab.arm.at_move[7] = push
    lab.operator.answers["Type resume"] = ["quit"]
    with pytest.raises(DeviceFault, match="unexpected contact"):
        lab.calibrate()
    assert lab.operator.of(GuardTripped)[0].hazard == 14


def test_resume_before_the_cause_is_mended_is_not_believed(lab: Lab) -> None:
    lab.arm.at_move[3] = lambda: lab.arm.set_status(fault="protective stop: …", safety_mode="protective stop")
    lab.operator.answers["Type resume"] = ["resume", "resume", "quit"]
    with pytest.raises(DeviceFault, match="protective stop"):
        lab.calibrate()
    assert len([event for event in lab.operator.of(Noted) if event.words.startswith("not yet")]) == 2
    assert len(lab.arm.moves) == 3


def push_on_the_way(lab: Lab, *moves: int) -> None:
    """Let something be in the way of these moves, and be gone when a person is asked."""

    def push() -> None:
        lab.sensor.push = np.array([150.0, 0, 0, 0, 0, 0])

    def on_event(event: Event) -> None:
        if isinstance(event, StateChanged) and event.state is State.HOLD:
            lab.sensor.push = np.zeros(6)

    lab.arm.at_move |= dict.fromkeys(moves, push)
    lab.operator.on_event = on_event


def holds(lab: Lab) -> list[tuple[str, ...]]:
    return [question.answers for question in lab.operator.asked if "resume" in question.answers]


def goals(lab: Lab) -> list[int]:
    """Poses that the arm was sent to, by their place in the plan."""
    nodes = np.array([step.q_rad for step in Plan.load(lab.run().plan_path).steps])
    return [int(np.abs(nodes - goal).max(axis=1).argmin()) + 1 for goal, *_ in lab.arm.moves]


def test_after_a_contact_the_arm_goes_back_or_round_it_where_a_person_says_so(lab: Lab) -> None:
    push_on_the_way(lab, 4, 5, 7)  # to pose 4, back to pose 3, to pose 4 again
    lab.operator.answers["Type resume"] = ["back", "back", "resume", "skip"]
    lab.calibrate()
    anywhere = ("resume", "skip", "back", "quit")
    assert holds(lab) == [anywhere, anywhere, ("resume", "skip", "quit"), anywhere]
    assert [event.hazard for event in lab.operator.of(GuardTripped)] == [14, 14, 14]
    assert goals(lab) == [1, 2, 3, 4, 3, 3, 4, 5, 6, 1]
    assert max(speed for _, speed, _ in lab.arm.moves[4:6]) <= np.radians(10) + 1e-9
    ways = [question.text for question in lab.operator.asked if question.text.startswith("The arm goes the way")]
    assert [text.split(" at ")[0].split("way ")[1] for text in ways] == [
        "to pose 1",
        "back to pose 3",
        "back to pose 3",
        "to pose 4",
        "to pose 5",
    ]
    reasons = [event.words for event in lab.operator.of(StateChanged) if event.state is State.HOLD]
    assert reasons[2].startswith("back at pose 3; what stopped the arm: unexpected contact")
    assert taken(lab) == [1, 2, 3, 5, 6, 7]
    assert "skipped: pose 4, the arm goes on to pose 5" in said(lab)


def test_the_way_back_is_confirmed_by_a_person_though_the_plan_is_known(lab: Lab) -> None:
    lab.calibrate()  # trusted from here on
    for answer, words in (("resume", "the way to pose 4"), ("back", "the way back to pose 3")):
        lab.operator.asked.clear()
        lab.arm.moves.clear()
        push_on_the_way(lab, 3)
        lab.operator.answers["Type resume"] = [answer, "quit"]
        lab.operator.answers["the way back"] = ["no"]
        with suppress(Declined):
            lab.calibrate()
        (way,) = [question for question in lab.operator.asked if words in question.text]
        assert (way.assumed is None) == (answer == "back")
    assert len(lab.arm.moves) == 3


def test_back_is_offered_only_on_the_way_from_a_pose_that_was_not_skipped(lab: Lab) -> None:
    press(lab, (Key.PAUSE, StateChanged, 1), (Key.PAUSE, PoseTaken, 2))  # on the first approach; where the arm stands
    lab.operator.answers["Type resume"] = ["resume"] * 3

    def skip_then_pause() -> None:
        if len(lab.arm.moves) == 5 and not done:
            done.append(True)
            lab.operator.keys.append(Key.SKIP)
            lab.arm.at_move[6] = lambda: lab.operator.keys.append(Key.PAUSE)

    done: list[bool] = []
    lab.sensor.collecting = skip_then_pause
    lab.calibrate()
    assert holds(lab) == [("resume", "skip", "quit")] * 3


def test_a_pause_with_nobody_to_end_it_is_no_fault(lab: Lab) -> None:
    lab.arm.at_move[3] = lambda: lab.operator.keys.append(Key.PAUSE)
    with pytest.raises(Declined, match="paused by a person"):
        lab.calibrate()


def test_resume_with_something_still_pushing_is_not_believed_though_nobody_knows_the_tool(lab: Lab) -> None:
    lab.arm.at_move[3] = lambda: setattr(lab.sensor, "push", np.array([150.0, 0, 0, 0, 0, 0]))
    lab.operator.answers["Type resume"] = ["resume", "quit"]
    with pytest.raises(DeviceFault, match="unexpected contact"):
        lab.calibrate()
    (refused,) = [event for event in lab.operator.of(Noted) if event.words.startswith("not yet")]
    assert "unexpected contact" in refused.words
    assert len(lab.arm.moves) == 3


def test_a_sensor_that_was_switched_off_may_have_another_zero(lab: Lab) -> None:
    def fail() -> None:
        lab.sensor.failure = StreamBroken("gone")

    def on_event(event: Event) -> None:
        if isinstance(event, StateChanged) and event.state is State.HOLD:
            lab.sensor.heals = True
            lab.sensor.push = np.array([150.0, 0, 0, 0, 0, 0])

    lab.arm.at_move[2] = fail
    lab.operator.on_event = on_event
    lab.operator.answers["Type resume"] = ["resume"]
    lab.calibrate()
    assert not [event for event in lab.operator.of(Noted) if event.words.startswith("not yet")]


def test_a_sensor_that_comes_back_while_the_arm_stands_needs_nobody(lab: Lab) -> None:
    def fail() -> None:
        if len(lab.arm.moves) == 3 and not lab.sensor.heals:
            lab.sensor.heals = True
            lab.sensor.failure = StreamBroken("a cable came off")
            raise lab.sensor.failure

    lab.sensor.collecting = fail
    assert lab.calibrate() is not None
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]
    assert State.HOLD not in lab.operator.states()
    assert any("begins anew" in event.words for event in lab.operator.of(Noted))


def test_a_full_disk_holds_before_the_arm_moves_on(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    commit, failed = Run.commit, list[int]()

    def full(run: Run, record: PoseRecord) -> None:
        if record.stop == 3 and not failed:
            failed.append(len(lab.arm.moves))
            raise OSError(28, "No space left on device")
        commit(run, record)

    monkeypatch.setattr(Run, "commit", full)
    lab.operator.answers["Type resume"] = ["resume"]
    lab.calibrate()
    assert lab.operator.of(GuardTripped)[0].hazard == 26
    assert failed == [3]
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


def test_an_arm_that_was_moved_between_two_poses_is_noticed(lab: Lab) -> None:
    def on_event(event: Event) -> None:
        if isinstance(event, PoseTaken) and event.stop == 2:
            lab.arm.q = lab.arm.q + np.radians([0, 0, 0, 0, 0, 2.0])

    lab.operator.on_event = on_event
    with pytest.raises(DeviceFault, match=r"somebody has moved it|something else moves it"):
        lab.calibrate()
    assert lab.operator.of(GuardTripped)[0].hazard == 21


def test_saturated_samples_discard_the_pose(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guided, "_range_of", lambda _: np.array([40.0, 40, 40, 4, 4, 4]))
    lab.arm.at_move[4] = lambda: setattr(lab.sensor, "push", np.array([0, 0, 0, 0, 0, 3.8]))
    with pytest.raises(DeviceFault, match="of its range"):
        lab.calibrate()
    assert lab.operator.of(GuardTripped)[0].hazard == 13
    assert lab.stops() == [1, 2, 3]


# ------------------------------------------------------------------------------------------------- keys, resume, redo


def test_pause_holds_the_arm_on_its_way_and_goes_on_or_ends(lab: Lab) -> None:
    lab.arm.at_move[3] = lambda: lab.operator.keys.append(Key.PAUSE)
    lab.operator.answers["Type resume to go on"] = ["resume"]
    lab.calibrate()
    assert lab.operator.states().count(State.HOLD) == 1
    assert lab.operator.of(GuardTripped) == []
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]
    lab.arm.moves.clear()
    lab.arm.at_move[3] = lambda: lab.operator.keys.append(Key.PAUSE)
    lab.operator.answers["Type resume to go on"] = ["quit"]
    with pytest.raises(Declined, match="paused by a person"):
        lab.calibrate()


def test_stop_ends_the_session_without_a_question_and_says_how_to_go_on(lab: Lab) -> None:
    lab.arm.at_move[3] = lambda: lab.operator.keys.append(Key.STOP)
    with pytest.raises(Declined, match="stopped by a person"):
        lab.calibrate()
    assert lab.arm.halted.is_set()
    assert State.HOLD not in lab.operator.states()
    assert "resume" not in lab.operator.asked[-1].text
    assert lab.stops() == [1, 2]
    assert f"--resume {lab.run().folder}" in lab.operator.of(Noted)[-1].words


def press(lab: Lab, *presses: tuple[Key, type[Event], int]) -> None:
    """Press each key once, when an event of its kind is told of its stop."""
    left = list(presses)

    def on_event(event: Event) -> None:
        for one in left:
            key, kind, stop = one
            if isinstance(event, kind) and getattr(event, "stop", None) == stop:
                left.remove(one)
                lab.operator.keys.append(key)
                return

    lab.operator.on_event = on_event


def taken(lab: Lab) -> list[int]:
    return [event.stop for event in lab.operator.of(PoseTaken)]


def test_skip_on_the_way_stops_the_arm_and_goes_round_that_pose(lab: Lab) -> None:
    lab.arm.at_move[4] = lambda: lab.operator.keys.append(Key.SKIP)
    lab.calibrate()
    assert taken(lab) == [1, 2, 3, 5, 6, 7]
    assert lab.arm.stops == 1
    fourth = np.array(Plan.load(lab.run().plan_path).steps[3].q_rad)
    assert [np.abs(goal - fourth).max() < 1e-9 for goal, *_ in lab.arm.moves].count(True) == 1  # the one broken off
    assert [question for question in lab.operator.asked if "the way to pose 5" in question.text]
    assert lab.arm.moves[4][1] <= np.radians(15) + 1e-9
    assert State.HOLD not in lab.operator.states()
    assert "skipped: pose 4, the arm goes on to pose 5" in said(lab)


def test_skip_while_a_pose_is_measured_skips_that_one(lab: Lab) -> None:
    def skip() -> None:
        if len(lab.arm.moves) == 4 and not skipped:
            skipped.append(True)
            lab.operator.keys.append(Key.SKIP)

    skipped: list[bool] = []
    lab.sensor.collecting = skip
    lab.calibrate()
    assert taken(lab) == [1, 2, 3, 5, 6, 7]
    assert not [question for question in lab.operator.asked if "the way to pose 5" in question.text]
    assert len(lab.arm.moves) == 7


def test_skip_with_no_pose_under_way_skips_none(lab: Lab) -> None:
    press(lab, (Key.SKIP, PoseTaken, 4), (Key.KEEP, StateChanged, 5))
    lab.calibrate()
    assert taken(lab) == [1, 2, 3, 4, 5, 6, 7]
    assert "none is under way" in said(lab)


def test_keep_has_nothing_to_do_in_a_tour_and_says_so(lab: Lab) -> None:
    press(lab, (Key.KEEP, PoseTaken, 3))
    lab.calibrate()
    assert taken(lab) == [1, 2, 3, 4, 5, 6, 7]
    assert said(lab).count("a pose is kept by itself; r takes it again") == 1


def test_redo_takes_the_pose_that_was_shown_when_it_was_pressed(lab: Lab) -> None:
    def redo() -> None:
        if len(lab.arm.moves) == 8 and not again:
            again.append(True)
            lab.operator.keys.append(Key.REDO)

    again: list[bool] = []
    lab.sensor.collecting = redo  # while pose 6 is measured: pose 5 is the last that was shown
    press(lab, (Key.REDO, PoseTaken, 1), (Key.REDO, StateChanged, 4))  # while the arm stands, and on its way
    lab.calibrate()
    assert taken(lab) == [1, 1, 2, 3, 3, 4, 5, 5, 6, 7]
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]
    assert "the arm ends its move, then goes back to pose 3" in said(lab)
    ways = [question.text for question in lab.operator.asked if "the way to pose" in question.text]
    assert len(ways) == 1  # the first approach: back and forth it goes along the plan's own moves


def test_redo_before_any_pose_or_twice_does_nothing_more(lab: Lab) -> None:
    def twice(event: Event) -> None:
        if isinstance(event, StateChanged) and event.state is State.APPROACH:
            lab.operator.keys.append(Key.REDO)
        if isinstance(event, PoseTaken) and taken(lab) == [1, 2]:
            lab.operator.keys.extend([Key.REDO, Key.REDO])

    lab.operator.on_event = twice
    lab.calibrate()
    assert taken(lab) == [1, 2, 2, 3, 4, 5, 6, 7]
    assert "no pose yet" in said(lab)
    assert "pose 2 is being taken again already" in said(lab)


def test_a_pose_that_was_to_be_taken_again_and_is_skipped_stays(lab: Lab) -> None:
    def skip() -> None:
        if len(lab.arm.moves) == 3 and len(taken(lab)) == 3 and not skipped:
            skipped.append(True)
            lab.operator.keys.append(Key.SKIP)

    skipped: list[bool] = []
    lab.sensor.collecting = skip
    press(lab, (Key.REDO, PoseTaken, 3))
    outcome = lab.calibrate()
    assert taken(lab) == [1, 2, 3, 4, 5, 6, 7]
    assert "pose 3 stays as it was taken" in said(lab)
    assert outcome is not None
    assert outcome.result.n_poses == 6
    assert [event.poses for event in lab.operator.of(Estimated)][:5] == [1, 2, 3, 3, 4]


def test_a_way_past_a_skipped_pose_is_told_and_confirmed_by_a_person(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.calibrate()  # trusted from here on
    lab.operator.asked.clear()
    lab.operator.answers["Pose 3 of 7"] = ["s"] * 2
    lab.calibrate(mode="step")
    monkeypatch.setattr(machine, "_NEAR_RAD", np.pi)
    lab.calibrate(mode="step")
    ways = [question for question in lab.operator.asked if "the way to pose 4" in question.text]
    assert ["skipped pose 3" in question.text for question in ways] == [False, True]
    assert [question.assumed for question in ways] == ["yes", None]


def test_what_would_help_most_is_not_told_where_the_plan_chooses(lab: Lab) -> None:
    lab.calibrate()
    assert {event.hint for event in lab.operator.of(Estimated)} == {""}


def test_a_hold_tells_the_reason_and_leaves_the_path_to_the_screen(lab: Lab) -> None:
    lab.arm.at_move[4] = lambda: lab.arm.set_status(fault="protective stop: …", safety_mode="protective stop")
    lab.operator.answers["Type resume when it is mended"] = ["quit"]
    with pytest.raises(DeviceFault):
        lab.calibrate()
    (hold,) = [event for event in lab.operator.of(StateChanged) if event.state is State.HOLD]
    assert str(lab.folder) not in hold.words + lab.operator.asked[-1].text
    assert "protective stop" in hold.words
    assert "3 poses are kept" in lab.operator.asked[-1].text


def test_resume_takes_what_is_missing_and_redo_takes_one_again(lab: Lab) -> None:
    lab.arm.at_move[4] = lambda: lab.operator.keys.append(Key.STOP)
    with pytest.raises(Declined):
        lab.calibrate()
    run = lab.run()
    lab.operator.told.clear()
    outcome = lab.calibrate(resume=run.folder)
    assert outcome is not None
    assert outcome.run.folder == run.folder
    assert [event.stop for event in lab.operator.of(PoseTaken)] == [4, 5, 6, 7]
    assert len((run.folder / "events.ndjson").read_text().splitlines()) > len(lab.operator.told)
    first = run.calibration_path.read_bytes()
    lab.operator.told.clear()
    assert lab.calibrate(resume=run.folder, redo=(3,)) is not None
    assert [event.stop for event in lab.operator.of(PoseTaken)] == [3]
    assert run.calibration_path.name == "calibration-2.json"
    assert (run.folder / "calibration.json").read_bytes() == first


@pytest.mark.parametrize(
    ("begun", "asked", "in_steps"), [("step", "auto", True), ("auto", "step", True), ("auto", "auto", False)]
)
def test_a_run_goes_on_in_its_own_mode_or_in_steps(begun: str, asked: str, in_steps: bool, lab: Lab) -> None:
    lab.arm.at_move[4] = lambda: lab.operator.keys.append(Key.STOP)
    with pytest.raises(Declined):
        lab.calibrate(mode=begun)
    lab.operator.asked.clear()
    lab.calibrate(resume=lab.run().folder, mode=asked)
    steps = [question.text.split(",")[0] for question in lab.operator.asked if "Enter" in question.text]
    assert steps == [f"Pose {stop} of 7" for stop in (4, 5, 6, 7) if in_steps]


def test_a_resumed_run_is_open_with_its_poses_before_anything_is_checked(lab: Lab) -> None:
    lab.arm.at_move[4] = lambda: lab.operator.keys.append(Key.STOP)
    lab.operator.answers["Type resume"] = ["quit"]
    with pytest.raises(Declined):
        lab.calibrate()
    run = lab.run()
    lab.operator.told.clear()
    assert lab.calibrate(resume=run.folder, dry_run=True) is None
    kinds = [type(event) for event in lab.operator.told]
    assert kinds.count(RunOpened) == 1
    assert kinds.index(RunOpened) < kinds.index(Checked)
    before = lab.operator.told[: kinds.index(Checked)]
    assert [event.poses for event in before if isinstance(event, Estimated)] == [1, 2, 3]


def test_a_run_is_not_gone_on_with_another_tool(lab: Lab) -> None:
    lab.arm.at_move[3] = lambda: lab.operator.keys.append(Key.STOP)
    lab.operator.answers["Type resume"] = ["quit"]
    with pytest.raises(Declined):
        lab.calibrate()
    lab.arm.moves.clear()
    lab.cell = replace(lab.cell, tool=ToolConfig(cylinders_mm=((0.0, 210.0, 100.0),)))
    for options in ({}, {"redo": (1,)}):
        with pytest.raises(NotAccepted, match="another tool"):
            lab.calibrate(resume=lab.run().folder, **options)
    assert lab.arm.moves == []


# ----------------------------------------------------------------------------------------------------------- by hand


@pytest.mark.parametrize("mode", ["manual", "listen"])
def test_a_run_by_hand_goes_on_by_hand(mode: str, lab: Lab) -> None:
    lab.operator.keys = [Key.STOP]
    with pytest.raises(Declined, match="ended before the first pose"):
        lab.calibrate(mode=mode)
    run = lab.run()
    assert not lab.arm.control
    for asked in ("auto", mode):
        lab.operator.told.clear()
        lab.operator.keys = [Key.STOP]
        with pytest.raises(Declined, match="ended before the first pose"):
            lab.calibrate(resume=run.folder, mode=asked)
        assert len(lab.operator.of(RunOpened)) == 1
    assert not lab.arm.control
    assert (run.folder / "run.json").exists()
    with pytest.raises(ConfigError, match=f"with --{mode} and can only go on like that: leave out --step"):
        lab.calibrate(resume=run.folder, mode="step")
    with pytest.raises(ConfigError, match="leave out --redo"):
        lab.calibrate(resume=run.folder, redo=(1,))


def test_a_run_along_a_plan_does_not_go_on_by_hand(lab: Lab) -> None:
    lab.calibrate()
    with pytest.raises(ConfigError, match="along a plan"):
        lab.calibrate(resume=lab.run().folder, mode="listen")


@pytest.mark.parametrize("option", [{"dry_run": True}, {"fast": True}, {"plan": Path("plan.json")}])
def test_by_hand_nothing_is_planned_or_moved(option: dict[str, Any], lab: Lab) -> None:
    with pytest.raises(ConfigError, match="leave out --" + next(iter(option)).replace("_", "-")):
        lab.calibrate(mode="manual", **option)
    assert not (lab.folder / "runs").exists()


def test_a_run_of_another_sensor_is_not_gone_on_with(lab: Lab) -> None:
    lab.calibrate()
    lab.sensor.identify = lambda: DeviceInfo("fake", "S2", "1")  # type: ignore[method-assign]
    with pytest.raises(PlanRefused, match="S1, this is S2"):
        lab.calibrate(resume=lab.run().folder)


def test_what_the_sensor_went_through_is_written_down(lab: Lab) -> None:
    lab.sensor.events = ((17, "connected again"),)
    lab.calibrate()
    told = [event for event in lab.operator.of(Noted) if "connected again" in event.words]
    assert len(told) == 1
