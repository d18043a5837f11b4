"""Poses that another client moves the arm to: which are taken, what is shown, when it ends. The clock is simulated."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import solve
from ftcalib.errors import TooFewSamples
from ftcalib.model import Array, cross
from ftcalib.routine import PoseRecord, dataset_from, drift_check
from ftcalib.sampling import Sampling
from ftdrive.errors import SupervisorGone
from ftdrive.session.events import Estimated, Event, Key, Noted, PoseTaken, Question, StateChanged
from ftdrive.session.guards import Limits
from ftdrive.session.hand_guided import HandGuided
from ftdrive.session.open_session import OpenCell, PoseBook
from ftdrivers.errors import DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.follow import Follow
from ftdrivers.interfaces import ArmState, ArmStatus, DeviceInfo, ForceTorqueSensor, FtSamples, Health
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.fake_cell import STATUS

RATE_HZ = 200
MOVE_S = 1.5
NOISE = np.repeat([0.05, 0.002], 3)
BIAS = np.array([3.0, -2.0, 1.0, 0.1, -0.2, 0.3])
COM_M = np.array([0.0, 0.01, 0.06])
AVERAGE_S = 2.0
FLOOR = np.array([0.0, 0.0, -1.0])

UP, DOWN, LEFT, RIGHT, FRONT, BACK = (
    Rotation.from_euler("xyz", angles, degrees=True)
    for angles in ((0, 0, 0), (180, 0, 20), (90, 0, 0), (-90, 0, 40), (0, 90, 0), (0, -90, 10))
)
AROUND = [UP, DOWN, LEFT, RIGHT, FRONT, BACK]


@dataclass(frozen=True)
class Dwell:
    """A place where the arm is held."""

    at: Rotation
    seconds: float = 4.0
    creep_rad_s: float = 0.0
    wrench: Callable[[Array], Array] = lambda t: np.zeros((len(t), 6))
    """What else acts on the sensor, by the time in the dwell."""


def status(program: str = "playing", fault: DeviceFault | None = None) -> ArmStatus:
    return replace(STATUS, program=program, fault=fault)


class Cell(ForceTorqueSensor):
    """An arm that another client moves from dwell to dwell, and its sensor; both make time pass."""

    def __init__(self, dwells: Sequence[Dwell]) -> None:
        self.dwells = dwells
        self.clock = FakeClock()
        self.clock.ns = 0
        self.rng = np.random.default_rng(1)
        self.rate_Hz = RATE_HZ
        self.says: Callable[[float], ArmStatus] = lambda _: status()
        self.fails: dict[str, float] = {}
        self.recover = False
        self.unplugged_s = np.inf
        self.back_s = 0.0
        self.away_s = 0.3
        self.silent_s = (np.inf, np.inf)
        self.events: tuple[tuple[int, str], ...] = ()
        starts = np.cumsum([0.0, *(dwell.seconds + MOVE_S for dwell in dwells)])
        self.starts, self.end_s = starts[:-1], float(starts[-1]) - MOVE_S

    @property
    def now_s(self) -> float:
        return self.clock.now_s()

    @now_s.setter
    def now_s(self, t_s: float) -> None:
        self.clock.ns = round(t_s * 1e9)

    def _where(self, t_s: float) -> tuple[Rotation, float, int]:
        """Orientation, joint speed, dwell."""
        k = int(np.searchsorted(self.starts, t_s, side="right")) - 1
        dwell, into_s = self.dwells[k], t_s - self.starts[k]
        if into_s <= dwell.seconds or k == len(self.dwells) - 1:
            turned = Rotation.from_rotvec([dwell.creep_rad_s * into_s, 0, 0]) if dwell.creep_rad_s else None
            return dwell.at if turned is None else dwell.at * turned, dwell.creep_rad_s, k
        way = (self.dwells[k + 1].at * dwell.at.inv()).as_rotvec()
        return Rotation.from_rotvec(way * (into_s - dwell.seconds) / MOVE_S) * dwell.at, 0.7, k

    def _may_fail(self, what: str) -> None:
        if self.now_s >= self.fails.get(what, np.inf):
            raise ConnectionError(what)

    def state(self) -> ArmState:
        self.now_s += 0.002
        assert self.now_s < self.end_s + 100, "it should have ended"
        self._may_fail("arm")
        if self.silent_s[0] < self.now_s < self.silent_s[1]:
            self.now_s += 0.2
            raise DeviceTimeout("its clock has stood still", "press the emergency stop if the arm moves")
        R, speed, _ = self._where(self.now_s)
        return ArmState(
            t_host_ns=round(self.now_s * 1e9),
            t_device_s=self.now_s,
            q_rad=R.as_rotvec().repeat(2),
            qd_rad_s=np.array([0, 0, 0, -speed, 0, 0]),
            R_base_flange=R.as_matrix(),
            p_base_flange_m=np.zeros(3),
        )

    def status(self) -> ArmStatus:
        return self.says(self.now_s)

    def open(self) -> None: ...

    def close(self) -> None: ...

    def identify(self) -> DeviceInfo:
        raise AssertionError

    def follow(self) -> AbstractContextManager[Follow[FtSamples]]:
        raise AssertionError

    def latest(self, *, timeout_s: float) -> FtSamples:
        raise AssertionError(timeout_s)

    def collect(self, duration_s: float) -> FtSamples:
        t = self.now_s + np.arange(max(1, round(duration_s * self.rate_Hz))) / self.rate_Hz
        self.now_s += duration_s
        self._may_fail("sensor")
        if self.now_s > self.unplugged_s:
            self.back_s, self.unplugged_s = self.now_s + self.away_s, np.inf
            self.events = ((17, "a cable came off"), (18, "connected again"))
            raise StreamBroken("interrupted, connecting again")
        wrench = []
        for some in np.array_split(t, max(1, len(t) // 20)):  # the arm stands still for a tenth of a second each time
            R, _, k = self._where(some[0])
            force = [0, 0, -12.0] @ R.as_matrix()
            load = np.concatenate([force, cross(COM_M, force)])
            wrench.append(load + self.dwells[k].wrench(some - self.starts[k]))
        n = len(t)
        rows = np.concatenate(wrench) + BIAS + self.rng.normal(size=(n, 6)) * NOISE
        return FtSamples.of(np.round(t * 1e9), np.arange(n), rows)

    def check(self) -> None:
        if self.now_s < self.back_s:
            self.now_s += 0.1
            raise StreamBroken("interrupted, connecting again")

    def health(self) -> Health:
        return Health(0, 0, 0, RATE_HZ, 0.0, events=self.events)


class Person:
    """Hears everything, presses keys at given times, and q a while after the arm's last dwell."""

    def __init__(self, cell: Cell, keys: dict[float, Key], *, has_keys: bool = True) -> None:
        self.cell = cell
        self.has_keys = has_keys
        self.pressed_by = "the operator"
        self.gone: str | None = None
        self.keys = keys | {cell.end_s + 20: Key.STOP}
        self.shown: list[Event] = []

    def show(self, event: Event, *, sync: bool = False) -> None:
        assert sync == isinstance(event, PoseTaken)
        self.shown.append(event)

    def ask(self, question: Question) -> str:
        raise AssertionError(question)

    def require_operator(self) -> None:
        if self.gone:
            raise SupervisorGone(self.gone)

    def pressed(self) -> Key | None:
        if not self.has_keys:
            assert self.cell.now_s < self.cell.end_s + 20, "it should have ended"
            return None
        due = min(self.keys)
        return self.keys.pop(due) if self.cell.now_s >= due else None

    def words(self) -> str:
        return "\n".join(event.words for event in self.shown if isinstance(event, Noted))


