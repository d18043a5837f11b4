"""The frames of the ATI CAN driver as a table: golden start-up, awkward answers, and how long each is waited for."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain, repeat
from typing import Any

import numpy as np
import pytest

from ftdrivers.ati.can import AtiCanSensor
from ftdrivers.clock import Clock
from ftdrivers.errors import ConnectError, DeviceError, DeviceFault, StreamBroken
from ftdrivers.interfaces import Fact
from tests.unit.drivers.dialogue import CanWire, Table
from tests.unit.drivers.in_one_thread import InOneThread

GAUGES = ["200 00000064012C01F4", "201 FF38FE70FDA8"]
COUNTS = [100, -200, 300, -400, 500, -600]
WRENCH = [-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608]
START_UP: Mapping[str, Sequence[str]] = {
    "205": ["205 4654313233343500"],
    "20F": ["20F 03080002"],
    "206 00": ["206 00"],
    "202 00": ["202 0000000000000000", "203 00000000C584D000", "204 000000004584D000"],
    "202 01": ["202 000000004599C000", "203 00000000C519C000", "204 00000000C519C000"],
    "202 02": ["202 45ED800000000000", "203 45ED800000000000", "204 45ED800000000000"],
    "202 03": ["202 0000000000000000", "203 C35C000000000000", "204 435C000000000000"],
    "202 04": ["202 437E000000000000", "203 C2FE000000000000", "204 C2FE000000000000"],
    "202 05": ["202 00000000C3060000", "203 00000000C3060000", "204 00000000C3060000"],
    "207": ["207 000F4240000F4240"],
    "208": ["208 0203"],
    "200": GAUGES,
}
Answer = Sequence[str | tuple[float, str]]
MakeWire = Callable[..., CanWire]


class Sensor(InOneThread, AtiCanSensor):
    def __init__(self, clock: Clock, **options: Any) -> None:
        super().__init__("can0", clock=clock, **options)


@pytest.fixture
def make_wire(table: Table) -> MakeWire:
    """A sensor that starts up as usual but for `change`, then answers each poll: `polls`, then for ever `last`."""

    def make(
        change: Mapping[str, Answer | None] | None = None,
        polls: Iterable[Answer] = (),
        last: Answer = GAUGES,
        echo: bool = False,
    ) -> CanWire:
        turns = {**START_UP, **(change or {})}
        start_up = [(sent, received) for sent, received in turns.items() if received is not None]
        return table.can(chain(start_up, (("200", poll) for poll in polls), repeat(("200", last))), echo=echo)

    return make


def ask(*requests: str, **changed: Answer) -> list[tuple[str, Answer]]:
    """The first part of the dialogue, for those that go no further."""
    return [(request, changed.get(f"x{request}", START_UP[request])) for request in requests]


def opened(wire: CanWire, **options: Any) -> Sensor:
    return Sensor(wire.clock, **options)


def left_alone(wire: CanWire) -> None:
    """Polls go on for ever, so the table never ends: only what was wrong counts."""
    assert wire.wrong == []


def test_start_up_is_golden_and_then_only_gauges_are_asked(make_wire: MakeWire) -> None:
    wire = make_wire()
    with opened(wire) as sensor:
        samples, info = sensor.collect(0.1), sensor.identify()
    left_alone(wire)
    assert (info.serial, info.firmware) == ("FT12345", "3.8 build 2")
    assert info.facts["counts_per_N"] == info.facts["counts_per_Nm"] == Fact(1e6, "device")
    assert "range" not in info.facts
    assert samples.wrench.mean(axis=0).tolist() == pytest.approx(WRENCH)
    assert (samples.counts == COUNTS).all()
    assert (np.diff(samples.seq) == 1).all()
    assert len(samples) == pytest.approx(100, abs=20)  # polled at 1 kHz at most


@pytest.mark.parametrize(
    ("first_half", "second_half", "status", "wrench"),
    [
        ("000000DD00450926", "FC62FBC204F2", 0, [9.996, -4.99872, 20.0032, 0.50006, -0.250063, 0.099964]),
        ("C0000064012C01F4", "FF38FE70FDA8", 0xC000, WRENCH),  # bits 14 and 15 make no sample unusable
    ],
)
def test_samples_are_golden(
    make_wire: MakeWire, first_half: str, second_half: str, status: int, wrench: list[float]
) -> None:
    with opened(make_wire(last=[f"200 {first_half}", f"201 {second_half}"])) as sensor:
        sensor.collect(0.01)
        sample = sensor.latest(timeout_s=0.0)
        assert sample.wrench[0].tolist() == pytest.approx(wrench)
        assert sample.status[0] == status


def test_slot_is_selected_and_its_echo_checked(table: Table) -> None:
    with table.can([*ask("205", "20F"), ("206 03", ["206 00"])]) as wire, pytest.raises(ConnectError, match=r"3.* 0;"):
        opened(wire, slot=3).open()


def test_bus_that_echoes_does_not_fake_the_slot_echo(table: Table, make_wire: MakeWire) -> None:
    wire = make_wire(echo=True)
    with opened(wire) as sensor:
        sensor.collect(0.05)
    left_alone(wire)
    mute = [*ask("205", "20F"), *[("206 03", [])] * 3]
    with table.can(mute, echo=True) as wire, pytest.raises(ConnectError, match="SELECT_SLOT"):
        opened(wire, slot=3).open()


@pytest.mark.parametrize(
    "answers",
    [
        {"207": ["207 0000000000000000"]},
        {"208": ["208 0903"]},
        {"202 00": [f"20{n} {'7FC00000' * 2}" for n in (2, 3, 4)]},
        {"202 00": [f"20{n} {'00' * 8}" for n in (2, 3, 4)]},
    ],
    ids=["counts", "units", "not finite", "singular"],
)
def test_calibration_that_is_none_names_device_slot_and_cure(make_wire: MakeWire, answers: dict[str, Answer]) -> None:
    with pytest.raises(ConnectError, match=r"^ATI CAN sensor 0x20 .*slot 0: ") as caught:
        opened(make_wire(answers)).open()
    assert "slot=0 to 15" in caught.value.fix


OLD: Mapping[str, Answer | None] = {"20F": ["20F 03060001"], "207": None, "208": None}
LBF, LBF_IN = 4.4482216152605, 0.1129848290276167


@pytest.mark.parametrize(
    ("options", "factors", "facts", "warns"),
    [
        ({}, (1.0, 1.0), (Fact(1e6, "assumed"), Fact(1e6, "assumed")), True),
        (
            {"unit_codes": (1, 1)},
            (LBF, LBF_IN),
            (Fact(1e6 / LBF, "configured"), Fact(1e6 / LBF_IN, "configured")),
            False,
        ),
        ({"counts_per_unit": (500_000, 1_000_000)}, (2.0, 1.0), (Fact(5e5, "assumed"), Fact(1e6, "assumed")), True),
    ],
)
def test_old_firmware_does_not_report_its_scale(
    make_wire: MakeWire,
    options: dict[str, Any],
    factors: tuple[float, float],
    facts: tuple[Fact, Fact],
    warns: bool,
    caplog: pytest.LogCaptureFixture,
) -> None:
    wire = make_wire(OLD)
    with opened(wire, **options) as sensor:
        wrench = sensor.latest(timeout_s=0.0).wrench[0]
        assert wrench.tolist() == pytest.approx(np.array(WRENCH) * np.repeat(factors, 3))
        info = sensor.identify()
        assert (info.facts["counts_per_N"], info.facts["counts_per_Nm"]) == facts
    left_alone(wire)
    assert ("units=" in caplog.text) == warns  # what to add to the address


def test_scale_that_the_sensor_contradicts_is_refused(make_wire: MakeWire) -> None:
    with opened(make_wire(), unit_codes=(2, 3), counts_per_unit=(1_000_000, 1_000_000)) as sensor:
        assert sensor.identify().facts["counts_per_N"] == Fact(1e6, "device")
    for options, configured in (
        ({"unit_codes": (1, 3)}, r"1000000 counts per lbf"),
        ({"counts_per_unit": (1_000_000, 10_000)}, r"10000 per N-m"),
    ):
        with pytest.raises(ConnectError, match=rf"1000000 counts per N and .* {configured}"):
            opened(make_wire(), **options).open()


def test_halves_pair_up_by_identifier_among_foreign_frames(make_wire: MakeWire) -> None:
    swapped = ["201 FF38FE70FDA8", "1FF 0102", "210 00000064012C01F4", "200", "201 FF", GAUGES[0]]
    with opened(make_wire(last=swapped)) as sensor:
        assert (sensor.collect(0.05).counts == COUNTS).all()
        assert sensor.health().lost == 0


def test_a_half_that_is_late_does_not_pair_up_with_the_next_reading(table: Table) -> None:
    late = [(1.0, GAUGES[0]), (53.0, "201 000400050006")]
    half = [(10.0, GAUGES[0])]
    again = ("206 00", ["206 00"])  # after two misses in a row it may have restarted: the slot is selected again
    polls = [("200", GAUGES), ("200", late), ("200", half), again]
    wire = table.can(chain(START_UP.items(), polls, repeat(("200", GAUGES))))
    with opened(wire) as sensor:
        samples = sensor.collect(0.18)
        assert (samples.counts == COUNTS).all()
        assert sensor.health().lost == 2
        assert samples.seq[0] == 4
    left_alone(wire)


@pytest.mark.parametrize(
    ("first_half", "error", "message"),
    [
        ("200 80400064012C01F4", DeviceFault, "bit 6: no valid calibration"),
        ("200 08000064012C01F4", DeviceFault, "temperature too high"),
        ("200 00007FFF012C01F4", DeviceFault, "gauge G0"),
        ("200 00000064012C8000", DeviceFault, "gauge G4"),
        ("200 00010064012C01F4", StreamBroken, "reset itself"),
    ],
)
def test_status_that_ends_the_stream(
    make_wire: MakeWire, first_half: str, error: type[DeviceError], message: str
) -> None:
    with (
        opened(make_wire(polls=[GAUGES] * 5, last=[first_half, GAUGES[1]])) as sensor,
        pytest.raises(error, match=message),
    ):
        sensor.collect(1.0)


def test_harmless_status_is_logged_once(make_wire: MakeWire, caplog: pytest.LogCaptureFixture) -> None:
    with opened(
        make_wire({"200": ["200 C1010064012C01F4", GAUGES[1]]}, last=["200 C1010064012C01F4", GAUGES[1]])
    ) as sensor:
        assert (sensor.collect(0.05).status == 0xC101).all()
    assert caplog.text.count("CAN bus error") == 1


def test_empty_slot_is_a_fault(make_wire: MakeWire) -> None:
    zeros = {f"202 0{axis}": [f"20{n} {'00' * 8}" for n in (2, 3, 4)] for axis in range(6)}
    with pytest.raises(DeviceFault, match="slot 0 is empty"):
        opened(make_wire(zeros)).open()


@pytest.mark.parametrize(
    ("interface", "channel"),
    [
        ("slcan", "/dev/does-not-exist"),
        ("socketcan", "no-such-can"),
        ("no-such-interface", "x"),
        ("kvaser", "0"),  # these three without their libraries: NameError, ImportError, TypeError
        ("neovi", "0"),
        ("socketcand", "can0"),
    ],
)
def test_bus_that_does_not_open(interface: str, channel: str) -> None:
    with pytest.raises(ConnectError, match=f"on {interface} {channel}: ") as caught:
        AtiCanSensor(channel, interface=interface).open()
    assert ("ip link set no-such-can" in str(caught.value)) == (interface == "socketcan")


def test_an_adapter_on_a_serial_port_wants_its_interface() -> None:
    with pytest.raises(ConnectError) as caught:
        AtiCanSensor("/dev/ttyACM0").open()
    assert "interface=slcan" in caught.value.fix
    assert "ip link" not in str(caught.value)


def test_stale_frames_are_purged_before_a_request(make_wire: MakeWire) -> None:
    """A duplicate left over from the last reading must not become half of the next one."""
    with opened(make_wire(last=[*GAUGES, (1.1, "200 0000700070007000")])) as sensor:
        assert (sensor.collect(0.05).counts == COUNTS).all()


def test_a_missing_device_is_known_after_three_attempts(table: Table) -> None:
    with table.can([("205", [])] * 3) as wire:
        start_s = wire.clock.now_s()
        with pytest.raises(ConnectError, match="SERIAL"):
            opened(wire).open()
        assert wire.clock.now_s() - start_s == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize(("after_ms", "asked"), [(99.0, 1), (101.0, 2), (None, 2)])
def test_a_reply_of_the_start_up_has_a_tenth_of_a_second_and_is_asked_again(
    table: Table, after_ms: float | None, asked: int
) -> None:
    reply = START_UP["205"]
    late = [] if after_ms is None else [(after_ms, reply[0])]
    turns = [("205", late), ("205", reply)][:asked]
    rest = [(sent, received) for sent, received in START_UP.items() if sent != "205"]
    wire = table.can(chain(turns, rest, repeat(("200", GAUGES))))
    with opened(wire):
        left_alone(wire)
