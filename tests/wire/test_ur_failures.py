"""What can go wrong with the controller, its links and our processes, at every moment of using the arm.

Required of every row: reported as below, with a fix; the arm stopped, or known to be finishing the one move it was
given; no crash; after the operator has cleared it, `open(control=True)` on the same object moves the arm again. We
never unlock and never play. The limits themselves are proved in `tests/unit/drivers/ur`; times, also
of processes of ours that are killed or suspended, stand in docs/contributing/figures/devices.md.

======================  ================  =============================  ==========================================
event                   what is raised    arm                            test of this file
======================  ================  =============================  ==========================================
protective stop,        `DeviceFault`     stopped by the controller;     `test_in_move`,
emergency stop,                           what is left of the program    settling and idle: `test_at_rest`;
safeguard, power lost,                    is ended: no client can        opening: `test_while_opening`;
brakes closed                             resume it                      closing: `test_while_closing`
program stopped,        `DeviceFault`     stopped by the controller      the same
paused or crashed,
another program
RTDE closed (FIN, RST)  `StreamBroken`    stopped through the dashboard  the same
RTDE silent, then back  `DeviceTimeout`   stopped through the dashboard  the same
all links cut, silent   `StreamBroken`,   finishes its move: nothing of  the same; `test_in_move` sees it stand
or refused              `DeviceTimeout`   ours can reach it. Stopped by
                                          itself on the path script
dashboard lost          nothing           goes on, and arrives           `test_what_disturbs_no_move`
local mode, reduced     nothing           goes on, and arrives           `test_what_disturbs_no_move`
slider at zero          `DeviceTimeout`   stopped, still ours            `test_a_slider_at_zero`
our process killed      -                 stopped by the child, or by    `test_ur_arm.py`, `test_heartbeat.py`
                                          itself on the path script
the child killed, hung  `StreamBroken`,   stopped through the dashboard  `test_ur_arm.py`
                        `DeviceTimeout`
program of others       `ConnectError`    goes on: nothing of theirs     `test_a_program_of_another_client_is_never…`,
at a start              of the opening    is touched                     `test_a_program_that_took_the_place_of_ours…`
program of others       `DeviceFault`     goes on: nothing of theirs     `…_of_another_client_found_before…`
before a move                             is touched
end off the goal        `DeviceFault`     stopped                        `test_an_end_before_the_goal…`
======================  ================  =============================  ==========================================
"""

import os
import re
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from ftdrivers.clock import REAL
from ftdrivers.errors import ConnectError, DeviceError, DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.ur import opening
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.control import Control, ControlPath
from ftdrivers.ur.control_process import ControlProcess
from ftdrivers.ur.script_control import ScriptControl
from ftdrivers.ur.timing import UrTiming
from tests.wire.conftest import ACCELERATION_RAD_S2, SPEED_RAD_S, TIME_SCALE, Station, on_ur_rtde, one_path
from tests.wire.moves import STEP_RAD, away, no_guard
from tests.wire.waiting import control_process

MOVE_S = 60.0
EMULATED = replace(UrTiming.emulated(), ours_s=2.0, ours_again_s=2.0, ours_closing_s=2.0, release_s=1.0, braking_s=5.0)
"""Here other clients never answer, brake or let go."""
CONTROLS: dict[ControlPath, type[Control]] = {"ur-rtde": ControlProcess, "script": ScriptControl}
slow = pytest.mark.slow

NewArm = Callable[..., UrArm]


# ---------------------------------------------------------------------- the events and their fixes

Act = Callable[[Station], object]


def on(verb: str, **how: object) -> Act:
    return lambda station: station.ask(verb, **how)


def nothing(_: Station) -> None:
    pass


def unlock(station: Station) -> None:
    while not station.ask("unlock")["accepted"]:  # refused for 5 s after the stop
        station.clock.sleep(0.05)


def power_up(station: Station) -> None:
    station.dashboard("power on")
    station.wait_for(lambda state: state["robot_mode"] == "IDLE")
    station.dashboard("brake release")
    station.wait_for(lambda state: state["robot_mode"] == "RUNNING")