@dataclass
class Fit:
    """Turns green with the sixth pose."""

    poses: dict[int, PoseRecord] = field(default_factory=dict)
    residual: tuple[float, float] | None = None

    def add(self, record: PoseRecord) -> Estimated:
        self.poses[record.stop] = record
        green = len(self.poses) >= 6
        return Estimated(
            poses=len(self.poses),
            values={},
            sigma={},
            residual_sigma=self.residual and self.residual[0],
            residual_force_N=self.residual and self.residual[1],
            faces=(0, 0, 0, 0, 0, 0),
            cond9=1.0,
            cond_u1=1.0,
            empty_cap_deg=1.0,
            light="green" if green else "amber",
            hint="" if green else "point it down",
        )


class Outcome:
    """What a collection leaves."""

    def __init__(
        self,
        dwells: Sequence[Dwell],
        *,
        listen: bool = False,
        keys: dict[float, Key] | None = None,
        earlier: Sequence[PoseRecord] = (),
        fit: Any = None,
        has_keys: bool = True,
        raises: Any = None,
        at_commit: Callable[["Outcome"], None] = lambda _: None,
        **interrupted: Any,
    ) -> None:
        self.at_commit = at_commit
        self.cell = Cell(dwells)
        for name, value in interrupted.items():
            setattr(self.cell, name, value)
        self.person = Person(self.cell, keys or {}, has_keys=has_keys)
        self.fit = fit or Fit()
        self.kept: list[PoseRecord] = []

        cell: Any = self.cell
        run: Any = self
        opened = OpenCell(cell, cell, cell.clock, run.person, Limits())
        book = PoseBook(opened, run, run.fit, FLOOR)
        sampling = Sampling(average_s=AVERAGE_S, attempts=3)
        with raises or nullcontext():
            HandGuided(opened, book, sampling, listen=listen).run(earlier, "the coverage is green")

    def commit(self, record: PoseRecord) -> PoseRecord:
        self.kept.append(record)
        self.at_commit(self)
        self.person.shown.append(Noted(words=f"committed {record.stop}"))
        return record

    @property
    def stops(self) -> list[int]:
        return [record.stop for record in self.kept]


