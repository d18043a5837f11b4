"""What can go wrong with the controller, its links and our processes, at every moment of using the arm.

Required of every row: told as below within half a second, with a sentence that says what to do; the arm stopped, or
known to be finishing the one move it was given; no wait over 5 s, no crash; after the operator has cleared it,
`open(control=True)` on the same object moves the arm again within 2 s. We never unlock and never play.

======================  ================  =============================  ==========================================
event                   what is told      arm                            test of this file
======================  ================  =============================  ==========================================
protective stop,        `DeviceFault`     stopped by the controller;     `test_in_move`,
emergency stop,                           what is left of the program    settling and idle: `test_at_rest`;
safeguard, power lost,                    is ended, so that nobody can   opening: `test_while_opening`;
brakes closed                             resume it                      closing: `test_while_closing`
program stopped,        `DeviceFault`     stopped by the controller      the same
paused or crashed,
another program
RTDE closed (FIN, RST)  `StreamBroken`    stopped through the dashboard  the same
RTDE silent, then back  `DeviceTimeout`   stopped through the dashboard  the same
all links cut, silent   `StreamBroken`,   finishes its move: nothing of  the same; `test_in_move` sees it stand
or refused              `DeviceTimeout`   ours can reach it
dashboard lost          nothing           goes on, and arrives           `test_what_disturbs_no_move`
local mode, reduced     nothing           goes on, and arrives           `test_what_disturbs_no_move`
slider at zero          `DeviceTimeout`   stopped, still ours            `test_a_slider_at_zero`
our process killed      -                 stopped by the child           `test_ur_arm.py`
the child killed, hung  `StreamBroken`,   stopped through the dashboard  `test_ur_arm.py`
                        `DeviceTimeout`
both killed             -                 finishes its move; its         `test_both_processes_killed`
                                          program is for the operator
                                          to stop
program of others       `ConnectError`    goes on: nothing of theirs     `test_a_program_of_somebody_else_is_never…`,
at a start              of the opening    is touched                     `test_a_program_that_took_the_place_of_ours…`
program of others       `DeviceFault`     goes on: nothing of theirs     `test_a_program_of_somebody_else_found_before…`
before a move                             is touched
end told off the goal   `DeviceFault`     stopped                        `test_an_end_told_before_the_goal…`
our process suspended   `DeviceTimeout`   stopped by the child           `test_suspended_in_a_move`
both suspended          as the arm is     finishes its move              `test_both_processes_suspended`
suspended while idle    -                 stands                         `test_nothing_old_is_believed`
======================  ================  =============================  ==========================================
"""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from math import radians
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest

from drivers.errors import ConnectError, DeviceFault, DeviceTimeout, DriverError, StreamBroken
from drivers.ur.arm import UrArm
from drivers.ur.control import ControlProcess

pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this platform")

ROOT = Path(__file__).parents[2]
TIME_SCALE = 10  # a protective stop can be unlocked after 5 s of the controller's time
STEP_RAD = 1.2  # 1.3 s
DETECTED_S = 1.0  # 0.5 s, on a busy computer; tests/benchmarks/ur_failures.py measures it
RESUMED_S = 4.0  # 2 s, on a busy computer


class Station(Protocol):
    """What the tests use of the emulator's process."""

    process: subprocess.Popen[str]
    host: str

    def do(self, verb: str, /, **how: object) -> dict[str, Any]: ...

    def wait_for(self, condition: Callable[[dict[str, Any]], bool], within_s: float = 2.0) -> None: ...

    def dashboard(self, command: str) -> str: ...


# ---------------------------------------------------------------------- the events and their cures

Act = Callable[[Station], object]


def on(verb: str, **how: object) -> Act:
    return lambda station: station.do(verb, **how)


def nothing(_: Station) -> None:
    pass


def unlock(station: Station) -> None:
    deadline = time.monotonic() + 5
    while not station.do("unlock")["accepted"]:  # refused for 5 s after the stop
        assert time.monotonic() < deadline
        time.sleep(0.05)


def power_up(station: Station) -> None:
    station.dashboard("power on")
    station.wait_for(lambda state: state["robot_mode"] == "IDLE", within_s=5)
    station.dashboard("brake release")
    station.wait_for(lambda state: state["robot_mode"] == "RUNNING", within_s=5)


