"""What a `Reader` believes of what a controller sends, and for how long it waits, on a fake clock."""

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from ftdrivers.errors import ConnectError, DeviceFault, DeviceTimeout, ProtocolError, StreamBroken
from ftdrivers.interfaces import ArmStates
from ftdrivers.ur.kinematics import MODELS, Kinematics, forward
from ftdrivers.ur.reading import Reader
from ftdrivers.ur.sample import Sample
from ftdrivers.ur.timing import STRICT
from tests.fake_clock import FakeClock
from tests.own_kinematics import drawn, real
from tests.unit.drivers.ur.controller_in_memory import (
    Controller,
    ReaderInMemory,
    ServicesInMemory,
    pose_from_ur,
)


@pytest.fixture
def reader(controller: Controller) -> Reader:
    return ReaderInMemory(controller, "UR5e")


def wait_s(clock: FakeClock, look: Callable[[], object], error: type[Exception]) -> float:
    """Expect this error; return after how long it came."""
    begin_s = clock.now_s()
    with pytest.raises(error):
        look()
    return clock.now_s() - begin_s


def never() -> list[float]:
    raise AssertionError("this controller reports its TCP by itself")


# ---------------------------------------------------------------------- new samples


@pytest.mark.parametrize("paused_s", [0.15, 3.0, 3600.0])
def test_what_has_piled_up_in_a_pause_is_not_now(
    controller: Controller, reader: Reader, clock: FakeClock, paused_s: float
) -> None:
    reader.look()
    controller.held_back = True
    clock.advance(min(paused_s, 3.0))
    clock.stall(paused_s)
    controller.held_back = False
    woke_s = controller.t_s
    controller.safety_mode = 3
    assert reader.look().t_device_s > woke_s
    assert reader.status().safety_mode == "protective stop"


@pytest.fixture
def full_rate(controller: Controller) -> ReaderInMemory:
    """A reader of an e-Series arm."""
    controller.period_s = 0.002
    return ReaderInMemory(controller, "UR5e")


def test_a_clock_that_stood_still_is_trusted_again_after_a_second(
    controller: Controller, full_rate: ReaderInMemory, clock: FakeClock
) -> None:
    clock.advance(2.0)
    controller.stood_still_s = 0.4
    with pytest.raises(DeviceTimeout, match=r"arrive 0\.40 s late"):
        full_rate.look()
    clock.advance(0.85)
    full_rate.look()


# ---------------------------------------------------------------------- silence


def test_silence_is_found_after_a_fifth_of_a_second(controller: Controller, reader: Reader, clock: FakeClock) -> None:
    reader.look()
    controller.silent = True
    assert not reader.silent
    assert wait_s(clock, reader.look, DeviceTimeout) == pytest.approx(0.2, abs=1e-6)
    assert reader.silent
    assert wait_s(clock, lambda: reader.look(limit_s=0.1), DeviceTimeout) == pytest.approx(0.1, abs=1e-6)
    controller.silent = False
    reader.look()
    assert not reader.silent


@pytest.mark.parametrize(
    ("failure", "raised"),
    [
        (StreamBroken("the controller closed the connection"), StreamBroken),
        (ConnectionResetError(), StreamBroken),
        (ProtocolError("RTDE data of 3 bytes"), ProtocolError),
    ],
)
def test_the_end_of_the_stream_is_raised_at_every_look(
    controller: Controller, reader: Reader, clock: FakeClock, failure: Exception, raised: type[Exception]
) -> None:
    reader.look()

    def fail() -> None:
        controller.failure = failure

    clock.at(0.05, fail)
    with pytest.raises(raised):  # noqa: PT012
        for _ in range(20):
            reader.look()
    for ask in (reader.look, reader.status, lambda: reader.state(never)):
        assert wait_s(clock, ask, raised) == 0


# ---------------------------------------------------------------------- the flange


def test_an_old_controller_is_asked_for_its_tcp_before_and_after(controller: Controller) -> None:
    controller.unknown = {"tcp_offset", "payload", "payload_cog"}
    reader = ReaderInMemory(controller, "UR5e")
    assert not reader.reports_tcp
    status = reader.status()
    assert (status.tcp_offset, status.payload_kg, status.p_flange_payload_m) == (None, None, None)
    answers = [[0.0] * 6, controller.tcp_offset, controller.tcp_offset, controller.tcp_offset]  # set on the way
    state = reader.state(lambda: answers.pop(0))
    np.testing.assert_allclose(state.p_base_flange_m, forward(MODELS["UR5e"], controller.q_rad).p_m, atol=1e-12)
    assert not answers
    changing = iter(range(100))
    with pytest.raises(DeviceFault, match="TCP"):
        reader.state(lambda: [float(next(changing))] * 6)