def dwells(*at: Rotation, seconds: float = 4.0) -> list[Dwell]:
    return [Dwell(one, seconds) for one in at]


def test_every_standstill_at_a_new_orientation_is_a_pose() -> None:
    outcome = Outcome(dwells(*AROUND))
    assert outcome.stops == [1, 2, 3, 4, 5, 6]
    for record, expected in zip(outcome.kept, AROUND, strict=True):
        np.testing.assert_allclose(record.before.R_base_flange, expected.as_matrix(), atol=1e-9)
        assert record.steady
        assert len(record.samples.wrench) == AVERAGE_S * RATE_HZ
        assert record.samples.t_host_ns[0] * 1e-9 >= outcome.cell.starts[record.stop - 1] + 1.0  # still for a second
    dataset = dataset_from(outcome.kept, {})
    assert len(dataset) == 6  # none is taken for the return to the first
    result = solve(dataset)
    assert np.abs(result.force_bias_N - BIAS[:3]).max() < 4 * np.max(result.sigma["force_bias_N"])


@pytest.mark.slow
def test_an_arm_that_hardly_rests_or_creeps_is_not_measured() -> None:
    outcome = Outcome([Dwell(UP, 0.9), Dwell(LEFT, 30, creep_rad_s=0.0019), Dwell(DOWN, 0.5), Dwell(FRONT)])
    assert outcome.stops == [1]
    np.testing.assert_allclose(outcome.kept[0].before.R_base_flange, FRONT.as_matrix(), atol=1e-9)


def test_keep_ends_it_when_the_poses_are_enough_and_not_before() -> None:
    outcome = Outcome(dwells(*AROUND, Rotation.from_euler("x", 45, degrees=True)), keys={8.0: Key.KEEP, 32.0: Key.KEEP})
    words = outcome.person.words()
    assert "The light is amber" in words
    assert words.count("press k to finish") == 1
    moves = [event.words for event in outcome.person.shown if isinstance(event, StateChanged) and event.words]
    move_on = "move on to another orientation"
    assert moves[:5] == [move_on] * 5
    assert "press k" in moves[5]  # the screen says so all the time
    assert outcome.person.shown[-1].to_dict()["words"] == "Finished: 6 poses are saved."
    assert outcome.cell.now_s == pytest.approx(32.0, abs=0.2)


TILTED = [Rotation.from_euler("xyz", angles, degrees=True) for angles in ((45, 0, 0), (0, 45, 0))]


def test_without_keys_it_ends_by_itself_when_the_poses_are_enough() -> None:
    outcome = Outcome(dwells(*AROUND, *TILTED), has_keys=False)
    assert outcome.stops == [1, 2, 3, 4, 5, 6]
    assert "when the coverage is green" in outcome.person.words()
    assert "6 poses are saved." in outcome.person.words()
    assert "press" not in outcome.person.words()