def release(station: Station) -> None:
    station.do("emergency-stop", on=False)
    power_up(station)


def cut(station: Station, *, connected: bool) -> None:
    """Pull all cables, as far as TCP can tell, or plug them in."""
    for what in ("rtde", "dashboard", "script"):
        station.do("listen", what=what, on=connected)
        if not connected:
            station.do("drop", what=what, reset=True)


def another_takes_over(station: Station) -> None:
    """Another client starts a program that touches nothing and plays for 100 s: longer than anybody takes to ask."""
    station.do("foreign-program", seconds=1000)
    station.wait_for(lambda _: plays_another(station))


def plays_another(station: Station) -> bool:
    state = station.do("state")
    return bool((state["program"], state["runtime_state"]) == ("other", "PLAYING"))


@dataclass(frozen=True)
class Event:
    name: str
    do: Act
    cure: Act
    error: type[DriverError] | tuple[type[DriverError], ...]
    says: str
    reachable: bool = True
    """Whether the controller can still be told to stop."""
    hits_opening: bool = True
    """Whether it matters before a program of ours runs."""
    told_s: float = DETECTED_S

    def __str__(self) -> str:
        return self.name


LOST = (StreamBroken, DeviceTimeout)
EVENTS = [
    Event("protective-stop", on("protective-stop"), unlock, DeviceFault, r"protective stop \(.*\); find and remove"),
    Event(
        "emergency-stop",
        on("emergency-stop", on=True),
        release,
        DeviceFault,
        r"emergency stop \(.*\); make the cell safe",
    ),
    Event(
        "safeguard",
        on("safeguard", on=True),
        on("safeguard", on=False),
        DeviceFault,
        r"safeguard stop \(.*\); close the safeguard",
    ),
    Event("power-off", lambda s: s.dashboard("power off"), power_up, DeviceFault, "power the arm on and release"),
    Event("brakes", on("mode", robot=5), on("mode", robot=7), DeviceFault, r"\(idle\); release its brakes"),
    Event(
        "program-stop",
        on("dashboard-stop"),
        nothing,
        DeviceFault,
        "ended or paused by somebody else",
        hits_opening=False,
    ),
    Event(
        "program-pause",
        lambda s: s.dashboard("pause"),
        nothing,
        DeviceFault,
        "ended or paused by somebody else",
        hits_opening=False,
    ),
    Event(
        "crash-script", on("crash-script"), nothing, DeviceFault, "ended or paused by somebody else", hits_opening=False
    ),
    Event(
        "foreign-program",
        another_takes_over,
        on("dashboard-stop"),
        DeviceFault,
        "another program may have been started",
        hits_opening=False,
        told_s=2 * DETECTED_S,  # a question goes unanswered for 0.4 s first
    ),
    Event("rtde-fin", on("drop", what="rtde"), nothing, StreamBroken, "check the robot and the cable"),
    Event("rtde-reset", on("drop", what="rtde", reset=True), nothing, StreamBroken, "check the robot and the cable"),
    Event(
        "rtde-silent",
        on("silent", what="rtde", on=True),
        on("silent", what="rtde", on=False),
        LOST,
        "press the emergency",
    ),
    Event(
        "cable", on("silence-arm", on=True), on("silence-arm", on=False), LOST, "press the emergency", reachable=False
    ),
    Event("freeze", on("freeze", on=True), on("freeze", on=False), LOST, "stood still", reachable=False),
    Event(
        "cut",
        lambda s: cut(s, connected=False),
        lambda s: cut(s, connected=True),
        LOST,
        "check the robot",
        reachable=False,
    ),
]
each_event = pytest.mark.parametrize("event", EVENTS, ids=str)


@pytest.fixture
def station(kept: list[Station], start_station: Callable[..., Station]) -> Iterator[Station]:
    if not kept or kept[0].process.poll() is not None:
        kept[:] = [start_station("--time-scale", str(TIME_SCALE))]
    station = kept[0]
    for what in ("rtde", "dashboard", "script"):  # a test that failed may have left it like this
        station.do("listen", what=what, on=True)
    station.do("silence-arm", on=False)
    station.do("freeze", on=False)
    station.do("claim-registers", range="lower", on=False)
    station.do("dashboard-stop")
    before = len(station.do("state")["events"])
    yield station
    if station.process.poll() is None:
        state = station.do("state")
        assert state["bad_inputs"] == []
        ours = [event["what"] for event in state["events"][before:] if event["by"] == "dashboard" and event["accepted"]]
        assert not [what for what in ours if "play" in what or "unlock" in what], ours
        if not is_as_new(state):
            station.process.kill()


