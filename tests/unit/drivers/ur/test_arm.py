"""`UrArm` with a controller in memory and a fake clock: every limit of time, every way to stop."""

from collections.abc import Callable
from contextlib import nullcontext
from itertools import pairwise
from math import nan, radians
from typing import Any

import pytest

from ftdrivers.errors import ConnectError, DeviceFault, DeviceTimeout, ProtocolError, StreamBroken
from ftdrivers.interfaces import Guard
from ftdrivers.ur import arm as arm_module
from ftdrivers.ur import opening
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.control import ControlSetting
from tests.fake_clock import FakeClock
from tests.unit.drivers.ur.controller_in_memory import (
    HOST,
    Controller,
    MakeArm,
    ServicesInMemory,
    away,
    no_guard,
)

on_ur_rtde = pytest.mark.parametrize("path", ["ur-rtde"], indirect=True)


@pytest.fixture(params=["ur-rtde", "script"])
def path(request: pytest.FixtureRequest) -> ControlSetting:
    """The control path; both find the controller in memory."""
    setting: ControlSetting = request.param
    return setting


def move(arm: UrArm, controller: Controller, guard: Guard = no_guard) -> None:
    arm.move_to(away(controller), timeout_s=5, guard=guard)


class After:
    """A guard that does something once, so long after the move has begun."""

    def __init__(self, clock: FakeClock, delay_s: float, do: Callable[[], object]) -> None:
        self._clock, self._delay_s, self._do = clock, delay_s, do
        self._begin_s: float | None = None
        self.did_s: float | None = None

    def __call__(self) -> None:
        self._begin_s = self._begin_s or self._clock.now_s()
        if self.did_s is None and self._clock.now_s() - self._begin_s >= self._delay_s:
            self.did_s = self._clock.now_s()
            self._do()

    def ago_s(self) -> float:
        assert self.did_s is not None
        return self._clock.now_s() - self.did_s


def setting(thing: object, **values: object) -> Callable[[], None]:
    def do() -> None:
        for name, value in values.items():
            setattr(thing, name, value)

    return do


# ---------------------------------------------------------------------- before anything is opened


@pytest.mark.parametrize("speed", [0.0, 1e-4, 30.0, nan])
def test_absurd_speeds_and_accelerations_are_refused(speed: float, arm: UrArm, controller: Controller) -> None:
    q = away(controller)
    with pytest.raises(ValueError, match="speed_rad_s"):
        UrArm(HOST, speed_rad_s=speed)
    with pytest.raises(ValueError, match="acceleration_rad_s2"):
        UrArm(HOST, acceleration_rad_s2=speed)
    with pytest.raises(ValueError, match="stop_rad_s2"):
        UrArm(HOST, stop_rad_s2=speed)
    with pytest.raises(ValueError, match="speed_rad_s"):
        arm.move_to(q, timeout_s=5, guard=no_guard, speed_rad_s=speed)
    with pytest.raises(ValueError, match="acceleration_rad_s2"):
        arm.move_to(q, timeout_s=5, guard=no_guard, acceleration_rad_s2=speed)
    assert "move" not in controller.did


def test_unknown_models_are_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'kr6' .*UR5e"):
        UrArm(HOST, model="kr6")


