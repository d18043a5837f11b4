"""A fake cell for the guided session: an arm, a sensor and an operator that do what a test says, on a fake clock."""

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from ftcalib.sampling import Sampling
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig, WorkcellConfig
from ftdrive.errors import Declined
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder, HungLoad
from ftdrive.planning.geometry.certify import Certificate, Certifier
from ftdrive.planning.geometry.kinematics import Frames
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, certifier_for, plan_for
from ftdrive.runs.load import Load
from ftdrive.runs.run import Run
from ftdrive.runs.source import Outcome
from ftdrive.session import along_plan, session
from ftdrive.session.along_plan import remember_completed
from ftdrive.session.events import Event, Key, Noted, PoseTaken, Question, State, StateChanged
from ftdrive.session.guards import Limits
from ftdrive.session.open_session import Journal, OpenCell, SessionOptions
from ftdrive.session.session import Calibrating
from ftdrive.session.watchdog import Watcher
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError, DeviceFault
from ftdrivers.follow import Follow
from ftdrivers.interfaces import ArmState, ArmStatus, DeviceInfo, ForceTorqueSensor, FtSamples, Guard, Health, RobotArm
from ftdrivers.sweep import Sweep
from tests.fake_clock import FakeClock

Array = NDArray[np.float64]

STATUS = ArmStatus(0, 0.0, "running", "normal", "playing", None, 1.0, 1.0, 1.5, (0.0, 0.0, 0.05), (0.0,) * 6)
MODEL = ArmModel("UR5e", [Cylinder(0.0, 0.2, 0.1)])
NOISE = np.repeat([0.02, 0.001], 3)


@lru_cache(maxsize=1000)
def _flange(q_rad: tuple[float, ...]) -> tuple[Array, Array]:
    at = MODEL.frames(np.array(q_rad))
    return at.R_base_flange[0], at.flange_m[0]


@lru_cache(maxsize=1000)
def _free_wrench(q_rad: tuple[float, ...]) -> Array:
    force = _flange(q_rad)[0].T @ [0, 0, -1.2 * 9.81]
    return np.add(np.r_[force, np.cross([0.01, 0, 0.06], force)], [1, 2, 3, 0.1, 0.2, 0.3])