def is_as_new(state: dict[str, Any]) -> bool:
    return bool(
        (state["safety_mode"], state["robot_mode"], state["remote_control"]) == ("NORMAL", "RUNNING", True)
        and state["speed_fraction"] == 1.0
        and not any(state["tcp_offset"])
    )


@pytest.fixture
def arm(station: Station) -> Iterator[UrArm]:
    arm = new_arm(station.host)
    arm.open(control=True)
    yield arm
    arm.close()


def new_arm(host: str) -> UrArm:
    return UrArm(host, speed_rad_s=radians(60) / TIME_SCALE, acceleration_rad_s2=radians(200) / TIME_SCALE)


def no_guard() -> None:
    pass


def away(arm: UrArm, by_rad: float = STEP_RAD) -> list[float]:
    """Joint angles with joint 6 turned away from where it is, back and forth."""
    q: list[float] = arm.state().q_rad.tolist()
    q[5] += by_rad if q[5] < 0.5 else -by_rad
    return q


def moves_again(arm: UrArm) -> None:
    """Open it again, as its errors say, and move."""
    t0 = time.monotonic()
    arm.open(control=True)
    arm.move_to(away(arm, 0.05), timeout_s=10, guard=no_guard)
    assert time.monotonic() - t0 < RESUMED_S


def wait_until_moving(arm: UrArm) -> Callable[[], bool]:
    assert arm._reader is not None
    reader, q0 = arm._reader, arm.state().q_rad[5]
    return lambda: abs(reader.look().q_rad[5] - q0) > 0.1


class Once:
    """A guard that does something once `when` is true, and remembers when that was."""

    def __init__(self, do: Callable[[], object], when: Callable[[], bool] = lambda: True) -> None:
        self._do, self._when = do, when
        self.t_s: float | None = None

    def __call__(self) -> None:
        if self.t_s is None and self._when():
            self.t_s = time.monotonic()
            self._do()

    def ago_s(self) -> float:
        assert self.t_s is not None, "it was never done"
        return time.monotonic() - self.t_s


# ---------------------------------------------------------------------- the controller and the links


@each_event
def test_in_move(station: Station, arm: UrArm, event: Event) -> None:
    q = away(arm)
    provoke = Once(lambda: event.do(station), wait_until_moving(arm))
    with pytest.raises(event.error, match=event.says):
        arm.move_to(q, timeout_s=10, guard=provoke)
    assert provoke.ago_s() < event.told_s
    if event.reachable:
        station.wait_for(lambda state: not state["moving"] and state["runtime_state"] == "STOPPED", within_s=1.0)
        assert abs(station.do("state")["q_rad"][5] - q[5]) > 0.1
    event.cure(station)
    station.wait_for(lambda state: not state["moving"], within_s=3)  # whatever it was, it is one move long
    where = station.do("state")["q_rad"]
    moves_again(arm)
    assert abs(station.do("state")["q_rad"][5] - where[5]) < 0.06  # and nothing of the old move was resumed


@each_event
def test_at_rest(station: Station, arm: UrArm, event: Event) -> None:
    if event.name != "foreign-program":  # while it stands, it may be anybody's program
        provoke = Once(lambda: event.do(station))
        with pytest.raises(event.error, match=event.says):
            arm.wait_until_still(timeout_s=5, guard=provoke)
        assert provoke.ago_s() < DETECTED_S
        event.cure(station)
        moves_again(arm)
    q = away(arm, 0.05)
    event.do(station)  # nobody looks
    t0 = time.monotonic()
    with pytest.raises(event.error, match=event.says):
        arm.move_to(q, timeout_s=10, guard=no_guard)
    assert time.monotonic() - t0 < event.told_s
    event.cure(station)
    moves_again(arm)