def release(station: Station) -> None:
    station.ask("emergency-stop", on=False)
    power_up(station)


def cut(station: Station, *, connected: bool) -> None:
    """Pull all cables, as TCP sees it, or plug them in."""
    for what in ("rtde", "dashboard", "script", "primary"):
        station.ask("listen", what=what, on=connected)
        if not connected:
            station.ask("drop", what=what, reset=True)


def another_takes_over(station: Station) -> None:
    """Another client starts a program that touches nothing and plays for 100 s: longer than anybody takes to ask."""
    station.ask("foreign-program", seconds=1000)
    station.wait_for(lambda _: plays_another(station))


def plays_another(station: Station) -> bool:
    state = station.ask("state")
    return bool((state["program"], state["runtime_state"]) == ("other", "PLAYING"))


@dataclass(frozen=True)
class Event:
    name: str
    do: Act
    fix: Act
    error: type[DeviceError] | tuple[type[DeviceError], ...]
    says: str
    reachable: bool = True
    """Whether the controller can still receive a stop."""
    hits_opening: bool = True
    """Whether it matters before a program of ours runs."""

    def __str__(self) -> str:
        return self.name


LOST = (StreamBroken, DeviceTimeout)
EVENTS = [
    Event("protective-stop", on("protective-stop"), unlock, DeviceFault, r"protective stop .* remove its cause"),
    Event(
        "emergency-stop", on("emergency-stop", on=True), release, DeviceFault, r"emergency stop .* release the button"
    ),
    Event(
        "safeguard",
        on("safeguard", on=True),
        on("safeguard", on=False),
        DeviceFault,
        r"safeguard stop .* close the safeguard",
    ),
    Event("power-off", lambda s: s.dashboard("power off"), power_up, DeviceFault, "power the arm on"),
    Event("brakes", on("mode", robot=5), on("mode", robot=7), DeviceFault, r"\(idle\); release its brakes"),
    Event("program-stop", on("dashboard-stop"), nothing, DeviceFault, "was stopped from outside", hits_opening=False),
    Event(
        "program-pause", lambda s: s.dashboard("pause"), nothing, DeviceFault, "stopped or paused", hits_opening=False
    ),
    Event("crash-script", on("crash-script"), nothing, DeviceFault, "ended by itself|in line", hits_opening=False),
    Event(
        "foreign-program",
        another_takes_over,
        on("dashboard-stop"),
        DeviceFault,
        "does not answer: another program",
        hits_opening=False,
    ),
    Event("rtde-fin", on("drop", what="rtde"), nothing, StreamBroken, "check the robot and the cable"),
    Event("rtde-reset", on("drop", what="rtde", reset=True), nothing, StreamBroken, "check the robot and the cable"),
    Event(
        "rtde-silent",
        on("silent", what="rtde", on=True),
        on("silent", what="rtde", on=False),
        LOST,
        "press the emergency|by itself",
    ),
    Event(
        "cable",
        on("silence-arm", on=True),
        on("silence-arm", on=False),
        LOST,
        "press the emergency|by itself",
        reachable=False,
    ),
    Event("freeze", on("freeze", on=True), on("freeze", on=False), LOST, "been stuck|sent nothing", reachable=False),
    Event(
        "cut",
        lambda s: cut(s, connected=False),
        lambda s: cut(s, connected=True),
        LOST,
        "check the robot",
        reachable=False,
    ),
]

NAMES = [event.name for event in EVENTS]


def events(*, auto: Sequence[str] = NAMES, script: Sequence[str], fast: str = "") -> pytest.MarkDecorator:
    """Parametrize by control path and event; slow but for one.

    Most of what is done about an event is the same on both paths: every event befalls each path at some moment, and
    where the paths differ it is the same moment.
    """
    return pytest.mark.parametrize(
        ("control", "event"),
        [
            pytest.param(path, event, marks=[] if (path, event.name) == ("auto", fast) else [slow])
            for path, names in (("auto", auto), ("script", script))
            for event in EVENTS
            if event.name in names
        ],
        indirect=["control"],
        ids=str,
    )


