"""`UrArm` and the unmodified ur_rtde against the emulated controller, which runs as a process of its own.

What the controller and its links may do to it is in `test_ur_failures.py`; every limit of time in
`tests/unit/drivers/ur`.
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftdrivers.errors import ConnectError, DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.control import Control
from ftdrivers.ur.timing import UrTiming
from tests.wire.conftest import ACCELERATION_RAD_S2, SPEED_RAD_S, Station, on_ur_rtde, one_path
from tests.wire.moves import away, no_guard
from tests.wire.waiting import control_process

pytestmark = pytest.mark.slow  # every test needs a process of its own


NewArm = Callable[..., UrArm]


class Trigger:
    """A guard that does something once the arm moves."""

    def __init__(self, arm: UrArm, do: Callable[[], object]) -> None:
        self._arm, self._do, self._q0 = arm, do, arm.state().q_rad[5]
        self.done = False

    def __call__(self) -> None:
        if not self.done and abs(self._arm.state().q_rad[5] - self._q0) > 0.1:
            self.done = True
            self._do()


# ---------------------------------------------------------------------- reading


@one_path
def test_reading_disturbs_nothing_and_needs_no_remote_control(station: Station, arm: UrArm, new_arm: NewArm) -> None:
    reader = new_arm()
    q = away(arm)
    seen: list[float] = []

    def read_along() -> None:
        if not seen:
            station.ask("remote-control", on=False)
            reader.open()
        seen.append(reader.state().q_rad[5])

    arm.move_to(q, timeout_s=30, guard=read_along, speed_rad_s=0.3)  # a busy computer looks seldom
    assert len(set(seen)) > 5  # it saw the arm move
    with pytest.raises(ConnectError, match="reading only"):
        reader.move_to(q, timeout_s=1, guard=no_guard)
    reader.wait_until_still(timeout_s=10, guard=no_guard)
    reader.stop()  # does nothing
    reader.close()
    assert station.ask("state")["runtime_state"] == "PLAYING"
    station.ask("remote-control", on=True)


@pytest.mark.parametrize(
    ("control", "stopped"), [("auto", False), ("auto", True), ("script", True)], indirect=["control"]
)
def test_others_may_look_and_stop_while_the_arm_moves(station: Station, arm: UrArm, stopped: bool) -> None:
    # Long enough for a looker on a busy computer.
    q0, q, done = arm.state().q_rad[5], away(arm, 2.5), threading.Event()
    seen: list[tuple[float, str]] = []  # joint 6, program
    failures: list[Exception] = []

    def look_along() -> None:
        try:
            while not done.is_set():
                seen.append((arm.state().q_rad[5], arm.status().program))
                if stopped and abs(seen[-1][0] - q0) > 0.2:
                    arm.stop()
                    assert not station.ask("state")["moving"]  # it returns when the arm stands
                    return
        except Exception as error:
            failures.append(error)

    def move() -> None:
        arm.move_to(q, timeout_s=30, guard=no_guard)
        assert not failures, failures

    lookers = [threading.Thread(target=look_along) for _ in range(1 if stopped else 3)]
    for looker in lookers:
        looker.start()
    try:
        with pytest.raises(DeviceFault, match="stop was requested") if stopped else nullcontext():
            move()
    finally:
        done.set()
        for looker in lookers:
            looker.join(30)
    assert not failures
    assert {program for _, program in seen} == {"playing"}
    assert stopped or len({angle for angle, _ in seen}) > 10  # they saw the arm move
    here = arm.state().q_rad
    assert (abs(here[5] - q[5]) > 0.1) == stopped
    arm.move_to(here.tolist(), timeout_s=30, guard=no_guard)


# ---------------------------------------------------------------------- moving


@pytest.mark.parametrize("control", ["auto", "script"], indirect=True)
def test_move_stillness_and_limits(station: Station, arm: UrArm) -> None:
    q = away(arm, 0.6)
    calls: list[float] = []
    arm.move_to(q, timeout_s=30, guard=lambda: calls.append(station.clock.now_s()))
    assert len(calls) > 1  # before and during the move
    arm.wait_until_still(timeout_s=30, guard=no_guard)
    state = arm.state()
    assert np.allclose(state.q_rad, q, atol=1e-4)
    assert np.abs(state.qd_rad_s).max() < 0.002
    arm.move_to(q, timeout_s=30, guard=no_guard)  # nowhere to go is a move too
    assert arm.within_safety_limits(q)
    arm.open(control=True)  # nothing happens
    arm.close()
    arm.close()
    assert station.ask("state")["runtime_state"] == "STOPPED"


@one_path
def test_each_move_has_its_own_speed(station: Station, arm: UrArm) -> None:
    slow_rad_s, fast_rad_s2 = radians(3), radians(100)
    for by_rad, how, speed_rad_s, acceleration_rad_s2 in (
        (0.3, {}, SPEED_RAD_S, ACCELERATION_RAD_S2),
        (-0.3, {"speed_rad_s": slow_rad_s, "acceleration_rad_s2": fast_rad_s2}, slow_rad_s, fast_rad_s2),
    ):
        before = len(station.ask("state")["events"])
        q = arm.state().q_rad.tolist()
        q[5] += by_rad
        arm.move_to(q, timeout_s=30, guard=no_guard, **how)
        began_s, stood_s = (station.wait_for_event(what, since=before)["t_robot_s"] for what in ("moves", "stands"))
        expected_s = 0.3 / speed_rad_s + speed_rad_s / acceleration_rad_s2
        assert stood_s - began_s == pytest.approx(expected_s, rel=0.02)


class EnoughError(Exception):
    pass


@pytest.mark.parametrize("by", ["ctrl-c", "stop", "guard", "time-out"])
def test_whatever_ends_the_wait_stops_the_arm_and_leaves_it_usable(station: Station, arm: UrArm, by: str) -> None:
    def enough() -> None:
        raise EnoughError

    causes: dict[str, tuple[Callable[[], object], type[BaseException]]] = {
        "guard": (enough, EnoughError),
        "ctrl-c": (lambda: signal.raise_signal(signal.SIGINT), KeyboardInterrupt),
        "stop": (lambda: threading.Thread(target=arm.stop).start(), DeviceFault),
        "time-out": (no_guard, DeviceTimeout),
    }
    do, error = causes[by]
    q = away(arm)
    station.ask("slider", fraction=0.2)  # that a busy computer looks at it before it arrives
    with pytest.raises(error):
        arm.move_to(q, timeout_s=0.6 if by == "time-out" else 30, guard=Trigger(arm, do))
    assert not station.ask("state")["moving"]
    here = arm.state().q_rad
    assert abs(here[5] - q[5]) > 0.1
    station.ask("slider", fraction=1.0)
    arm.move_to(here.tolist(), timeout_s=30, guard=no_guard)


def test_a_second_ctrl_c_does_not_let_the_arm_move_on(
    station: Station, controls: list[Control], arm: UrArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    q = away(arm)
    kind = type(controls[-1])
    call = kind.call

    def interrupted(self: Control, name: str, *args: object, **how: Any) -> object:
        if name == "stop":
            raise KeyboardInterrupt
        return call(self, name, *args, **how)

    monkeypatch.setattr(kind, "call", interrupted)
    interrupt = Trigger(arm, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        # So slow that the arm still moves when a busy computer looks at it.
        arm.move_to(q, timeout_s=30, guard=interrupt, speed_rad_s=SPEED_RAD_S / 2)
    state = station.wait_for(lambda state: not state["moving"])
    assert abs(state["q_rad"][5] - q[5]) > 0.1


def test_close_in_the_middle_of_a_move_stops_the_arm(station: Station, controls: list[Control], arm: UrArm) -> None:
    q = away(arm)
    controls[-1].call("move", q, SPEED_RAD_S, ACCELERATION_RAD_S2)
    station.wait_for(lambda state: state["moving"])
    arm.close()
    state = station.ask("state")
    assert not state["moving"]
    assert state["runtime_state"] == "STOPPED"
    assert abs(state["q_rad"][5] - q[5]) > 0.1


# ---------------------------------------------------------------------- faults


@on_ur_rtde
def test_a_control_process_that_is_gone(station: Station, arm: UrArm) -> None:
    pid = control_process()
    q = away(arm)
    with pytest.raises(StreamBroken, match="control"):
        arm.move_to(q, timeout_s=30, guard=Trigger(arm, lambda: os.kill(pid, signal.SIGKILL)))
    state = station.wait_for(lambda state: not state["moving"])
    assert abs(state["q_rad"][5] - q[5]) > 0.1
    with pytest.raises(StreamBroken, match="open the arm again"):
        arm.move_to(q, timeout_s=30, guard=no_guard)
    arm.open(control=True)
    arm.move_to(q, timeout_s=30, guard=no_guard)


@on_ur_rtde
def test_a_control_process_that_hangs(station: Station, new_arm: NewArm, caplog: pytest.LogCaptureFixture) -> None:
    arm = new_arm(timing=replace(UrTiming.emulated(), progress_s=2.0))
    arm.open(control=True)
    pid = control_process()
    with pytest.raises(DeviceTimeout, match="did not answer"):
        arm.move_to(away(arm), timeout_s=30, guard=Trigger(arm, lambda: os.kill(pid, signal.SIGSTOP)))
    station.wait_for(lambda state: not state["moving"] and state["runtime_state"] == "STOPPED")
    assert not [record for record in caplog.records if record.levelname == "WARNING"]  # the second way worked
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


# ---------------------------------------------------------------------- applications that end badly

APPLICATION = """
import sys
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.timing import UrTiming
from ftdrive.cell.emulated_clock import EmulatedClock
print("main")
clock = EmulatedClock(sys.argv[2])
arm = UrArm(sys.argv[1], speed_rad_s=0.03, acceleration_rad_s2=0.3, clock=clock, timing=UrTiming.emulated())
try:
    arm.open(control=True)
    q = arm.state().q_rad
    q[5] += -1.2 if q[5] > 0.5 else 1.2
    print("moving", flush=True)
    arm.move_to(q.tolist(), timeout_s=30, guard=lambda: None)