@pytest.mark.parametrize(
    ("mode", "name", "fix"),
    [
        (13, "three-position enabling stop", "hold the enabling device"),
        (15, "IMMI emergency stop", "moulding machine"),
        (19, "PROFIsafe safeguard stop", "safety PLC"),
        (20, "PROFIsafe emergency stop", "safety PLC"),
        (22, "safety API safeguard stop", "safety API"),
    ],
)
@pytest.mark.parametrize("bits", [0x410, 0x401])
def test_a_stop_whose_source_only_the_safety_mode_names(
    controller: Controller, reader: Reader, mode: int, name: str, fix: str, bits: int
) -> None:
    controller.safety_mode, controller.safety_bits = mode, bits
    reader.look()
    status = reader.status()
    assert status.safety_mode == name
    assert status.fault is not None
    assert (f"{name} (safety mode {mode})", fix in status.fault.fix) == (status.fault.found, True)


REAL_ARM = [7.4, 1.3]
"""mm and degrees from the nominal model, as the farthest of 30 real arms."""


@pytest.mark.parametrize(
    ("moved_mm", "turned_deg", "sends", "refused"),
    [
        (0, 0, None, None),
        (*REAL_ARM, None, None),
        (21, 0, None, "21.0 mm and 0.00 degrees .* no known model"),
        (0, 3.1, None, "3.10 degrees .* no known model"),
        (0.9, 0.09, MODELS["UR5e"], None),
        (1.1, 0, MODELS["UR5e"], "1.1 mm .* sent by the controller.* disagree"),
        (0, 0.11, MODELS["UR5e"], "0.11 degrees .* sent by the controller.* disagree"),
        (0, 0, drawn("UR5e"), "sent by the controller.* disagree"),
        (0, 0, MODELS["UR10e"], "sent by the controller.* disagree"),
    ],
)
def test_a_real_arm_is_read_and_what_contradicts_its_kinematics_is_refused(
    controller: Controller, moved_mm: float, turned_deg: float, sends: Kinematics | None, refused: str | None
) -> None:
    controller.kinematics = sends
    nudge = pose_from_ur([1e-3 * moved_mm, 0.0, 0.0, 0.0, math.radians(turned_deg), 0.0])
    controller.flange = lambda q: forward(MODELS["UR5e"], q) @ nudge
    reader = ReaderInMemory(controller, "UR5e")
    with nullcontext() if refused is None else pytest.raises(DeviceFault, match=refused):
        reader.state(never)


@pytest.mark.parametrize("is_a", ["UR3e", "UR5"])
@pytest.mark.parametrize("sends", [None, MODELS["UR5e"]])
def test_an_arm_of_another_model_is_refused(controller: Controller, is_a: str, sends: Kinematics | None) -> None:
    controller.kinematics = sends
    controller.flange = lambda q: forward(MODELS[is_a], q)
    reader = ReaderInMemory(controller, "UR5e")
    for controller.q_rad in np.random.default_rng(1).uniform(-3, 3, (5, 6)).tolist():
        with pytest.raises(DeviceFault, match=f"UR5e: the arm is another model, probably a {is_a}"):
            reader.state(never)


def test_a_moving_arm_may_be_a_control_cycle_behind(controller: Controller) -> None:
    reader = ReaderInMemory(controller, "UR5e")
    controller.qd_rad_s = [math.radians(20)] * 6
    controller.flange = lambda q: forward(MODELS["UR5e"], np.array(q) + 0.008 * math.radians(20))
    reader.state(never)
    controller.qd_rad_s = [0.0] * 6
    with pytest.raises(DeviceFault, match="TCP"):
        reader.state(never)


@pytest.mark.parametrize("number", sorted(real())[::5])
def test_a_real_arm_is_nearest_to_its_own_model(controller: Controller, number: str) -> None:
    model, own = real()[number]
    controller.flange = lambda q: forward(own, q)
    for controller.kinematics in (own, None):
        for controller.q_rad in np.random.default_rng(2).uniform(-np.pi, np.pi, (20, 6)).tolist():
            reader = ReaderInMemory(controller, None)
            reader.info = replace(reader.info, model=model)
            reader.state(never)
            reader.close()


# ---------------------------------------------------------------------- following