@pytest.fixture
def station(station: Station) -> Iterator[Station]:
    before = len(station.ask("state")["events"])
    yield station
    if station.process.poll() is None:
        diary = station.ask("state", since=before)["events"]
        ours = [event["what"] for event in diary if event["by"] == "dashboard" and event["accepted"]]
        assert not [what for what in ours if "play" in what or "unlock" in what], ours


@pytest.fixture
def new_arm(new_arm: NewArm) -> NewArm:
    return lambda **how: new_arm(**({"timing": EMULATED} | how))


def opened(arm: UrArm) -> UrArm:
    arm.open(control=True)
    return arm


def moves_again(arm: UrArm) -> None:
    """Open it again, as its errors say, and move."""
    arm.open(control=True)
    arm.move_to(away(arm, 0.05), timeout_s=MOVE_S, guard=no_guard)


def wait_until_moving(arm: UrArm) -> Callable[[], bool]:
    q0 = arm.state().q_rad[5]
    return lambda: abs(arm.state().q_rad[5] - q0) > 0.1


class Once:
    """A guard that does something once `when` is true, and remembers when that was."""

    def __init__(self, do: Callable[[], object], when: Callable[[], bool] = lambda: True) -> None:
        self._do, self._when = do, when
        self.t_s: float | None = None

    def __call__(self) -> None:
        if self.t_s is None and self._when():
            self.t_s = REAL.now_s()
            self._do()

    def ago_s(self) -> float:
        assert self.t_s is not None, "it was never done"
        return REAL.now_s() - self.t_s


# ---------------------------------------------------------------------- the controller and the links


@events(
    fast="protective-stop",
    script=[
        *("protective-stop", "program-stop", "program-pause", "crash-script", "foreign-program", "rtde-silent"),
        *("cable", "freeze", "cut"),
    ],
)
def test_in_move(station: Station, new_arm: NewArm, event: Event, control: ControlPath) -> None:
    arm = opened(new_arm())
    q = away(arm)
    with pytest.raises(event.error, match=event.says):
        arm.move_to(q, timeout_s=MOVE_S, guard=Once(lambda: event.do(station), wait_until_moving(arm)))
    if event.reachable:
        state = station.wait_for(lambda state: not state["moving"] and state["runtime_state"] == "STOPPED")
        assert abs(state["q_rad"][5] - q[5]) > 0.1
    event.fix(station)
    where = station.wait_for(lambda state: not state["moving"])["q_rad"]  # whatever it was, it is one move long
    if control == "script":  # it stops itself
        assert abs(where[5] - q[5]) > 0.1
    moves_again(arm)
    assert abs(station.ask("state")["q_rad"][5] - where[5]) < 0.06  # and nothing of the old move was resumed


@events(
    auto=["protective-stop", "program-stop", "foreign-program", "rtde-silent", "cut"],
    script=["power-off", "rtde-reset"],
)
def test_at_rest(station: Station, new_arm: NewArm, event: Event) -> None:
    arm = opened(new_arm())
    if event.name != "foreign-program":  # while it stands, it may be anybody's program
        with pytest.raises(event.error, match=event.says):
            arm.wait_until_still(timeout_s=30, guard=Once(lambda: event.do(station)))
        event.fix(station)
        moves_again(arm)
    q = away(arm, 0.05)
    event.do(station)  # without a watcher
    with pytest.raises(event.error, match=event.says):
        arm.move_to(q, timeout_s=MOVE_S, guard=no_guard)
    event.fix(station)
    moves_again(arm)