@pytest.mark.slow
def test_keys_pressed_while_a_pose_is_averaged_mean_what_is_shown_then() -> None:
    redone = Outcome(dwells(UP, DOWN, LEFT), keys={7.5: Key.REDO})  # pose 1 is shown, pose 2 is averaged
    assert redone.stops == [1, 1, 2]
    np.testing.assert_allclose(redone.fit.poses[1].before.R_base_flange, DOWN.as_matrix(), atol=1e-9)
    skipped = Outcome(dwells(UP, DOWN, LEFT), keys={7.5: Key.SKIP})
    assert [r.before.R_base_flange[2, 2].round(3) for r in skipped.kept] == [1.0, 0.0]
    paused = Outcome(dwells(UP, DOWN), keys={7.5: Key.PAUSE})
    assert paused.stops == [1]


@pytest.mark.slow
@pytest.mark.parametrize(("since_s", "listen"), [(4.5, True), (8.2, False)])  # on the way; pose 2 is averaged
def test_an_arm_that_is_silent_for_a_second_is_waited_for(since_s: float, listen: bool) -> None:
    outcome = Outcome(dwells(UP, DOWN, LEFT, seconds=6.0), silent_s=(since_s, since_s + 1.0), listen=listen)
    assert [r.before.R_base_flange[2, 2].round(3) for r in outcome.kept] == [1.0, -1.0, 0.0]
    words = "The measurement waits until the arm answers again: its clock has stood still."
    assert outcome.person.words().count(words) == 1


@pytest.mark.parametrize(
    ("interrupted", "ends"),
    [
        ({"recover": True, "unplugged_s": 8.0, "away_s": 11.7}, None),
        ({"recover": True, "unplugged_s": 8.0, "away_s": 12.5}, StreamBroken),
        ({"silent_s": (8.0, 19.7)}, None),
        ({"silent_s": (8.0, 21.6)}, DeviceTimeout),
    ],
)
def test_a_device_that_comes_back_within_12_s_is_waited_for(
    interrupted: dict[str, Any], ends: type[Exception] | None
) -> None:
    outcome = Outcome(dwells(UP, DOWN), raises=ends and pytest.raises(ends), **interrupted)
    assert outcome.stops == ([1] if ends else [1, 2])


def trembling(t: Array) -> Array:
    """A hand on the tool for the first 3 s."""
    force = np.zeros((len(t), 6))
    force[:, 1] = 2.0 * np.sin(40 * t) * (t < 3.0)
    return force


def test_a_pose_that_is_never_quiet_is_kept_and_marked() -> None:
    outcome = Outcome([Dwell(UP), Dwell(DOWN, 15.0, wrench=lambda t: trembling(t - 100)), Dwell(LEFT)])
    assert [record.steady for record in outcome.kept] == [True, False, True]
    assert "press r to take" in outcome.person.words()


@pytest.mark.parametrize(
    ("residual", "asked"), [((40.0, 3.2), True), ((40.0, 0.1), False), ((3.0, 3.2), False), (None, False)]
)
def test_a_pose_that_the_others_contradict_is_asked_about(residual: tuple[float, float] | None, asked: bool) -> None:
    words = Outcome(dwells(*AROUND), fit=Fit(residual=residual)).person.words()
    assert ("Pose 6 differs by 3.2 N" in words) == asked
    assert "Pose 5 differs" not in words  # too few to judge


def test_nothing_is_measured_while_the_controller_reports_a_fault() -> None:
    def says(t: float) -> ArmStatus:
        return status("stopped", DeviceFault("protective stop", "clear it at the pendant") if 4.5 < t < 10.9 else None)

    outcome = Outcome(dwells(UP, DOWN, LEFT), says=says)
    assert [r.before.R_base_flange[2, 2].round(3) for r in outcome.kept] == [1.0, 0.0]
    assert outcome.person.words().count("No measurement now: protective stop") == 1


def test_a_run_is_continued_where_it_was() -> None:
    first = Outcome(dwells(*AROUND[:3]))
    second = Outcome(dwells(DOWN, *AROUND[3:]), earlier=first.kept)
    assert second.stops == [4, 5, 6]
    assert "from pose 2 and is left out" in second.person.words()
    assert "These poses are enough" in second.person.words()
    assert len(dataset_from([*first.kept, *second.kept], {})) == 6