@pytest.mark.parametrize("event", [event for event in EVENTS if event.hits_opening], ids=str)
def test_while_opening(station: Station, event: Event, monkeypatch: pytest.MonkeyPatch) -> None:
    start = ControlProcess.__init__
    provoke = Once(lambda: event.do(station))

    def provoking(self: ControlProcess, host: str, frequency_Hz: float) -> None:
        provoke()  # all was well, and the control process is about to start
        start(self, host, frequency_Hz)

    monkeypatch.setattr(ControlProcess, "__init__", provoking)
    arm = new_arm(station.host)
    with pytest.raises(ConnectError, match=event.says):
        arm.open(control=True)
    assert provoke.ago_s() < 5
    event.cure(station)
    moves_again(arm)
    arm.close()


@pytest.mark.parametrize(
    "event", [event for event in EVENTS if event.name not in ("power-off", "program-stop", "rtde-reset")], ids=str
)
def test_while_closing(station: Station, arm: UrArm, event: Event) -> None:
    assert arm._control is not None
    moving = wait_until_moving(arm)
    arm._control.call("move", away(arm), 0.3, 1.0)
    while not moving():
        arm._control.call("progress")
    event.do(station)
    t0 = time.monotonic()
    arm.close()
    assert time.monotonic() - t0 < 2.0
    if event.reachable and event.name != "foreign-program":
        station.wait_for(lambda state: not state["moving"] and state["runtime_state"] == "STOPPED", within_s=1.0)
    event.cure(station)
    moves_again(arm)


@pytest.mark.parametrize(
    ("do", "cure"),
    [
        (on("reduced", on=True), on("reduced", on=False)),
        (on("remote-control", on=False), on("remote-control", on=True)),
        (on("drop", what="dashboard"), nothing),
        (on("drop", what="script", reset=True), nothing),
        (on("listen", what="dashboard", on=False), on("listen", what="dashboard", on=True)),
        (on("silent", what="dashboard", on=True), on("silent", what="dashboard", on=False)),
    ],
    ids=["reduced", "local-mode", "dashboard-fin", "script-reset", "dashboard-refused", "dashboard-silent"],
)
def test_what_disturbs_no_move(station: Station, arm: UrArm, do: Act, cure: Act) -> None:
    q = away(arm, 0.5)
    arm.move_to(q, timeout_s=10, guard=Once(lambda: do(station), wait_until_moving(arm)))
    arm.wait_until_still(timeout_s=5, guard=no_guard)
    assert np.allclose(arm.state().q_rad, q, atol=1e-4)
    cure(station)


def test_a_controller_that_comes_back_is_still_told_to_stop(station: Station, arm: UrArm) -> None:
    q = away(arm)
    provoke = Once(lambda: station.do("freeze", on=True), wait_until_moving(arm))
    with pytest.raises(DeviceTimeout, match="press the emergency stop"):
        arm.move_to(q, timeout_s=10, guard=provoke)
    assert provoke.ago_s() < DETECTED_S
    station.do("freeze", on=False)
    station.wait_for(lambda state: not state["moving"] and state["runtime_state"] == "STOPPED", within_s=1.0)
    assert abs(station.do("state")["q_rad"][5] - q[5]) > 0.1


def test_an_old_attempt_to_stop_does_not_end_the_next_move(station: Station, arm: UrArm) -> None:
    q = away(arm)
    station.do("silent", what="dashboard", on=True)
    station.do("silent", what="rtde", on=True)
    with pytest.raises(LOST):
        arm.move_to(q, timeout_s=10, guard=no_guard)
    station.do("silent", what="rtde", on=False)
    station.do("dashboard-stop")  # somebody else has stopped it meanwhile
    before = len(station.do("state")["events"])
    threading.Timer(0.8, lambda: station.do("silent", what="dashboard", on=False)).start()
    moves_again(arm)
    arm.close()
    told = [event["what"] for event in station.do("state", since=before)["events"] if event["by"] == "dashboard"]
    assert "stop" not in told


def test_a_slider_at_zero(station: Station, arm: UrArm) -> None:
    q = away(arm)
    provoke = Once(lambda: station.do("slider", fraction=0.0), wait_until_moving(arm))
    with pytest.raises(DeviceTimeout, match="check the speed slider"):
        arm.move_to(q, timeout_s=1.0, guard=provoke)
    station.do("slider", fraction=1.0)
    where = arm.state().q_rad
    arm.wait_until_still(timeout_s=5, guard=no_guard)
    assert np.allclose(arm.state().q_rad, where, atol=1e-3)  # nothing was left to be done
    arm.move_to(q, timeout_s=10, guard=no_guard)  # without opening it again