@pytest.mark.parametrize(
    ("q_rad", "says"),
    [([0.0] * 5, "six"), ([0.0] * 5 + [nan], "six finite"), ([0, -90, 0, 0, 0, 0], "radians")],
)
def test_bad_targets_never_leave_the_house(arm: UrArm, controller: Controller, q_rad: list[float], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        arm.move_to(q_rad, timeout_s=1, guard=no_guard)
    with pytest.raises(ValueError, match=says):
        arm.within_safety_limits(q_rad)
    assert "move" not in controller.did


@pytest.mark.parametrize(
    ("version", "simulated", "asks"),
    [((5, 6, 0, 1), False, True), ((5, 5, 9, 9), False, False), ((5, 15, 0, 1), True, False)],
)
def test_an_arm_that_is_not_in_remote_control_is_not_moved(
    make_arm: MakeArm,
    controller: Controller,
    monkeypatch: pytest.MonkeyPatch,
    version: tuple[int, int, int, int],
    simulated: bool,
    asks: bool,
) -> None:
    controller.version = version
    monkeypatch.setattr(ServicesInMemory, "in_remote_control", lambda _: False)
    for module in (opening, arm_module):
        monkeypatch.setattr(module, "SIMULATORS", (HOST,) if simulated else ())
    arm = make_arm()
    with pytest.raises(ConnectError, match="is not in remote control") if asks else nullcontext():
        arm.open(control=True)
    arm.open()
    assert arm.in_remote_control() is (False if asks else None)


def test_a_whole_turn_is_within_the_range_of_a_joint(arm: UrArm) -> None:
    arm.within_safety_limits([0, -1.5, 1.5, 0, 0, radians(360)])
    with pytest.raises(ValueError, match="limit of every joint is 360 degrees"):
        arm.within_safety_limits([0, -1.5, 1.5, 0, 0, -radians(360.001)])


@on_ur_rtde
def test_without_ur_rtde_the_error_says_where_it_exists(make_arm: MakeArm, controller: Controller) -> None:
    controller.ur_rtde_is_installed = False
    with pytest.raises(ConnectError, match=r"CPython 3\.11 or 3\.12"):
        make_arm().open(control=True)
    assert controller.did == []


@pytest.mark.parametrize(
    ("setting", "version", "installed", "path", "why"),
    [
        ("auto", (5, 15), True, "ur-rtde", "is installed"),
        ("auto", (5, 15), False, "script", "not installed"),
        ("auto", (10, 11), True, "script", "no dashboard server"),
        ("script", (5, 15), True, "script", "configured"),
        ("ur-rtde", (5, 15), False, "ur-rtde", "configured"),
    ],
)
def test_auto_takes_ur_rtde_where_it_can(
    setting: ControlSetting, version: tuple[int, ...], installed: bool, path: str, why: str, controller: Controller
) -> None:
    controller.ur_rtde_is_installed = installed
    taken, reason = opening.path_for(setting, version)
    assert taken == path
    assert why in reason


# ---------------------------------------------------------------------- opening


def test_reading_starts_nothing(make_arm: MakeArm, controller: Controller) -> None:
    arm = make_arm()
    arm.open()
    assert arm.state().q_rad.tolist() == controller.q_rad
    arm.stop()
    with pytest.raises(ConnectError, match="reading only"):
        move(arm, controller)
    arm.close()
    assert controller.did == []


@pytest.mark.parametrize("taken", [False, True])
@pytest.mark.parametrize("minor", [15, 2])
def test_what_control_needs_is_diagnosed_without_control(
    taken: bool, minor: int, make_arm: MakeArm, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controller, "version", (5, minor, 0, 1), raising=False)
    controller.registers_taken = taken
    arm = make_arm()
    arm.open()
    found = {finding.name: finding for finding in arm.diagnose()}
    passed = {name: finding.passed for name, finding in found.items()}
    assert passed == {"control": True, "version": minor == 15, "registers": not taken, "programs": True}
    assert ("update it to 5." in found["version"].fix) == (minor == 2)
    assert ("EtherNet/IP" in found["registers"].fix) == taken


@pytest.mark.parametrize("what", ["registers_taken", "program"])
def test_another_client_is_waited_for_and_not_ended(
    make_arm: MakeArm, controller: Controller, clock: FakeClock, what: str
) -> None:
    taken, free = {"registers_taken": (True, False), "program": (4, 1)}[what]
    setattr(controller, what, taken)
    begin_s = clock.now_s()
    with pytest.raises(ConnectError) as error:
        make_arm().open(control=True)
    assert 1.0 <= clock.now_s() - begin_s < 1.2
    assert ("another client" if what == "registers_taken" else "PLAYING other.urp") in error.value.found
    assert controller.did == []

    clock.at(0.9, setting(controller, **{what: free}))
    make_arm().open(control=True)
    assert controller.did == ["start our program"]


def test_a_control_process_that_does_not_start_is_given_up(
    make_arm: MakeArm, controller: Controller, clock: FakeClock
) -> None:
    controller.starts_in_s = 60.0
    begin_s = clock.now_s()
    with pytest.raises(ConnectError, match=r"within 4\.5 s"):
        make_arm().open(control=True)
    assert 4.5 <= clock.now_s() - begin_s < 5
    assert controller.did == ["dashboard stop"]  # a program may have been sent


def test_a_safety_stop_while_starting_is_the_reason(
    make_arm: MakeArm, controller: Controller, clock: FakeClock
) -> None:
    controller.starts_in_s = 60.0
    clock.at(0.5, setting(controller, safety_bits=0x404))
    begin_s = clock.now_s()
    with pytest.raises(ConnectError, match="protective stop"):
        make_arm().open(control=True)
    assert clock.now_s() - begin_s < 1.0


# ---------------------------------------------------------------------- moving


def test_a_move_arrives_and_is_watched(arm: UrArm, controller: Controller, clock: FakeClock) -> None:
    calls: list[float] = []
    q, begin_s = away(controller), clock.now_s()
    arm.move_to(q, timeout_s=5, guard=lambda: calls.append(clock.now_s()))
    assert controller.q_rad == q
    assert 1.0 < clock.now_s() - begin_s < 1.1
    assert len(calls) > 50
    assert max(b - a for a, b in pairwise(calls)) < 0.05  # `RobotArm`: 20 times a second
    arm.close()
    assert controller.did == ["start our program", "move", "end our program"]


def test_a_guard_that_has_tripped_lets_no_move_begin(arm: UrArm, controller: Controller) -> None:
    def tripped() -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        move(arm, controller, tripped)
    assert controller.did == ["start our program"]


def test_a_move_has_its_time_and_no_more(arm: UrArm, controller: Controller, clock: FakeClock) -> None:
    begin_s = clock.now_s()
    with pytest.raises(DeviceTimeout, match="speed slider"):
        arm.move_to(away(controller), timeout_s=0.5, guard=no_guard)
    assert 0.5 < clock.now_s() - begin_s < 0.6
    assert controller.did[-1] == "stop softly"
    move(arm, controller)  # without opening it again


@pytest.mark.parametrize("disturbed", ["qd_rad_s", "speed_rad_s", "goal_rad"])
def test_still_is_three_tenths_of_a_second_without_a_break(
    arm: UrArm, controller: Controller, clock: FakeClock, disturbed: str
) -> None:
    move(arm, controller)
    begin_s = clock.now_s()
    arm.wait_until_still(timeout_s=5, guard=no_guard)
    assert 0.3 <= clock.now_s() - begin_s < 0.33
    if disturbed == "qd_rad_s":  # it shakes
        clock.at(0.2, setting(controller, qd_rad_s=[0.0, 0.0, -0.003, 0.0, 0.0, 0.0]))
        clock.at(0.22, setting(controller, qd_rad_s=[0.0] * 6))
    elif disturbed == "speed_rad_s":  # its set-point moves
        clock.at(0.2, setting(controller, speed_rad_s=-1e-4, goal_rad=away(controller)))
        clock.at(0.22, setting(controller, goal_rad=None))
    else:  # it is somewhere else
        here = controller.q_rad
        clock.at(0.2, setting(controller, q_rad=[*here[:5], here[5] + 0.002]))
        clock.at(0.22, setting(controller, q_rad=here))
    begin_s = clock.now_s()
    arm.wait_until_still(timeout_s=5, guard=no_guard)
    assert 0.52 <= clock.now_s() - begin_s < 0.55


# ---------------------------------------------------------------------- limits of a move


def test_a_silent_controller_is_found_in_a_fifth_of_a_second(
    arm: UrArm, controller: Controller, clock: FakeClock, path: ControlSetting
) -> None:
    """Reported after 0.2 s and one short attempt at the dashboard server; the soft stop is not tried."""
    controller.dashboard_answers = False
    provoke = After(clock, 0.3, setting(controller, silent=True))
    says = "press the emergency stop" if path == "ur-rtde" else "stop the arm by itself"
    with pytest.raises(DeviceTimeout, match=says):
        move(arm, controller, provoke)
    assert 0.2 < provoke.ago_s() < 0.2 + 0.15 + 0.02
    assert controller.dashboard_limits_s[-1] == 0.15
    controller.silent, controller.dashboard_answers = False, True
    controller.dashboard_limits_s.clear()
    arm.open(control=True)  # what was left there is ended first
    ended = ["dashboard stop"] if path == "ur-rtde" else ["stop softly"]  # by itself
    assert [did for did in controller.did if did != "end our program"] == [
        "start our program",
        "move",
        *ended,
        "start our program",
    ]


@pytest.mark.parametrize(
    ("path", "hanging"), [("ur-rtde", "progress"), ("ur-rtde", "move"), ("script", "move")], indirect=["path"]
)
def test_a_control_path_that_hangs_is_killed(
    arm: UrArm, controller: Controller, clock: FakeClock, hanging: str
) -> None:
    controller.hanging = {hanging}
    begin_s, limit_s = clock.now_s(), 0.4 if hanging == "progress" else 2.0
    with pytest.raises(DeviceTimeout, match=f"within {limit_s} s"):
        move(arm, controller)
    assert limit_s < clock.now_s() - begin_s < limit_s + 0.1
    assert not controller.control.alive
    assert controller.did[-1] == "dashboard stop"


@pytest.mark.parametrize(("hangs_s", "stopped"), [(0.45, False), (0.55, True)])
def test_a_move_that_the_parent_does_not_watch_is_stopped_after_half_a_second(
    arm: UrArm, controller: Controller, clock: FakeClock, hangs_s: float, stopped: bool
) -> None:
    provoke = After(clock, 0.3, lambda: clock.sleep(hangs_s))
    if not stopped:
        move(arm, controller, provoke)
        return
    with pytest.raises(DeviceTimeout, match=r"0\.5 s"):
        move(arm, controller, provoke)
    assert controller.did[-1] == "stop softly"
    move(arm, controller)  # and it is still ours


# ---------------------------------------------------------------------- stopping


@pytest.mark.parametrize(
    ("trouble", "ways"),
    [
        ({}, ["stop softly"]),
        ({"stopping_works": False}, ["stop softly", "dashboard stop"]),  # it reports so, and the arm goes on
        ({"hanging": {"stop"}}, ["dashboard stop"]),
        ({"safety_bits": 0x404}, ["dashboard stop"]),
        ({"program": 1}, ["dashboard stop"]),
    ],
    ids=["works", "without effect", "hangs", "safety stop", "program ended"],
)
def test_the_ways_to_stop(
    arm: UrArm, controller: Controller, clock: FakeClock, path: ControlSetting, trouble: dict[str, Any], ways: list[str]
) -> None:
    controller.control.call("move", away(controller), 1.0, 3.0)
    setting(controller, **trouble)()
    before, begin_s = len(controller.did), clock.now_s()
    arm.stop()
    if path == "script" and "stopping_works" in trouble:
        ways = ["stop softly", "stop softly", "end our program", "dashboard stop"]  # it is asked to end, too
    assert controller.did[before:] == ways
    assert controller.control.alive == (ways == ["stop softly"])
    assert clock.now_s() - begin_s < (0.85 if "hanging" in trouble else 0.25)  # 0.5 s, and the braking


@pytest.mark.parametrize(
    "trouble", [{}, {"stopping_works": False}, {"hanging": {"stop", "tcp_offset"}}, {"hanging": {"stop", "progress"}}]
)
@pytest.mark.parametrize("delay_s", [0.3, 0.404])
def test_a_move_that_is_stopped_reports_the_stop(
    arm: UrArm, controller: Controller, clock: FakeClock, trouble: dict[str, Any], delay_s: float
) -> None:
    """Wherever the move is when another thread stops the arm, and however that ends."""

    def stop() -> None:
        setting(controller, **trouble)()
        arm.stop()

    clock.at(delay_s, stop)
    with pytest.raises(DeviceFault, match="stop was requested"):
        move(arm, controller)
    assert controller.goal_rad is None
    if not trouble:
        move(arm, controller)  # it is still ours


def test_a_stop_just_before_a_move_ends_it(arm: UrArm, controller: Controller, clock: FakeClock) -> None:
    where = controller.q_rad[5]
    with pytest.raises(DeviceFault, match="stop was requested"):
        move(arm, controller, After(clock, 0.0, arm.stop))
    assert controller.goal_rad is None
    assert controller.q_rad[5] == pytest.approx(where, abs=0.05)


def test_a_guard_says_why_it_has_stopped_the_arm(arm: UrArm, controller: Controller, clock: FakeClock) -> None:
    def trip() -> None:
        arm.stop()
        raise DeviceFault("overload")

    with pytest.raises(DeviceFault, match="overload"):
        move(arm, controller, After(clock, 0.3, trip))


def test_a_stop_of_old_is_not_the_reason_of_a_fault(arm: UrArm, controller: Controller, clock: FakeClock) -> None:
    with pytest.raises(DeviceFault, match="stop was requested"):
        move(arm, controller, After(clock, 0.3, arm.stop))
    clock.at(0.1, setting(controller, safety_bits=0x404))
    with pytest.raises(DeviceFault, match="protective stop"):
        arm.wait_until_still(timeout_s=5, guard=no_guard)


@pytest.mark.parametrize(
    ("trouble", "longest_s"),
    [
        ({}, 0.1),
        ({"silent": True, "dashboard_answers": False}, 0.1 + 0.4),
        ({"hanging": {"tcp_offset"}}, 0.3 + 0.1),
        ({"hanging": {"quit"}}, 0.7 + 0.1),
        ({"hanging": {"quit"}, "dashboard_answers": False}, 0.7 + 0.4 + 0.1),
    ],
    ids=["well", "all lost", "another program", "hangs", "hangs, and no dashboard"],
)
def test_closing_takes_a_second_and_a_half_at_most(
    arm: UrArm, controller: Controller, clock: FakeClock, trouble: dict[str, Any], longest_s: float
) -> None:
    control = controller.control
    setting(controller, **trouble)()
    begin_s = clock.now_s()
    arm.close()
    assert clock.now_s() - begin_s <= longest_s < 1.5
    assert not control.alive
    assert ("dashboard stop" in controller.did) == (trouble == {"hanging": {"quit"}})  # another program is left alone


def test_an_old_attempt_to_stop_does_not_end_the_next_move(
    arm: UrArm, controller: Controller, clock: FakeClock
) -> None:
    with pytest.raises(DeviceTimeout):
        move(arm, controller, After(clock, 0.3, setting(controller, silent=True, dashboard_late_s=1.0)))
    setting(controller, silent=False, dashboard_late_s=None, program=1)()  # another client has stopped it
    arm.open(control=True)
    move(arm, controller)
    clock.advance(1.0)
    assert "dashboard stop" not in controller.did


@pytest.mark.parametrize(("stop_deg_s2", "is_allowed"), [(59.5, False), (60, True), (300, True), (300.5, False)])
def test_a_stop_has_a_usual_deceleration(stop_deg_s2: float, is_allowed: bool) -> None:
    with nullcontext() if is_allowed else pytest.raises(ValueError, match=r"choose 1\.05 to 5\.23"):
        UrArm(HOST, stop_rad_s2=radians(stop_deg_s2))


@on_ur_rtde
@pytest.mark.parametrize(("answers_in_s", "ours"), [(0.38, True), (0.42, False)])
def test_a_question_to_our_program_has_four_tenths_of_a_second(
    arm: UrArm, controller: Controller, clock: FakeClock, answers_in_s: float, ours: bool
) -> None:
    controller.control_delay_s = answers_in_s
    begin_s = clock.now_s()
    with nullcontext() if ours else pytest.raises(DeviceFault, match="another program"):
        move(arm, controller)
    assert ours or 0.4 <= clock.now_s() - begin_s < 0.43
    assert controller.control.alive == ours


def test_a_new_arm_opens_no_connection_and_closes() -> None:
    arm = UrArm(HOST, model="ur5e", speed_rad_s=radians(60))
    arm.stop()
    arm.close()
    arm.close()
    with pytest.raises(ConnectError, match="not open"):
        arm.identify()


def test_an_unknown_control_path_is_refused() -> None:
    with pytest.raises(ValueError, match="auto, ur-rtde, script"):
        UrArm(HOST, control="urscript")  # type: ignore[arg-type]


def test_opening_twice_starts_one_program(arm: UrArm, controller: Controller) -> None:
    arm.open(control=True)
    arm.open()
    assert controller.did == ["start our program"]


def test_what_rtde_may_not_say_refuses_the_opening_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def damaged(*_: object, **__: object) -> None:
        raise ProtocolError("RTDE recipe cannot be read: 01", "is this an RTDE server?")

    monkeypatch.setattr(arm_module, "Reader", damaged)
    with pytest.raises(ConnectError, match="recipe cannot be read: 01") as error:
        UrArm(HOST).open()
    assert error.value.fix == "is this an RTDE server?"


def test_a_lost_connection_is_reported_at_once(arm: UrArm, controller: Controller, clock: FakeClock) -> None:
    provoke = After(clock, 0.3, setting(controller, failure=StreamBroken("closed")))
    with pytest.raises(StreamBroken):
        move(arm, controller, provoke)
    assert provoke.ago_s() < 0.05
    assert controller.did[-1] == "dashboard stop"
    assert controller.dashboard_limits_s[-1] == 0.4


def test_another_program_found_before_a_move_is_left_alone(arm: UrArm, controller: Controller) -> None:
    controller.hanging = {"tcp_offset"}
    with pytest.raises(DeviceFault, match="another program"):
        move(arm, controller)
    arm.close()
    assert controller.did == ["start our program"]