# ------------------------------------------------------------------ listening to a program


def test_listening_ends_when_the_program_is_back_at_its_first_pose() -> None:
    outcome = Outcome(dwells(*AROUND, UP, DOWN), listen=True)
    assert outcome.stops == [1, 2, 3, 4, 5, 6, 7]
    assert outcome.cell.now_s < outcome.cell.starts[-1]
    drift = drift_check(outcome.kept)
    assert drift is not None
    assert drift.elapsed_s == pytest.approx(6 * (4.0 + MOVE_S), abs=0.5)
    assert len(dataset_from(outcome.kept, {})) == 6
    words = outcome.person.words()
    assert "dwell 3.3 s" in words
    assert "first pose: 7 poses" in words
    assert not any(hint in words for hint in ("press k", "Turn the tool"))
    assert {event.hint for event in outcome.person.shown if isinstance(event, Estimated)} == {""}


def test_only_standstills_of_the_running_program_count_and_the_last_though_it_has_ended() -> None:
    def says(t: float) -> ArmStatus:
        moments = [(5, "stopped"), (11, "playing"), (15.4, "paused"), (22, "playing"), (1e9, "stopped")]
        return status(next(program for until, program in moments if t < until))

    outcome = Outcome(dwells(UP, DOWN, LEFT, RIGHT, FRONT), listen=True, says=says)
    rest = [record.before.R_base_flange.round(6).tolist() for record in outcome.kept]
    assert rest == [one.as_matrix().round(6).tolist() for one in (DOWN, RIGHT, FRONT)]
    assert outcome.cell.now_s < outcome.cell.end_s + 5  # by itself


# ------------------------------------------------------------------ what breaks


@pytest.mark.parametrize(("what", "at_s", "listen"), [("arm", 5.0, True), ("sensor", 8.0, False)])
def test_a_device_that_fails_ends_it_at_once_and_what_is_committed_stands(what: str, at_s: float, listen: bool) -> None:
    outcome = Outcome(
        dwells(UP, DOWN, LEFT), listen=listen, fails={what: at_s}, raises=pytest.raises(ConnectionError, match=what)
    )
    assert outcome.stops == [1]
    assert outcome.cell.now_s < at_s + AVERAGE_S + 0.2


def test_a_sensor_that_is_too_slow_is_refused() -> None:
    outcome = Outcome(dwells(UP), rate_Hz=2, raises=pytest.raises(TooFewSamples, match=r"16 samples in 8\.0 s"))
    assert outcome.stops == []


def test_without_an_operator_it_ends_and_what_is_committed_stands() -> None:
    def leave(outcome: Outcome) -> None:
        outcome.person.gone = "the terminal was closed" if len(outcome.kept) == 2 else None

    outcome = Outcome(dwells(*AROUND), at_commit=leave, raises=pytest.raises(SupervisorGone, match="terminal"))
    assert outcome.stops == [1, 2]


def test_if_the_arm_moves_off_while_measured_the_time_to_wait_is_shown() -> None:
    outcome = Outcome([*dwells(UP, seconds=2.0), *dwells(DOWN)])
    assert outcome.stops == [1]
    assert "moved while pose 1" in outcome.person.words()


def test_a_sensor_that_recovers_is_waited_for_and_its_failure_is_reported_once() -> None:
    outcome = Outcome(dwells(UP, DOWN, LEFT, seconds=6.0), recover=True, unplugged_s=9.5)  # while pose 2 is averaged
    assert outcome.stops == [1, 2, 3]
    assert outcome.person.words().count("a cable came off") == 1
    assert outcome.person.words().count("connected again") == 1
    outcome = Outcome(dwells(UP, DOWN), unplugged_s=8.0, raises=pytest.raises(StreamBroken))
    assert outcome.stops == [1]
    assert "a cable came off" in outcome.person.words()


def test_a_mean_that_changes_is_seen_at_the_first_pose_too() -> None:
    outcome = Outcome([Dwell(UP, 30.0, wrench=lambda t: np.outer(np.minimum(t, 5.0), np.full(6, 0.2)))])
    assert "its mean still changes" in outcome.person.words()
    assert outcome.kept[-1].steady