def test_an_end_told_before_the_goal_is_no_arrival(
    station: Station, arm: UrArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    where, q = arm.state().q_rad, away(arm)
    station.do("slider", fraction=0.0)
    call = ControlProcess.call

    def hasty(self: ControlProcess, name: str, *args: object, **how: Any) -> object:
        return [True, False] if name == "progress" else call(self, name, *args, **how)

    with monkeypatch.context() as patch:
        patch.setattr(ControlProcess, "call", hasty)  # as ur_rtde says it after it has connected again by itself
        with pytest.raises(DeviceFault, match=r"the move ended at .* instead of"):
            arm.move_to(q, timeout_s=10, guard=no_guard)
    station.do("slider", fraction=1.0)
    arm.wait_until_still(timeout_s=5, guard=no_guard)
    assert np.allclose(arm.state().q_rad, where, atol=1e-3)  # nothing was left to be done
    arm.move_to(q, timeout_s=10, guard=no_guard)


def test_a_move_paused_by_a_protective_stop_cannot_be_played(station: Station, arm: UrArm) -> None:
    provoke = Once(lambda: station.do("protective-stop"), wait_until_moving(arm))
    with pytest.raises(DeviceFault, match="protective stop"):
        arm.move_to(away(arm), timeout_s=10, guard=provoke)
    station.wait_for(lambda state: not state["moving"])
    where = station.do("state")["q_rad"]
    unlock(station)
    station.do("play")
    time.sleep(0.2)  # nothing has to happen
    assert station.do("state")["q_rad"] == pytest.approx(where, abs=1e-6)
    moves_again(arm)


def test_a_new_arm_moves_after_a_protective_stop(station: Station, arm: UrArm) -> None:
    station.do("protective-stop")
    arm.close()
    another = new_arm(station.host)
    with pytest.raises(ConnectError, match="protective stop"):
        another.open(control=True)
    unlock(station)
    try:
        moves_again(another)
    finally:
        another.close()


def test_a_program_of_somebody_else_is_not_stopped_by_leaving(
    station: Station, arm: UrArm, caplog: pytest.LogCaptureFixture
) -> None:
    another_takes_over(station)
    arm.close()
    assert "somebody else: it is left alone" in caplog.text
    assert plays_another(station)
    arm.open()  # reading is fine
    arm.state()
    station.do("dashboard-stop")


def test_a_program_of_somebody_else_found_before_a_move_is_left_alone(station: Station, arm: UrArm) -> None:
    q = away(arm)
    another_takes_over(station)
    with pytest.raises(DeviceFault, match="another program may have been started"):
        arm.move_to(q, timeout_s=10, guard=no_guard)
    assert plays_another(station)
    arm.close()
    assert plays_another(station)
    station.do("dashboard-stop")


def test_a_program_that_cannot_be_asked_is_ended_by_leaving(
    station: Station, arm: UrArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> object:
        raise StreamBroken("the control connection was lost")

    monkeypatch.setattr(ControlProcess, "call", fail)
    arm.close()
    assert station.do("state")["runtime_state"] == "STOPPED"


@pytest.mark.parametrize("paused", [False, True], ids=["playing", "paused"])
def test_a_program_of_somebody_else_is_never_ended_for_a_start(station: Station, paused: bool) -> None:
    q = station.do("state")["q_rad"]
    q[5] += -STEP_RAD if q[5] > 0.5 else STEP_RAD
    station.do("foreign-program", q_rad=q, speed_rad_s=0.5 / TIME_SCALE)
    station.wait_for(lambda state: state["moving"])
    if paused:
        station.dashboard("pause")
        station.wait_for(lambda state: state["runtime_state"] == "PAUSED")
    before = len(station.do("state")["events"])
    said = refused(station)
    assert re.search(r"not started is on .* \((PLAYING|PAUSED) .*\) and is not ended; stop it at the pendant", said)
    state = station.do("state", since=before)
    assert not [event for event in state["events"] if event["by"] in ("script port", "program")]
    assert not [event for event in state["events"] if event["by"] == "dashboard" and event["what"] == "stop"]
    assert state["program"] == "other"
    station.do("dashboard-stop")


def test_a_program_that_took_the_place_of_ours_is_not_ended_when_the_arm_is_opened_again(
    station: Station, arm: UrArm
) -> None:
    another_takes_over(station)
    with pytest.raises(ConnectError, match="stop it at the pendant"):
        arm.open(control=True)
    assert plays_another(station)
    station.do("dashboard-stop")
    moves_again(arm)


def test_what_runs_after_ours_was_seen_to_have_ended_is_not_ours(station: Station, arm: UrArm) -> None:
    assert arm._control is not None
    os.kill(arm._control.pid, signal.SIGKILL)  # so that nobody can ask it whose program it runs
    station.wait_for(lambda _: arm._control is not None and not arm._control.alive)
    station.do("dashboard-stop")
    arm.open()
    another_takes_over(station)
    with pytest.raises(ConnectError, match="stop it at the pendant"):
        arm.open(control=True)
    assert plays_another(station)
    station.do("dashboard-stop")


# ---------------------------------------------------------------------- sentences


def refused(station: Station, *, control: bool = True, model: str | None = None) -> str:
    arm = UrArm(station.host, model=model)
    t0 = time.monotonic()
    with pytest.raises(ConnectError) as caught:
        arm.open(control=control)
    arm.close()
    assert time.monotonic() - t0 < 5
    return str(caught.value)


def test_registers_of_a_fieldbus(station: Station) -> None:
    station.do("claim-registers", range="lower", on=True)
    said = refused(station)
    station.do("claim-registers", range="lower", on=False)
    assert "EtherNet/IP" in said
    assert "input_int_register_0" in said
    station.do("claim-registers", range="upper", on=True)
    arm = new_arm(station.host)
    moves_again(arm)  # these are not ours
    arm.close()
    station.do("claim-registers", range="upper", on=False)


def test_a_second_client_does_not_stop_the_first(station: Station, arm: UrArm) -> None:
    said: list[str] = []
    q = away(arm, 0.8)
    trying = threading.Thread(target=lambda: said.append(refused(station)))
    arm.move_to(q, timeout_s=10, guard=Once(trying.start, wait_until_moving(arm)))
    trying.join()
    assert "another client" in said[0]
    assert arm.state().q_rad == pytest.approx(q, abs=1e-3)


def test_local_mode_keeps_the_running_program(station: Station) -> None:
    another_takes_over(station)
    station.do("remote-control", on=False)
    assert "press Local, Remote Control" in refused(station)
    assert plays_another(station)
    station.do("remote-control", on=True)
    station.do("dashboard-stop")


@pytest.mark.parametrize(("mode", "cure"), [(3, "power the arm on"), (5, "release its brakes")])
def test_an_arm_that_is_not_ready(station: Station, mode: int, cure: str) -> None:
    station.do("mode", robot=mode)
    assert cure in refused(station)
    station.do("mode", robot=7)


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("rtde", "cannot be reached .*check the address and the cable"),
        (
            "dashboard",
            "dashboard server.*enable the dashboard server at the pendant under Settings, Security, Services",
        ),
        ("script", "30003.*enable the real-time client interface under Settings, Security, Services"),
    ],
)
def test_services_that_are_off(station: Station, what: str, says: str) -> None:
    station.do("listen", what=what, on=False)
    said = refused(station)
    station.do("listen", what=what, on=True)
    assert re.search(says, said), said