@events(
    auto=["protective-stop", "rtde-fin", "rtde-silent", "cable", "freeze", "cut"], script=["emergency-stop", "brakes"]
)
def test_while_opening(
    station: Station, new_arm: NewArm, event: Event, control: ControlPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind: Any = CONTROLS[control]
    provoke = Once(lambda: event.do(station))

    def provoking(*args: object, **how: object) -> Control:
        provoke()  # all was well, and the control path is about to start
        made: Control = kind(*args, **how)
        return made

    monkeypatch.setattr(opening, kind.__name__, provoking)
    arm = new_arm()
    with pytest.raises(ConnectError, match=event.says):
        arm.open(control=True)
    event.fix(station)
    moves_again(arm)


@events(
    auto=["protective-stop", "program-pause", "foreign-program", "rtde-silent", "cable"],
    script=["safeguard", "rtde-fin"],
)
def test_while_closing(station: Station, controls: list[Control], new_arm: NewArm, event: Event) -> None:
    arm = opened(new_arm())
    moving = wait_until_moving(arm)
    controls[-1].call("move", away(arm), SPEED_RAD_S, ACCELERATION_RAD_S2)
    while not moving():
        controls[-1].call("progress")
    event.do(station)
    arm.close()
    if event.reachable and event.name != "foreign-program":
        station.wait_for(lambda state: not state["moving"] and state["runtime_state"] == "STOPPED")
    event.fix(station)
    moves_again(arm)


@slow
@one_path
@pytest.mark.parametrize(
    ("do", "fix"),
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
def test_what_disturbs_no_move(station: Station, arm: UrArm, do: Act, fix: Act) -> None:
    q = away(arm, 0.5)
    arm.move_to(q, timeout_s=MOVE_S, guard=Once(lambda: do(station), wait_until_moving(arm)))
    arm.wait_until_still(timeout_s=30, guard=no_guard)
    assert np.allclose(arm.state().q_rad, q, atol=1e-4)
    fix(station)


@slow
@pytest.mark.parametrize("control", ["script"], indirect=True)
def test_the_port_of_our_program_may_close_in_a_move(station: Station, arm: UrArm) -> None:
    """As it does when the pendant is switched to local control."""
    q = away(arm, 0.5)

    def switch() -> None:
        station.ask("remote-control", on=False)
        station.ask("drop", what="primary")

    arm.move_to(q, timeout_s=MOVE_S, guard=Once(switch, wait_until_moving(arm)))
    assert np.allclose(arm.state().q_rad, q, atol=1e-3)
    station.ask("remote-control", on=True)


@slow
@one_path
def test_a_slider_at_zero(station: Station, arm: UrArm) -> None:
    q = away(arm)
    provoke = Once(lambda: station.ask("slider", fraction=0.0), wait_until_moving(arm))
    with pytest.raises(DeviceTimeout, match="check the speed slider"):
        arm.move_to(q, timeout_s=1.0, guard=provoke)
    station.ask("slider", fraction=1.0)
    where = arm.state().q_rad
    arm.wait_until_still(timeout_s=30, guard=no_guard)
    assert np.allclose(arm.state().q_rad, where, atol=1e-3)  # nothing was left to be done
    arm.move_to(q, timeout_s=MOVE_S, guard=no_guard)  # without opening it again


@slow
@one_path
def test_an_end_before_the_goal_is_no_arrival(
    station: Station, control: ControlPath, arm: UrArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    where, q = arm.state().q_rad, away(arm)
    station.ask("slider", fraction=0.0)
    kind = CONTROLS[control]
    call = kind.call

    def hasty(self: Control, name: str, *args: object, **how: Any) -> object:
        return [True, False] if name == "progress" else call(self, name, *args, **how)

    with monkeypatch.context() as patch:
        patch.setattr(kind, "call", hasty)  # as ur_rtde says it after it has connected again by itself
        with pytest.raises(DeviceFault, match="instead of"):
            arm.move_to(q, timeout_s=MOVE_S, guard=no_guard)
    station.ask("slider", fraction=1.0)
    arm.wait_until_still(timeout_s=30, guard=no_guard)
    assert np.allclose(arm.state().q_rad, where, atol=1e-3)  # nothing was left to be done
    arm.move_to(q, timeout_s=MOVE_S, guard=no_guard)


@slow
def test_a_move_paused_by_a_protective_stop_cannot_be_played(station: Station, arm: UrArm) -> None:
    provoke = Once(lambda: station.ask("protective-stop"), wait_until_moving(arm))
    with pytest.raises(DeviceFault, match="protective stop"):
        arm.move_to(away(arm), timeout_s=MOVE_S, guard=provoke)
    station.wait_for(lambda state: not state["moving"])
    where = station.ask("state")["q_rad"]
    unlock(station)
    station.ask("play")
    station.clock.sleep(0.2)  # nothing has to happen
    assert station.ask("state")["q_rad"] == pytest.approx(where, abs=1e-6)
    moves_again(arm)


@slow
@one_path
def test_a_program_of_another_client_is_not_stopped_by_leaving(
    station: Station, arm: UrArm, caplog: pytest.LogCaptureFixture
) -> None:
    another_takes_over(station)
    arm.close()
    assert "is not stopped" in caplog.text
    assert plays_another(station)
    arm.open()  # reading is fine
    arm.state()
    station.ask("dashboard-stop")


@slow
@one_path
def test_a_program_of_another_client_found_before_a_move_is_left_alone(station: Station, arm: UrArm) -> None:
    q = away(arm)
    another_takes_over(station)
    with pytest.raises(DeviceFault, match="does not answer: another program"):
        arm.move_to(q, timeout_s=MOVE_S, guard=no_guard)
    assert plays_another(station)
    arm.close()
    assert plays_another(station)
    station.ask("dashboard-stop")


@slow
def test_a_program_that_cannot_be_asked_is_ended_by_leaving(
    station: Station, control: ControlPath, arm: UrArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> object:
        raise StreamBroken("the control connection was lost")

    monkeypatch.setattr(CONTROLS[control], "call", fail)
    arm.close()
    assert station.ask("state")["runtime_state"] == "STOPPED"


@slow
@pytest.mark.parametrize("paused", [False, True], ids=["playing", "paused"])
def test_a_program_of_another_client_is_never_ended_for_a_start(station: Station, paused: bool) -> None:
    q = station.ask("state")["q_rad"]
    q[5] += -STEP_RAD if q[5] > 0.5 else STEP_RAD
    station.ask("foreign-program", q_rad=q, speed_rad_s=0.5 / TIME_SCALE)
    station.wait_for(lambda state: state["moving"])
    if paused:
        station.dashboard("pause")
        station.wait_for(lambda state: state["runtime_state"] == "PAUSED")
    before = len(station.ask("state")["events"])
    error = refused(station)
    assert re.search(r"\((PLAYING|PAUSED) .*\) and is not stopped", error.found)
    assert "stop it on the pendant" in error.fix
    state = station.ask("state", since=before)
    assert not [event for event in state["events"] if event["by"] in ("script port", "program")]
    assert not [event for event in state["events"] if event["by"] == "dashboard" and event["what"] == "stop"]
    assert state["program"] == "other"
    station.ask("dashboard-stop")


@slow
@one_path
def test_a_program_that_took_the_place_of_ours_is_not_ended_when_the_arm_is_opened_again(
    station: Station, arm: UrArm
) -> None:
    another_takes_over(station)
    with pytest.raises(ConnectError, match="stop it on the pendant"):
        arm.open(control=True)
    assert plays_another(station)
    station.ask("dashboard-stop")
    moves_again(arm)


@slow
@on_ur_rtde
def test_what_runs_after_ours_was_seen_to_have_ended_is_not_ours(
    station: Station, controls: list[Control], arm: UrArm
) -> None:
    os.kill(control_process(), signal.SIGKILL)  # so that it cannot be asked whose program it runs
    station.wait_for(lambda _: not controls[-1].alive)
    station.ask("dashboard-stop")
    # A sample on its way can be from before the stop.
    station.wait_for(lambda _: arm.status().program == "stopped")
    arm.open()
    another_takes_over(station)
    with pytest.raises(ConnectError, match="stop it on the pendant"):
        arm.open(control=True)
    assert plays_another(station)
    station.ask("dashboard-stop")


# ---------------------------------------------------------------------- sentences


def refused(station: Station, **how: Any) -> ConnectError:
    arm = station.arm(**({"timing": EMULATED} | how))
    with pytest.raises(ConnectError) as caught:
        arm.open(control=True)
    arm.close()
    return caught.value
