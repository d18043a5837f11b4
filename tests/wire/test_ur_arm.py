"""`UrArm` and the unmodified ur_rtde against the emulated controller, which runs as a process of its own.

What the controller and its links may do to it is in `test_ur_failures.py`.
"""

import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from math import radians
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.errors import ConnectError, DeviceFault, DeviceTimeout, StreamBroken
from drivers.ur.arm import UrArm
from drivers.ur.control import ControlProcess
from drivers.ur.kinematics import MODELS, forward
from drivers.ur.live import LiveReader

pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this platform")

ROOT = Path(__file__).parents[2]
STEP_RAD = 1.2  # 1.6 s at the speed of these tests: long enough to be interrupted
TCP = (0.1, -0.02, 0.25, 0.3, -1.2, 0.7)


class Station(Protocol):
    """What the tests use of the emulator's process."""

    process: subprocess.Popen[str]
    host: str

    def do(self, verb: str, /, **how: object) -> dict[str, Any]: ...

    def wait_for(self, condition: Callable[[dict[str, Any]], bool], within_s: float = 2.0) -> None: ...

    def dashboard(self, command: str) -> str: ...


def closes_quickly(arm: UrArm) -> None:
    for _ in range(2):
        t0 = time.monotonic()
        arm.close()
        assert time.monotonic() - t0 < 1.5


def no_guard() -> None:
    pass


def away(arm: UrArm, by_rad: float = STEP_RAD) -> list[float]:
    """Joint angles with joint 6 turned away from where it is, back and forth."""
    q: list[float] = arm.state().q_rad.tolist()
    q[5] += by_rad if q[5] < 0.5 else -by_rad
    return q


class Trigger:
    """A guard that does something once the arm moves, and remembers when."""

    def __init__(self, arm: UrArm, do: Callable[[], object]) -> None:
        self._arm, self._do, self._q0 = arm, do, arm.state().q_rad[5]
        self.t_s: float | None = None
        self.calls = 0

    def __call__(self) -> None:
        self.calls += 1
        assert self._arm._reader is not None
        if self.t_s is None and abs(self._arm._reader.look().q_rad[5] - self._q0) > 0.1:
            self._do()
            self.t_s = time.monotonic()

    def ago_s(self) -> float:
        assert self.t_s is not None, "the arm never moved"
        return time.monotonic() - self.t_s


# ---------------------------------------------------------------------- reading


def assert_flange_is_right(arm: UrArm) -> None:
    state = arm.state()
    nominal = forward(MODELS["UR5e"], state.q_rad)  # an emulated arm is exactly nominal
    assert np.allclose(state.R_base_flange, nominal.R, atol=1e-6)
    assert np.allclose(state.p_base_flange_m, nominal.p_m, atol=1e-6)
    assert arm._reader is not None
    tcp = Rotation.from_rotvec(arm._reader.look().tcp_pose[3:])
    assert (tcp.inv() * Rotation.from_matrix(nominal.R)).magnitude() > 0.5  # there is something to take off


def test_the_flange_does_not_depend_on_the_tcp(
    start_station: Callable[..., Station], new_arm: Callable[..., UrArm]
) -> None:
    arm = new_arm(start_station("--tcp", ",".join(map(str, TCP))).host)
    arm.open()
    assert_flange_is_right(arm)


def test_a_tcp_set_on_the_way_does_not_change_the_flange(station: Station, new_arm: Callable[..., UrArm]) -> None:
    arm = new_arm()
    arm.open()
    before = arm.state()
    station.do("set-tcp", tcp=TCP)
    assert_flange_is_right(arm)
    assert np.allclose(arm.state().R_base_flange, before.R_base_flange, atol=1e-9)