class FakeArm(RobotArm):
    """Joints that go where they are sent, in steps; faults by `at_move`."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.answers_s = 0.008
        """How long it takes to read a state."""
        self.q = USUAL_POSTURE_RAD + np.radians([0, 0, 0, 3.0, -2, 4])
        self._status = STATUS
        self.push_rad = np.zeros(6)
        self.moves: list[tuple[Array, float, float]] = []
        self.stops = 0
        self.opened = 0
        self.control = False
        self.program = "stopped"
        """Of another client, until we take control."""
        self.remote: bool | None = True
        self.asked_limits = 0
        self.at_move: dict[int, Callable[[], object]] = {}
        self.sweeps: list[Sweep] = []
        self.at_sweep_s: dict[int, tuple[float, Callable[[], object]]] = {}
        """By the number of the sweep: when something happens in it, and what."""
        self.at_look: Callable[[], object] = lambda: None
        """Called whenever the status is read."""
        self.forbidden: Array | None = None
        self.halted = threading.Event()
        self.gone: DeviceError | None = None
        self.gone_status: dict[str, Any] = {}

    def open(self, *, control: bool = False) -> None:
        self.opened += 1
        self.control |= control
        assert not control or self.program == "stopped", "a program of another client was ended"

    def close(self) -> None:
        self.control = False

    def identify(self) -> DeviceInfo:
        return DeviceInfo("UR5e", "A1", "5.15")

    def state(self) -> ArmState:
        if self.gone:
            if self.gone_status:
                self.set_status(**self.gone_status)
            raise self.gone
        self.clock.sleep(self.answers_s)
        q = self.q + self.push_rad
        return ArmState(self.clock.now_ns(), 0.0, q, np.zeros(6), *_flange(tuple(q.tolist())))

    def status(self) -> ArmStatus:
        self.at_look()
        return self._status if self.control else replace(self._status, program=self.program)

    def in_remote_control(self) -> bool | None:
        return self.remote

    def set_status(self, **different: Any) -> None:
        self._status = replace(STATUS, **different)

    def lose_power(self) -> None:
        """An emergency stop that the joints show before the status does."""
        self.gone_status = {"fault": DeviceFault("emergency stop", "…"), "safety_mode": "robot emergency stop"}
        self.gone = DeviceFault("the joints are not measured")

    def power_up(self) -> None:
        self.gone_status, self.gone = {}, None
        self.set_status()

    def within_safety_limits(self, q_rad: Sequence[float]) -> bool:
        assert self.control
        self.asked_limits += 1
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
                raise DeviceFault("the arm was commanded to stop before it had arrived.")
            self.q = start + step / steps * (goal - start)
            if fault is not None and step == 2:
                fault()
                deadline_s = self.clock.now_s() + 20  # held here until something stops it
                while not self.halted.is_set():
                    guard()
                    assert self.clock.now_s() < deadline_s
                    self.clock.sleep(0.002)
            self.clock.sleep(0.02)

    def sweep(self, sweep: Sweep, *, guard: Guard) -> None:
        assert self.control
        assert np.allclose(self.q, sweep.centre_rad, atol=1e-3)
        self.sweeps.append(sweep)
        self.halted.clear()
        begun_s, fault_at_s = self.clock.now_s(), self.at_sweep_s.pop(len(self.sweeps), None)
        while (t_s := self.clock.now_s() - begun_s) < sweep.duration_s:
            guard()
            if self.halted.is_set():
                raise DeviceFault("the arm was commanded to stop before it had arrived.")
            if fault_at_s is not None and t_s > fault_at_s[0]:
                fault_at_s[1]()
                fault_at_s = None
            self.q = sweep.at(t_s)[0]
            self.clock.sleep(0.02)
        self.q = np.array(sweep.centre_rad)

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
        self.failure: DeviceError | None = None
        self.stuck = False
        self.heals = False
        self.warm_C: float | None = None
        self.collecting: Callable[[], object] = lambda: None
        self._newest = np.zeros(6)
        self._seq = 0

    def open(self) -> None:
        if self.heals:
            self.failure, self.stuck = None, False

    def close(self) -> None:
        pass

    def identify(self) -> DeviceInfo:
        return DeviceInfo("fake", "S1", "1")

    def temperature_C(self) -> float | None:
        return self.warm_C

    def _wrench(self) -> Array:
        if not self.stuck:
            self._newest = self._wrenches(1)[0]
        return self._newest

    def _wrenches(self, n: int) -> Array:
        return _free_wrench(tuple(self.arm.q.tolist())) + self.push + self.rng.normal(0, self.noise, (n, 6))

    def collect(self, duration_s: float) -> FtSamples:
        self.check()
        n = max(40, int(duration_s * 100))
        self.collecting()
        self.arm.clock.sleep(duration_s)
        self.check()
        rows = np.array([self._wrench()] * n) if self.stuck else self._wrenches(n)
        now = self.arm.clock.now_ns()
        self._seq += n
        return FtSamples.of(now - np.arange(n)[::-1] * 1_000_000, np.arange(n), rows)

    def follow(self) -> AbstractContextManager[Follow[FtSamples]]:
        return nullcontext(Follow(lambda _: self.collect(0.0)))

    def latest(self, *, timeout_s: float) -> FtSamples:
        assert timeout_s == 0
        self.check()
        self._seq += 1
        return FtSamples.of(self.arm.clock.now_ns(), self._seq, self._wrench()[None])

    def check(self) -> None:
        if self.failure is not None:
            raise self.failure

    def health(self) -> Health:
        return Health(self._seq, 0, 0, 1000.0, 0.001)


@dataclass
class Scripted:
    """An operator that agrees to everything, but for what a test says."""

    answers: dict[str, list[str]] = field(default_factory=dict)
    on_event: Callable[[Event], None] = lambda _: None
    at_question: list[tuple[str, Callable[[], object]]] = field(default_factory=list)
    """What happens while a question with these words waits for its answer."""
    keys: list[Key] = field(default_factory=list)
    has_keys: bool = True
    pressed_by: str = "the operator"
    shown: list[Event] = field(default_factory=list)
    asked: list[Question] = field(default_factory=list)
    gone: str | None = None
    """What was closed between the session and its operator."""

    def show(self, event: Event) -> None:
        self.shown.append(event)
        self.on_event(event)

    def ask(self, question: Question) -> str:
        for words, happen in self.at_question:
            if words in question.text:
                happen()
        self.asked.append(question)
        for word, answers in self.answers.items():
            if word in question.text and answers:
                return answers.pop(0)
        if "resume" in question.answers:
            raise Declined("unattended")
        return question.answers[0]

    def absence(self) -> str | None:
        return self.gone

    def pressed(self) -> Key | None:
        return self.keys.pop(0) if self.keys else None

    def states(self) -> list[State]:
        return [event.state for event in self.shown if isinstance(event, StateChanged)]

    def of(self, kind: type[Any]) -> list[Any]:
        return [event for event in self.shown if isinstance(event, kind)]


class SteppedWatcher(Watcher):
    """The guards without their thread: they look when the fake clock says so, in the thread of the test."""

    looking = False
    """Whether what happens now is a look of the guards."""
    ended = False
    """As if their thread had ended: set by a test, or by a `SystemExit` in a look."""
    stop_takes_s = 0.0

    def __enter__(self) -> Self:
        self._step()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()

    @property
    def _has_ended(self) -> bool:
        return self.ended

    def _step(self) -> None:
        if self.ended or self._end.is_set():
            return
        self.looking = True
        try:
            pause_s = self.turn()
        except SystemExit:
            self.ended = True
            return
        finally:
            self.looking = False
        self._fake_clock.at(max(pause_s, 0.001), self._step)

    def _begin_to_stop(self) -> threading.Event:
        stopped = threading.Event()

        def stop() -> None:
            self._arm.stop()
            stopped.set()

        if self.stop_takes_s:
            self._fake_clock.at(self.stop_takes_s, stop)
        else:
            stop()
        return stopped

    @property
    def _fake_clock(self) -> FakeClock:
        assert isinstance(self.clock, FakeClock)
        return self.clock


@lru_cache(maxsize=100)
def _planned(
    cell: CellConfig, model: str, hung: HungLoad | None, q_rad: tuple[float, ...], poses: int, sets: str | None
) -> Plan:
    certifier = certifier_for(cell, model, None, None if hung is None else hung.p_flange_m)
    return plan_for(cell, certifier, np.array(q_rad), poses, sets=sets)


def planned_once(cell: CellConfig, certifier: Certifier, q_rad: Array, poses: int, *, sets: str | None = None) -> Plan:
    """As `plan_for`, but the same question is answered from memory: planning takes most of a test's time."""
    return _planned(cell, certifier.arm.name, certifier.arm.hung, tuple(q_rad.tolist()), poses, sets)