def test_a_follower_reads_every_sample_as_flange_poses(
    controller: Controller, full_rate: ReaderInMemory, clock: FakeClock
) -> None:
    tcps, joints, pieces = [], [], []
    with full_rate.follow() as follow:
        for k in range(30):
            controller.tcp_offset = [0.01 * k, 0.0, 0.2, 0.05 * k, 0.0, 0.0]
            controller.q_rad = [0.1, -1.2, 1.5, -0.7, -1.4, 0.01 * k]
            tcps.append(controller.tcp_offset)
            joints.append(controller.q_rad)
            clock.advance(0.002)
            if k % 7 == 6 or k == 29:
                pieces.append(follow.read(0.0))
        begin_s = clock.now_s()
        assert len(follow.read(0.001)) == 0
        assert clock.now_s() - begin_s == pytest.approx(0.001)
    states = ArmStates.concatenate(pieces)
    assert len(states) == 30
    np.testing.assert_allclose(np.diff(states.t_device_s), 0.002, atol=1e-9)
    np.testing.assert_allclose(np.diff(states.t_host_ns), 2_000_000, atol=1)
    assert states.q_rad.tolist() == joints
    nominal = [forward(MODELS["UR5e"], q) for q in joints]
    np.testing.assert_allclose(states.R_base_flange, [pose.R for pose in nominal], atol=1e-9)
    np.testing.assert_allclose(states.p_base_flange_m, [pose.p_m for pose in nominal], atol=1e-9)
    assert full_rate.n_followers == 0


def test_a_follower_finds_silence_as_quickly_as_a_look(
    controller: Controller, full_rate: ReaderInMemory, clock: FakeClock
) -> None:
    with full_rate.follow() as follow:
        clock.advance(0.01)
        controller.silent = True
        heard_s = clock.now_s()
        assert len(follow.read(0.05)) == 5
        with pytest.raises(DeviceTimeout, match=r"stuck at 100\.\d{3} s for 0\.20 s"):  # noqa: PT012
            for _ in range(100):
                follow.read(0.01)
        assert clock.now_s() - heard_s == pytest.approx(0.2, abs=0.003)
        controller.silent = False
        clock.advance(0.004)
        assert len(follow.read(0.1)) == 2
        controller.held_back = True
        clock.stall(0.5)
        with pytest.raises(DeviceTimeout, match="suspended or too busy"):
            follow.read(0.0)


# ---------------------------------------------------------------------- who it is


def test_a_controller_that_lacks_what_is_needed_is_refused(controller: Controller) -> None:
    controller.unknown = {"runtime_state", "payload", "payload_cog", "tcp_offset"}  # not the three younger ones
    with pytest.raises(ConnectError, match="runtime_state over RTDE"):
        ReaderInMemory(controller, "UR5e")


def test_another_model_is_refused(controller: Controller, monkeypatch: pytest.MonkeyPatch) -> None:
    info = ReaderInMemory(controller, None).info
    assert (info.model, info.serial, info.firmware) == ("UR5e", "20225500001", "5.15.0")
    monkeypatch.setattr(ServicesInMemory, "polyscope", lambda _: "5.15.0.1261331")
    assert ReaderInMemory(controller, None).info.firmware == "5.15.0.1261331"  # as reported
    monkeypatch.setattr(ServicesInMemory, "polyscope", lambda _: None)
    assert ReaderInMemory(controller, None).info.firmware == "5.15.0"  # that of RTDE
    assert ReaderInMemory(controller, "UR7e").info.model == "UR7e"  # its newer name
    with pytest.raises(ConnectError, match="UR5e, not a UR10e"):
        ReaderInMemory(controller, "UR10e")


# ---------------------------------------------------------------------- what a sample means


@pytest.mark.parametrize(
    ("different", "found", "fix"),
    [
        ({"safety_bits": 0x404}, "protective stop", "clear it"),
        ({"safety_bits": 0x4C0, "robot_mode": 3}, "emergency stop", "release the button"),
        ({"safety_bits": 0x420}, "emergency stop", "release the button"),
        ({"safety_bits": 0x410}, "safeguard stop", "safeguard"),
        ({"safety_bits": 0x408}, "recovery", "inside its limits"),
        ({"safety_bits": 0x600}, "violation or fault", "log"),
        ({"safety_bits": 0x400}, "safety reason", "log"),
        ({"robot_mode": 3}, "power off", "power the arm on"),
        ({"robot_mode": 5}, "idle", "release its brakes"),
        ({"robot_mode": 42}, "unknown", "power the arm on"),
    ],
)
def test_every_safety_stop_has_a_fix(reader: Reader, different: dict[str, int], found: str, fix: str) -> None:
    sample: Sample = replace(reader.look(), **different)  # type: ignore[arg-type]
    fault = sample.safety_fault()
    assert fault is not None
    assert found in fault.found
    assert fix in fault.fix
    assert sample.status().fault is not None


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_normal_and_reduced_mode_are_no_fault(reader: Reader, bits: int) -> None:
    sample = replace(reader.look(), safety_bits=bits, program_state=2)
    assert sample.safety_fault() is None
    assert sample.program_fault() is None
    fault = replace(sample, program_state=4).program_fault()
    assert fault is not None
    assert "paused" in fault.found