def test_a_silent_dashboard(station: Station) -> None:
    station.do("silent", what="dashboard", on=True)
    said = refused(station)
    station.do("silent", what="dashboard", on=False)
    assert "did not answer" in said


# ---------------------------------------------------------------------- our own processes

APPLICATION = """
import sys
from drivers.errors import DriverError
from drivers.ur.arm import UrArm
arm = UrArm(sys.argv[1], speed_rad_s=float(sys.argv[2]), acceleration_rad_s2=3.0)
arm.open(control=True)
print(arm._control.pid, flush=True)
q = arm.state().q_rad
q[5] += -1.2 if q[5] > 0.5 else 1.2
try:
    arm.move_to(q.tolist(), timeout_s=20, guard=lambda: None)
    print("arrived", abs(arm.state().q_rad[5] - q[5]) < 1e-3, flush=True)
except DriverError as error:
    print(type(error).__name__, error, flush=True)
arm.close()
"""


@dataclass
class Application:
    process: subprocess.Popen[str]
    child: int

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()


@pytest.fixture
def application(station: Station, tmp_path: Path) -> Iterator[Application]:
    """An application in the middle of a move."""
    script = tmp_path / "application.py"
    script.write_text(APPLICATION)
    speed = str(radians(60) / TIME_SCALE)
    process = subprocess.Popen(
        [sys.executable, script, station.host, speed], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert process.stdout is not None
    application = Application(process, int(process.stdout.readline()))
    station.wait_for(lambda state: state["moving"], within_s=20)
    yield application
    for pid in (process.pid, application.child):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.communicate(timeout=10)


def test_both_processes_killed(station: Station, application: Application) -> None:
    os.kill(application.child, signal.SIGKILL)
    application.process.kill()
    assert station.do("state")["moving"]  # nobody is left to stop it
    said = refused(station)  # nobody can tell it from a program of somebody else
    assert "is not ended; stop it at the pendant, then start again" in said
    station.wait_for(lambda state: not state["moving"], within_s=3)
    assert station.do("state")["runtime_state"] == "PLAYING"
    station.do("dashboard-stop")
    arm = new_arm(station.host)
    moves_again(arm)
    arm.close()


def test_killed_and_started_again_at_once(station: Station, application: Application) -> None:
    application.process.kill()
    arm = new_arm(station.host)
    moves_again(arm)  # although the child is still at work
    arm.close()


def test_suspended_in_a_move(station: Station, application: Application) -> None:
    os.kill(application.process.pid, signal.SIGSTOP)
    station.wait_for(lambda state: not state["moving"], within_s=2.0)
    os.kill(application.process.pid, signal.SIGCONT)
    assert "keep the computer awake" in application.line()
    assert application.process.wait(10) == 0


def test_both_processes_suspended(station: Station, application: Application) -> None:
    for pid in (application.process.pid, application.child):
        os.kill(pid, signal.SIGSTOP)
    station.wait_for(lambda state: not state["moving"], within_s=5.0)
    for pid in (application.child, application.process.pid):
        os.kill(pid, signal.SIGCONT)
    assert re.match("arrived True|DeviceTimeout .*keep the computer awake", application.line())
    assert application.process.wait(10) == 0


WATCHER = """
import sys
from drivers.ur.arm import UrArm
arm = UrArm(sys.argv[1])
arm.open()
print("open", flush=True)
for _ in sys.stdin:
    state = arm.state()
    look = arm._reader.look()
    print(state.q_rad[5], look.q_rad[5], flush=True)
arm.close()
"""


def test_nothing_old_is_believed(station: Station, arm: UrArm) -> None:
    watcher = subprocess.Popen(
        [sys.executable, "-c", WATCHER, station.host],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    assert watcher.stdin is not None
    assert watcher.stdout is not None
    try:
        assert watcher.stdout.readline() == "open\n"
        os.kill(watcher.pid, signal.SIGSTOP)
        q = away(arm)
        arm.move_to(q, timeout_s=10, guard=no_guard)
        arm.wait_until_still(timeout_s=5, guard=no_guard)
        watcher.stdin.write("\n")  # it is asked the moment it wakes up, with seconds of old samples in its sockets
        watcher.stdin.flush()
        os.kill(watcher.pid, signal.SIGCONT)
        told = [float(word) for word in watcher.stdout.readline().split()]
        assert told == pytest.approx([q[5], q[5]], abs=1e-3)
    finally:
        watcher.kill()
        watcher.communicate()


def test_a_guard_that_hangs(station: Station, arm: UrArm) -> None:
    def hang() -> None:
        station.wait_for(lambda state: not state["moving"], within_s=2.0)

    q = away(arm)
    with pytest.raises(DeviceTimeout, match=r"nothing was heard .* for 0\.5 s of a move"):
        arm.move_to(q, timeout_s=10, guard=Once(hang, wait_until_moving(arm)))
    assert abs(arm.state().q_rad[5] - q[5]) > 0.1
    arm.move_to(q, timeout_s=10, guard=no_guard)  # and it is still ours