_certify, _certificates = Certifier.certify, dict[tuple[object, ...], Certificate]()
_frames, _known_frames = ArmModel.frames, dict[tuple[str, bytes], Frames]()


def certify_once(certifier: Certifier, start_rad: ArrayLike, end_rad: ArrayLike, *, tight: bool = True) -> Certificate:
    """As `Certifier.certify`, but the same moves are proven once: a session proves its plan again before it moves."""
    moves = np.stack([start_rad, end_rad])
    arm = certifier.arm
    key = (arm.name, arm.tool, arm.hung, repr(certifier.scene), certifier.margins, moves.tobytes(), tight)
    if key not in _certificates:
        _certificates[key] = _certify(certifier, *moves, tight=tight)
    return _certificates[key]


def frames_once(arm: ArmModel, q_rad: ArrayLike) -> Frames:
    """As `ArmModel.frames`: a guard asks for those of the same postures at each look."""
    q = np.asarray(q_rad, dtype=np.float64)
    key = arm.name, q.tobytes()
    if key not in _known_frames:
        _known_frames[key] = _frames(arm, q)
    return _known_frames[key]


class Lab:
    """A fake cell and what a test wants of it."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.clock = FakeClock()
        self.arm = FakeArm(self.clock)
        self.sensor = FakeSensor(self.arm)
        self.operator = Scripted()
        self.cell = CellConfig(
            RobotConfig("fake"),
            SensorConfig("fake://"),
            ToolConfig(cylinders_mm=((0.0, 200.0, 100.0),)),
            WorkcellConfig("floor", measured=True),
            Sampling(average_s=0.1, noise_record_s=0.0),
            clock=self.clock,
        )
        self.watchers: list[SteppedWatcher] = []
        """Of each session that came to its tour."""
        monkeypatch.setattr(session, "build_arm", lambda _: self.arm)
        monkeypatch.setattr(session, "build_sensor", lambda _: self.sensor)
        monkeypatch.setattr(session, "plan_for", planned_once)
        monkeypatch.setattr(Certifier, "certify", certify_once)
        monkeypatch.setattr(ArmModel, "frames", frames_once)
        monkeypatch.setattr(along_plan, "Watcher", self._watcher)
        monkeypatch.setattr("shutil.which", lambda _: None)
        monkeypatch.setattr("os.fsync", lambda _: None)  # the disk may be slow

    def _watcher(self, *args: Any, **kwargs: Any) -> SteppedWatcher:
        self.watchers.append(SteppedWatcher(*args, **kwargs))
        return self.watchers[-1]

    @property
    def guards_look(self) -> bool:
        """Whether what happens now happens in a look of the guards."""
        return any(watcher.looking for watcher in self.watchers)

    def open_cell(self) -> OpenCell:
        return OpenCell(self.arm, self.sensor, self.clock, Journal(self.operator), Limits())

    def _options(self, **options: Any) -> SessionOptions:
        return SessionOptions(self.folder / "runs", poses=6, **options)

    def calibrate(self, load: Load | None = None, **options: Any) -> Outcome | None:
        return session.run_calibration(self.cell, self.operator, self._options(**options), load)

    def take_poses(self, load: Load | None = None, **options: Any) -> Run | None:
        """As `calibrate`, for a test that does not ask what the poses give."""
        chosen = self._options(**options)
        return session.take_poses(Calibrating(self.cell, chosen, load), self.operator, chosen)

    def trust(self) -> Path:
        """Let the plan of this cell count as completed; return its file."""
        path = self.folder / "trusted.json"
        self.take_poses(dry_run=True, output=path)
        remember_completed("A1", Plan.load(path).sha256)
        return path

    def sweep(self, **options: Any) -> Run:
        run = self.take_poses(mode="sweep", seconds=10.0, **options)
        assert run is not None
        return run

    def run(self) -> Run:
        (folder,) = (self.folder / "runs").iterdir()
        return Run(folder)

    def stops(self) -> list[int]:
        return self.run().stops()

    def said(self) -> str:
        return "\n".join(event.words for event in self.operator.of(Noted))

    def taken(self) -> list[int]:
        return [event.stop for event in self.operator.of(PoseTaken)]

    def holds(self) -> list[tuple[str, ...]]:
        return [question.answers for question in self.operator.asked if "resume" in question.answers]

    def push_on_the_way(self, *moves: int) -> None:
        """Let something be in the way of these moves, and be gone when a person is asked."""

        def push() -> None:
            self.sensor.push = np.array([150.0, 0, 0, 0, 0, 0])

        def on_event(event: Event) -> None:
            if isinstance(event, StateChanged) and event.state is State.HOLD:
                self.sensor.push = np.zeros(6)

        self.arm.at_move |= dict.fromkeys(moves, push)
        self.operator.on_event = on_event
