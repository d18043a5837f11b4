"""The control path through a program of ours: its text, the heartbeat, what ends it; on a fake clock."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ftdrivers.errors import ConnectError, DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.sweep import Sweep
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.control import ControlSetting
from ftdrivers.ur.primary import Code, Failed, Note, Stopped
from ftdrivers.ur.script_control import OUTPUTS, STOPS_ITSELF_S, program_text
from ftdrivers.ur.timing import STRICT
from tests.fake_clock import FakeClock
from tests.unit.drivers.ur.controller_in_memory import CYCLE_S, Controller, MakeArm, away, no_guard
from tests.unit.drivers.ur.program_in_memory import Script


@pytest.fixture
def path() -> ControlSetting:
    return "script"


# ---------------------------------------------------------------------- the program


@pytest.mark.parametrize("version", [(3, 15), (5, 9), (5, 10), (10, 11)])
def test_the_program_is_complete(version: tuple[int, int]) -> None:
    text = program_text(123456, version, 2.5)
    code = [line.split("#")[0].strip() for line in text.splitlines()]
    assert "$" not in "".join(code)
    assert "ft_token = 123456" in code[[line.startswith("def ") for line in code].index(True) + 1]
    assert "ft_deceleration = 2.5000" in text
    assert ("set_target_payload(" in text) == (version >= (5, 10))
    opened = sum(bool(re.match(r"(def|thread|if|while)\b.*:$", line)) for line in code)
    assert opened == code.count("end")
    assert text.isascii()


# ---------------------------------------------------------------------- the heartbeat


@pytest.mark.usefixtures("arm")
def test_a_repeated_sample_is_no_sign_of_life(
    script: Script, controller: Controller, clock: FakeClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    repeated = script.registers.far.t_s
    monkeypatch.setattr(script.link, "decode", lambda _: script_control_sample(script, repeated))
    clock.advance(2 * CYCLE_S)
    before = script.registers.inputs[0]
    clock.advance(0.3)
    assert script.registers.inputs[0] == before
    assert not controller.control.alive


def script_control_sample(script: Script, t_s: float) -> dict[str, NDArray[np.float64]]:
    return {name: np.array([value]) for name, value in zip(OUTPUTS, (t_s, *script.registers.outputs), strict=True)}


@pytest.mark.usefixtures("arm")
@pytest.mark.parametrize("how", ["suspended", "cut", "killed"])
@pytest.mark.parametrize("delay_s", [0.3, 0.305])
def test_an_arm_without_heartbeat_stops_within_three_tenths_of_a_second(
    script: Script, controller: Controller, clock: FakeClock, how: str, delay_s: float
) -> None:
    control = controller.control
    control.call("move", away(controller), 1.0, 3.0)
    clock.advance(delay_s)
    assert controller.goal_rad is not None
    last = script.registers.inputs[0]
    if how == "cut":
        script.link.cut = True
    else:
        control.suspended = True
        if how == "killed":
            script.link.closed = True
    clock.advance(STOPS_ITSELF_S)
    assert script.registers.inputs[0] == last
    assert controller.goal_rad is None
    assert controller.did[-1] == "stop softly"
    assert not script.registers.running
    assert script.registers.outputs[1] == -2


def test_a_lost_link_is_found_as_soon(arm: UrArm, script: Script, controller: Controller, clock: FakeClock) -> None:
    """Its own connection alone falls silent; the reader's goes on."""
    begin_s: list[float] = []

    def cut() -> None:
        script.link.cut = True
        begin_s.append(clock.now_s())

    clock.at(0.3, cut)
    with pytest.raises((StreamBroken, DeviceTimeout)) as error:
        arm.move_to(away(controller), timeout_s=5, guard=no_guard)
    assert clock.now_s() - begin_s[0] < 0.5
    assert "stop" in str(error.value)
    assert "emergency" not in str(error.value)
    assert controller.goal_rad is None


def test_after_a_suspension_the_reason_is_reported(arm: UrArm, controller: Controller, clock: FakeClock) -> None:
    control = controller.control

    def suspend() -> None:
        control.suspended = controller.held_back = True
        clock.advance(2.0)
        control.suspended = controller.held_back = False

    asleep = [suspend]
    with pytest.raises(DeviceTimeout, match=r"no heartbeat for 0\.2 s; keep the computer awake"):
        arm.move_to(away(controller), timeout_s=9, guard=lambda: (asleep and asleep.pop()()) or None)
    assert controller.goal_rad is None
    assert "dashboard stop" not in controller.did  # it could stop another program: ours has ended
    arm.open(control=True)
    arm.move_to(away(controller), timeout_s=5, guard=no_guard)


# ---------------------------------------------------------------------- nothing moves late


def test_a_program_that_starts_after_it_was_given_up_does_not_move(
    make_arm: MakeArm, script: Script, controller: Controller, clock: FakeClock
) -> None:
    controller.starts_in_s = 6.0
    with pytest.raises(ConnectError, match=r"did not start within 4\.5 s"):
        make_arm().open(control=True)
    clock.advance(3.0)
    assert "start our program" in controller.did
    assert script.registers.outputs[0] == 0  # it never became ready
    assert not script.registers.running


def test_an_old_command_is_not_carried_out(
    arm: UrArm, script: Script, controller: Controller, clock: FakeClock
) -> None:
    arm.move_to(away(controller), timeout_s=5, guard=no_guard)
    sequence = round(script.registers.inputs[2])
    before = list(controller.did)
    for old in (sequence, sequence - 1, 0):
        controller.control.send_again((old, 1, (0.0,) * 5 + (1.5, 1.0, 3.0, 0.0, 0.0)))
        clock.advance(5 * CYCLE_S)
    assert controller.did == before