ROBOT_MODES = """
-1 no controller, 0 disconnected, 1 safety not confirmed, 2 booting, 3 power off, 4 power on, 5 idle, 6 backdrive,
7 running, 8 updating firmware, 9 unknown"""
SAFETY_MODES = """
1 normal, 2 reduced, 3 protective stop, 4 recovery, 5 safeguard stop, 6 system emergency stop, 7 robot emergency stop,
8 violation, 9 fault, 10 joint identification, 11 undefined, 21 unknown, 23 unknown"""
PROGRAM_STATES = "0 stopping, 1 stopped, 2 playing, 3 pausing, 4 paused, 5 resuming, 6 unknown"
SAFETY_BITS = """
2 protective stop, 3 recovery mode, 4 safeguard stop, 5 emergency stop, 6 emergency stop, 7 emergency stop,
8 safety violation or fault, 9 safety violation or fault, 10 stop for a safety reason"""


def rows(table: str) -> list[tuple[int, str]]:
    return [(int(number), words) for number, words in (one.split(maxsplit=1) for one in table.split(","))]


def test_numbers_have_the_names_of_the_rtde_guide(reader: Reader) -> None:
    sample = reader.look()
    for number, words in rows(ROBOT_MODES):
        assert replace(sample, robot_mode=number).status().robot_mode.startswith(words)
        assert replace(sample, robot_mode=number).measures == (words in {"idle", "backdrive", "running"})
    for number, words in rows(SAFETY_MODES):
        assert replace(sample, safety_mode=number).status().safety_mode.startswith(words)
    for number, words in rows(PROGRAM_STATES):
        assert replace(sample, program_state=number).status().program.startswith(words)
    for number, words in rows(SAFETY_BITS):
        assert str(replace(sample, safety_bits=1 | 1 << number).safety_fault()).startswith(f"{words} (safety status")


def test_a_status_is_at_most_fifty_milliseconds_old(controller: Controller, reader: Reader, clock: FakeClock) -> None:
    reader.look()
    controller.silent = True
    clock.advance(0.049)
    reader.status()
    clock.advance(0.002)
    assert wait_s(clock, reader.status, DeviceTimeout) == pytest.approx(STRICT.stale_s, abs=1e-6)


def test_a_shorter_silence_is_none(controller: Controller, reader: Reader, clock: FakeClock) -> None:
    reader.look()
    controller.silent = True

    def speak() -> None:
        controller.silent = False

    clock.at(0.18, speak)  # the sample after the silence came without being waited for, as far as anybody knows
    reader.look()
    assert not reader.silent


@pytest.mark.parametrize("mode", [3, 4])
def test_joints_without_power_are_not_measured(controller: Controller, reader: Reader, mode: int) -> None:
    controller.robot_mode = mode
    with pytest.raises(DeviceFault, match="measure its joints"):
        reader.state(never)
    controller.robot_mode = 5  # idle: powered, brakes closed
    reader.state(never)


def test_the_end_of_the_stream_is_raised_at_a_follower(
    controller: Controller, full_rate: ReaderInMemory, clock: FakeClock
) -> None:
    with full_rate.follow() as follow:
        clock.advance(0.004)
        controller.failure = ConnectionResetError("reset")
        clock.advance(0.004)
        assert len(follow.read(0.1)) == 2
        for _ in range(2):
            with pytest.raises(StreamBroken, match="reset"):
                follow.read(0.1)
    with pytest.raises(StreamBroken, match="reset"), full_rate.follow():
        pytest.fail("a stream that has failed was followed")


def test_poses_without_power_over_the_joints_are_not_read(
    controller: Controller, full_rate: ReaderInMemory, clock: FakeClock
) -> None:
    with full_rate.follow() as follow:
        clock.advance(0.004)
        controller.robot_mode = 5  # idle: powered, brakes closed
        clock.advance(0.006)
        controller.robot_mode = 3
        clock.advance(0.01)
        assert len(follow.read(0.0)) == 5
        with pytest.raises(DeviceFault, match="measure its joints"):
            follow.read(0.1)


def test_a_follower_refuses_another_arm(controller: Controller) -> None:
    reader = ReaderInMemory(controller, "UR5e")
    reader.info = replace(reader.info, model="UR10e")
    with reader.follow() as follow, pytest.raises(DeviceFault, match="another model"):
        follow.read(0.1)