except KeyboardInterrupt:
    print("interrupted")
finally:
    arm.close()
"""


@pytest.fixture
def application(station: Station, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """An application in the middle of a move of 4 s."""
    script = tmp_path / "application.py"
    script.write_text(APPLICATION)
    with subprocess.Popen(
        [sys.executable, script, station.host, station.hello["clock"]],
        stdout=subprocess.PIPE,
        start_new_session=True,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as application:
        try:
            station.wait_for(lambda state: state["moving"])
            yield application
        finally:
            application.kill()


@one_path
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_the_arm_stops_with_its_application(
    station: Station, application: subprocess.Popen[str], new_arm: NewArm, how: signal.Signals
) -> None:
    q0 = station.ask("state")["q_rad"][5]
    os.killpg(application.pid, how)  # as a terminal does it
    state = station.wait_for(lambda state: not state["moving"] and state["runtime_state"] == "STOPPED")
    assert abs(state["q_rad"][5] - q0) < 0.9
    out, _ = application.communicate(timeout=30)
    expected = ["main", "moving"] + (["interrupted"] if how == signal.SIGINT else [])
    assert out.split() == expected  # neither a second run of the application nor a word of the library
    arm = new_arm()
    arm.open(control=True)
    arm.move_to(away(arm, 0.2), timeout_s=30, guard=no_guard)