# ---------------------------------------------------------------------- the start


@pytest.mark.parametrize(
    ("message", "read_only", "found", "fix"),
    [
        (Failed(17, 3, "compile_error_name_not_found:stopq:"), False, "line 17: compile_error", "other control path"),
        (Code(210, 0, ""), False, "accepts no programs", "remote control"),
        (Note("hello"), True, "closed the connection", "remote control"),
    ],
)
def test_a_program_that_is_not_taken(
    make_arm: MakeArm, script: Script, controller: Controller, message: object, read_only: bool, found: str, fix: str
) -> None:
    script.messages.append(message)  # type: ignore[arg-type]
    script.read_only = read_only
    with pytest.raises(ConnectError) as error:
        make_arm().open(control=True)
    assert found in error.value.found
    assert fix in error.value.fix
    assert controller.did == []  # there is nothing of ours to be stopped


def test_a_runtime_error_is_the_reason_of_an_ended_program(
    arm: UrArm, script: Script, controller: Controller, clock: FakeClock
) -> None:
    def crash() -> None:
        script.messages += [Failed(60, 5, "is a joint limit violated?"), Stopped("ftdrive_control")]
        controller.program = 1

    clock.at(0.3, crash)
    with pytest.raises(DeviceFault, match="line 60: is a joint limit violated"):
        arm.move_to(away(controller), timeout_s=5, guard=no_guard)


# ---------------------------------------------------------------------- settings and questions


def test_settings_and_questions_pass_through_the_registers(arm: UrArm, controller: Controller) -> None:
    arm.set_payload(1.5, (0.01, 0.0, 0.05), (0.1, 0.2, 0.3, 0.0, 0.0, -0.01))
    arm.set_gravity((0.0, 0.0, 9.82))
    assert controller.did[-2:] == [
        "payload 1.5 [0.01, 0.0, 0.05] [0.1, 0.2, 0.3, 0.0, 0.0, -0.01]",
        "gravity [0.0, 0.0, 9.82]",
    ]
    assert arm.within_safety_limits(controller.q_rad)
    assert not arm.within_safety_limits([*controller.q_rad[:5], 3.0])
    assert controller.control.call("tcp_offset") == pytest.approx(controller.tcp_offset)


# ---------------------------------------------------------------------- a sweep


def sweep_of(arm: UrArm) -> Sweep:
    return Sweep(arm.state().q_rad.tolist(), [[0.2, 0.02]] * 3, [[0.6, 4.0]] * 3, [[0.0, 1.0]] * 3, 3.0, 1.0)


def test_a_guard_stops_a_sweep(arm: UrArm, controller: Controller, clock: FakeClock) -> None:
    begun_s = clock.now_s()

    def guard() -> None:
        if clock.now_s() - begun_s > 1.0:
            raise RuntimeError("something is wrong")

    with pytest.raises(RuntimeError, match="something is wrong"):
        arm.sweep(sweep_of(arm), guard=guard)
    assert controller.goal_rad is None
    assert controller.did[-1] == "stop softly"


def test_a_sweep_from_elsewhere_is_rejected(arm: UrArm, controller: Controller) -> None:
    sweep = replace(sweep_of(arm), centre_rad=away(controller))
    with pytest.raises(DeviceFault, match="rejected the sweep"):
        arm.sweep(sweep, guard=no_guard)


@pytest.mark.usefixtures("arm")
def test_every_sample_is_answered_with_one_heartbeat(script: Script, clock: FakeClock) -> None:
    beats: list[float] = []
    for _ in range(20):
        clock.advance(CYCLE_S)
        beats.append(script.registers.inputs[0])
    assert len(set(beats)) == 20
    script.link.sent.clear()
    script.registers.far.silent = True
    before = script.registers.inputs[0]
    clock.advance(0.1)
    assert script.registers.inputs[0] == before


def test_the_error_of_another_program_is_not_ours(
    arm: UrArm, script: Script, controller: Controller, clock: FakeClock
) -> None:
    script.messages += [Failed(3, 1, "syntax_error_on_line:3:"), Stopped("other")]
    clock.advance(0.1)
    clock.at(0.3, lambda: setattr(controller, "program", 1))
    with pytest.raises(DeviceFault, match="ended by itself or was stopped from outside"):
        arm.move_to(away(controller), timeout_s=5, guard=no_guard)


@pytest.mark.parametrize("how", ["suspended", "cut"])
def test_a_sweep_without_heartbeat_stops(
    arm: UrArm, script: Script, controller: Controller, clock: FakeClock, how: str
) -> None:
    control, sweep = controller.control, sweep_of(arm)
    for k, wave in enumerate(sweep.waves.reshape(-1, 3).tolist()):
        control.call("wave", k, *wave)
    control.call("sweep", list(sweep.centre_rad), sweep.duration_s, sweep.ramp_s)
    clock.advance(0.3)
    assert controller.goal_rad is not None
    if how == "cut":
        script.link.cut = True
    else:
        control.suspended = True
    clock.advance(STOPS_ITSELF_S)
    assert controller.goal_rad is None
    assert script.registers.outputs[1] == -2


@pytest.mark.usefixtures("arm")
def test_a_silent_controller_is_lost_after_its_limit_and_not_before(controller: Controller, clock: FakeClock) -> None:
    controller.silent = True
    clock.advance(STRICT.stale_s - 3 * CYCLE_S)
    assert controller.control.alive
    clock.advance(3 * CYCLE_S)
    assert not controller.control.alive
    assert "the controller sent nothing for" in str(controller.control.end_reason())