def test_old_controllers_need_control_to_tell_the_tcp(
    station: Station, new_arm: Callable[..., UrArm], monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs = {name: kind for name, kind in LiveReader._outputs.items() if name != "tcp_offset"}
    monkeypatch.setattr(LiveReader, "_outputs", outputs)
    arm = new_arm()
    arm.open()
    assert arm.status().tcp_offset is None
    with pytest.raises(ConnectError, match="too old to tell its active TCP"):
        arm.state()
    arm.open(control=True)
    station.do("set-tcp", tcp=TCP)
    assert_flange_is_right(arm)


def test_a_tcp_that_changes_while_reading_never_gives_a_wrong_flange(
    station: Station, new_arm: Callable[..., UrArm]
) -> None:
    arm = new_arm()
    arm.open()
    expected = arm.state()
    done = threading.Event()

    def fiddle() -> None:
        try:
            for k in range(40):
                station.do("set-tcp", tcp=[0.01 * k, 0, 0.2, 0.05 * k, 0, 0])
                time.sleep(0.02)
        finally:
            done.set()

    fiddler = threading.Thread(target=fiddle)
    fiddler.start()
    reads = 0
    while not done.is_set():
        state = arm.state()
        assert np.allclose(state.p_base_flange_m, expected.p_base_flange_m, atol=1e-6)
        assert np.allclose(state.R_base_flange, expected.R_base_flange, atol=1e-6)
        reads += 1
    fiddler.join()
    assert reads > 20


def test_reading_disturbs_nothing_and_needs_no_remote_control(
    station: Station, arm: UrArm, new_arm: Callable[..., UrArm]
) -> None:
    reader = new_arm()
    q = away(arm)
    seen: list[float] = []

    def read_along() -> None:
        if not seen:
            station.do("remote-control", on=False)
            reader.open()
        seen.append(reader.state().q_rad[5])

    arm.move_to(q, timeout_s=10, guard=read_along)
    assert len(set(seen)) > 5  # it saw the arm move
    with pytest.raises(ConnectError, match="reading only"):
        reader.move_to(q, timeout_s=1, guard=no_guard)
    reader.wait_until_still(timeout_s=2, guard=no_guard)
    reader.stop()  # does nothing
    reader.close()
    assert station.do("state")["runtime_state"] == "PLAYING"
    station.do("remote-control", on=True)


def test_identity_and_clock(station: Station, new_arm: Callable[..., UrArm]) -> None:
    arm = new_arm()
    with pytest.raises(ConnectError, match="not open"):
        arm.state()
    arm.open()
    arm.open()
    info = arm.identify()
    assert (info.model, info.serial) == ("UR5e", "20225500001")
    assert info.firmware.startswith("5.15")
    first, second = arm.state(), arm.state()
    assert second.t_device_s > first.t_device_s
    assert 0 <= time.monotonic_ns() - second.t_host_ns < 100e6
    assert first.q_rad == pytest.approx(station.do("state")["q_rad"], abs=1e-6)


def test_status_is_what_the_controller_says_now(station: Station, new_arm: Callable[..., UrArm]) -> None:
    arm = new_arm()
    arm.open()
    status = arm.status()
    assert (status.robot_mode, status.safety_mode, status.program) == ("running", "normal", "stopped")
    assert status.fault is None
    assert 0 < status.speed_slider <= 1
    assert 0 < status.speed_scaling <= 1
    assert status.payload_kg is not None
    assert status.payload_kg >= 0
    assert status.p_flange_payload_m is not None
    assert len(status.p_flange_payload_m) == 3
    assert 0 <= time.monotonic_ns() - status.t_host_ns < 100e6
    assert arm.in_remote_control()
    station.do("set-tcp", tcp=TCP)
    station.do("remote-control", on=False)
    station.do("protective-stop")
    time.sleep(0.1)  # what a status may be old
    status = arm.status()
    assert status.tcp_offset == pytest.approx(TCP)
    assert status.safety_mode == "protective stop"
    assert "find and remove its cause" in str(status.fault)
    assert arm.in_remote_control() is False
    station.do("freeze")
    time.sleep(0.1)
    with pytest.raises(DeviceTimeout, match="stood still"):
        arm.status()


@pytest.mark.parametrize("stopped", [False, True])
def test_others_may_look_and_stop_while_the_arm_moves(station: Station, arm: UrArm, stopped: bool) -> None:
    q0, q, done = arm.state().q_rad[5], away(arm), threading.Event()
    seen: list[tuple[float, str]] = []  # joint 6, program
    failures: list[Exception] = []

    def look_along() -> None:
        try:
            while not done.is_set():
                seen.append((arm.state().q_rad[5], arm.status().program))
                if stopped and abs(seen[-1][0] - q0) > 0.2:
                    arm.stop()
                    assert not station.do("state")["moving"]  # it returns when the arm stands
                    return
        except Exception as error:
            failures.append(error)

    lookers = [threading.Thread(target=look_along) for _ in range(1 if stopped else 3)]
    for looker in lookers:
        looker.start()
    try:
        if stopped:
            with pytest.raises(DeviceFault, match="told to stop"):
                arm.move_to(q, timeout_s=10, guard=no_guard)
        else:
            arm.move_to(q, timeout_s=10, guard=no_guard)
    finally:
        done.set()
        for looker in lookers:
            looker.join(5)
    assert not failures
    assert {program for _, program in seen} == {"playing"}
    assert stopped or len({angle for angle, _ in seen}) > 10  # they saw the arm move
    here = arm.state().q_rad
    assert (abs(here[5] - q[5]) > 0.1) == stopped
    arm.move_to(here.tolist(), timeout_s=5, guard=no_guard)


def test_wrong_model_is_refused(new_arm: Callable[..., UrArm]) -> None:
    with pytest.raises(ConnectError, match="is a UR5e, not a UR10e"):
        new_arm(model="ur10e").open()
    new_arm(model="ur7e").open()  # the same arm under a newer name


def test_an_arm_far_from_its_nominal_kinematics_is_refused(
    start_station: Callable[..., Station], new_arm: Callable[..., UrArm]
) -> None:
    with pytest.raises(ConnectError, match=r"mm and .* degrees from where a UR5e has it .* another model"):
        new_arm(start_station("--dh-noise", "30").host).open()
    new_arm(start_station("--dh-noise", "1").host).open()  # as an arm comes from the factory


# ---------------------------------------------------------------------- moving


def test_move_stillness_and_limits(station: Station, arm: UrArm) -> None:
    q = away(arm, 0.6)
    calls: list[float] = []
    t0 = time.monotonic()
    arm.move_to(q, timeout_s=10, guard=lambda: calls.append(time.monotonic()))
    assert len(calls) / (time.monotonic() - t0) > 20
    arm.wait_until_still(timeout_s=5, guard=no_guard)
    assert 0.6 < time.monotonic() - t0 < 3
    state = arm.state()
    assert np.allclose(state.q_rad, q, atol=1e-4)
    assert np.abs(state.qd_rad_s).max() < 0.002
    arm.move_to(q, timeout_s=10, guard=no_guard)  # nowhere to go is a move too
    assert arm.within_safety_limits(q)
    arm.open(control=True)  # nothing happens
    closes_quickly(arm)
    assert station.do("state")["runtime_state"] == "STOPPED"


def test_what_the_controller_refuses(start_station: Callable[..., Station], new_arm: Callable[..., UrArm]) -> None:
    station = start_station("--joint-limit-deg", "170")
    arm = new_arm(station.host)
    arm.open(control=True)
    q = arm.state().q_rad.tolist()
    assert arm.within_safety_limits(q)
    q[5] = radians(175)
    assert not arm.within_safety_limits(q)
    station.do("protective-stop")
    with pytest.raises(DeviceFault, match="protective stop"):  # not "no"
        arm.within_safety_limits(q)


@pytest.mark.parametrize("by", ["guard", "ctrl-c", "stop", "time-out"])
def test_whatever_ends_the_wait_stops_the_arm_and_leaves_it_usable(station: Station, arm: UrArm, by: str) -> None:
    class EnoughError(Exception):
        pass

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
    trigger = Trigger(arm, do)
    with pytest.raises(error):
        arm.move_to(q, timeout_s=0.6 if by == "time-out" else 10, guard=trigger)
    assert not station.do("state")["moving"]
    here = arm.state().q_rad
    assert abs(here[5] - q[5]) > 0.1
    arm.move_to(here.tolist(), timeout_s=5, guard=no_guard)


def test_a_second_ctrl_c_does_not_let_the_arm_move_on(
    station: Station, arm: UrArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    q = away(arm)
    trigger = Trigger(arm, lambda: signal.raise_signal(signal.SIGINT))
    call = ControlProcess.call

    def interrupted(self: ControlProcess, name: str, *args: object, **how: Any) -> object:
        if name == "stop":
            raise KeyboardInterrupt
        return call(self, name, *args, **how)

    monkeypatch.setattr(ControlProcess, "call", interrupted)
    with pytest.raises(KeyboardInterrupt):
        arm.move_to(q, timeout_s=10, guard=trigger)
    station.wait_for(lambda state: not state["moving"], within_s=0.5)
    assert abs(station.do("state")["q_rad"][5] - q[5]) > 0.1


def test_close_in_the_middle_of_a_move_stops_the_arm(station: Station, arm: UrArm) -> None:
    assert arm._control is not None
    q = away(arm)
    arm._control.call("move", q, 1.0, 3.0)
    station.wait_for(lambda state: state["moving"])
    closes_quickly(arm)
    state = station.do("state")
    assert not state["moving"]
    assert state["runtime_state"] == "STOPPED"
    assert abs(state["q_rad"][5] - q[5]) > 0.1


@pytest.mark.parametrize(
    ("q_rad", "says"),
    [([0.0] * 5, "six"), ([0.0] * 5 + [float("nan")], "six finite"), ([0, -90, 0, 0, 0, 0], "are these radians")],
)
def test_bad_targets_never_leave_the_house(q_rad: list[float], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        UrArm("127.83.0.9").move_to(q_rad, timeout_s=1, guard=no_guard)
    with pytest.raises(ValueError, match=says):
        UrArm("127.83.0.9").within_safety_limits(q_rad)


# ---------------------------------------------------------------------- faults


def test_a_controller_that_is_gone(station: Station, arm: UrArm) -> None:
    trigger = Trigger(arm, station.process.kill)
    with pytest.raises(StreamBroken, match="lost"):
        arm.move_to(away(arm), timeout_s=10, guard=trigger)
    assert trigger.ago_s() < 1.5


def test_a_control_process_that_is_gone(station: Station, arm: UrArm) -> None:
    assert arm._control is not None
    pid = arm._control.pid
    q = away(arm)
    trigger = Trigger(arm, lambda: os.kill(pid, signal.SIGKILL))
    with pytest.raises(StreamBroken, match="control"):
        arm.move_to(q, timeout_s=10, guard=trigger)
    assert trigger.ago_s() < 0.5
    station.wait_for(lambda state: not state["moving"], within_s=0.5)
    assert abs(station.do("state")["q_rad"][5] - q[5]) > 0.1
    with pytest.raises(StreamBroken, match="open the arm again"):
        arm.move_to(q, timeout_s=10, guard=no_guard)
    arm.open(control=True)
    arm.move_to(q, timeout_s=10, guard=no_guard)


def test_a_control_process_that_hangs(station: Station, arm: UrArm, caplog: pytest.LogCaptureFixture) -> None:
    assert arm._control is not None
    pid = arm._control.pid
    trigger = Trigger(arm, lambda: os.kill(pid, signal.SIGSTOP))
    with caplog.at_level(logging.WARNING), pytest.raises(DeviceTimeout, match="did not answer"):
        arm.move_to(away(arm), timeout_s=10, guard=trigger)
    assert trigger.ago_s() < 1.0
    station.wait_for(lambda state: not state["moving"], within_s=0.5)
    assert not caplog.records  # the second way to stop it worked
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


# ---------------------------------------------------------------------- opening


def test_nobody_there() -> None:
    t0 = time.monotonic()
    with pytest.raises(ConnectError, match="cannot be reached"):
        UrArm("127.83.0.9").open()
    assert time.monotonic() - t0 < 3


def test_silent_server_does_not_freeze_the_interpreter() -> None:
    ticks: list[float] = []
    done = threading.Event()

    def tick() -> None:
        while not done.wait(0.02):
            ticks.append(time.monotonic())

    ticker = threading.Thread(target=tick)
    ticker.start()
    with socket.create_server((f"127.83.{os.getpid() % 251}.7", 30004)) as server:
        t0 = time.monotonic()
        with pytest.raises(ConnectError, match="did not answer"):
            UrArm(server.getsockname()[0]).open()
        assert time.monotonic() - t0 < 3
    done.set()
    ticker.join()
    assert np.diff(ticks).max() < 0.5


def test_a_powered_off_arm(station: Station, new_arm: Callable[..., UrArm]) -> None:
    arm = new_arm()
    station.dashboard("power off")
    station.wait_for(lambda state: state["robot_mode"] != "RUNNING")
    with pytest.raises(ConnectError, match="power the arm on"):
        arm.open(control=True)
    arm.open()
    assert arm.identify().serial == "20225500001"
    with pytest.raises(DeviceFault, match="does not measure its joints"):
        arm.state()


# ---------------------------------------------------------------------- applications that end badly

APPLICATION = """
import sys
from drivers.ur.arm import UrArm
from drivers.ur.control import ControlProcess
print("main")
arm = UrArm(sys.argv[1], speed_rad_s=1.0, acceleration_rad_s2=3.0)
try:
    arm.open(control=True)
    q = arm.state().q_rad
    q[5] += -1.2 if q[5] > 0.5 else 1.2
    print("moving", flush=True)
    arm.move_to(q.tolist(), timeout_s=10, guard=lambda: None)
except KeyboardInterrupt:
    print("interrupted")
finally:
    arm.close()
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_the_arm_stops_with_its_application(
    station: Station, new_arm: Callable[..., UrArm], tmp_path: Path, how: signal.Signals
) -> None:
    script = tmp_path / "application.py"
    script.write_text(APPLICATION)
    application = subprocess.Popen(
        [sys.executable, script, station.host], stdout=subprocess.PIPE, start_new_session=True, text=True, cwd=ROOT
    )
    station.wait_for(lambda state: state["moving"], within_s=20)
    os.killpg(application.pid, how)  # as a terminal does it
    station.wait_for(lambda state: not state["moving"] and state["runtime_state"] == "STOPPED", within_s=1.5)
    out, _ = application.communicate(timeout=10)
    expected = ["main", "moving"] + (["interrupted"] if how == signal.SIGINT else [])
    assert out.split() == expected  # neither a second run of the application nor a word of the library
    arm = new_arm()
    arm.open(control=True)
    arm.move_to(away(arm, 0.2), timeout_s=10, guard=no_guard)
