"""Which sensors are on a CAN bus in memory: what is sent, and to whom nothing is."""

import re
from collections.abc import Callable, Sequence

import pytest

from ftdrivers.probe import Answer, probe_can
from tests.unit.drivers.dialogue import CanWire, Stream, Table

ATI_SERIAL, ATI_FIRMWARE, ROBOTOUS_MODEL = "205", "20F", "064 0100000000000000"
STREAM = ["001 0BFF010203040506", "002 0102030405000000"]
Probe = Callable[..., tuple[CanWire, list[Answer]]]


@pytest.fixture
def probed(table: Table) -> Probe:
    """Probe a bus on which something else sends `frames` each 20 ms; return what was sent and the answers."""

    def probe(
        frames: Sequence[str], turns: Sequence[tuple[str, list[str]]], bitrate: int = 1_000_000
    ) -> tuple[CanWire, list[Answer]]:
        other = Stream.of(list(frames), 0.02, has_end=False) if frames else None
        with table.can(turns, other) as wire:
            return wire, probe_can("can0", interface="socketcan", bitrate=bitrate, clock=wire.clock)

    return probe


@pytest.mark.parametrize(
    ("bitrate", "sent"), [(250_000, [ATI_SERIAL]), (1_000_000, [ATI_SERIAL, ROBOTOUS_MODEL]), (500_000, [ATI_SERIAL])]
)
def test_a_silent_bus_is_asked_by_readings_only(probed: Probe, bitrate: int, sent: list[str]) -> None:
    wire, answers = probed([], [(request, []) for request in sent], bitrate)
    assert answers == []
    assert wire.clock.now_s() - 1000 == pytest.approx(1.0 + 0.25 * len(sent), abs=0.01)  # listens, then waits


@pytest.mark.parametrize(
    ("frames", "sent", "refused"),
    [
        (["201 01020304050A"], [ROBOTOUS_MODEL], r"ATI NETCANOEM at base 0x20 .* 0x201;"),
        (["064 AABBCCDDEEFF0011"], [ATI_SERIAL], r"Robotous .* 0x064;"),
        (STREAM[:1], [ATI_SERIAL], r"Robotous .* 0x001;"),
        ([STREAM[0].replace("0B", "33"), STREAM[1]], [ATI_SERIAL], r"Robotous .* 0x001, 0x002;"),
        ([STREAM[0], "002 0102030405400000"], [ATI_SERIAL], "Robotous"),
        (["301 AABBCCDDEEFF0011"], [ATI_SERIAL, ROBOTOUS_MODEL], None),
    ],
    ids=["a PDO", "command", "half", "no sample", "reserved bit", "elsewhere"],
)
def test_identifiers_in_use_by_something_else_are_left_alone(
    probed: Probe, frames: list[str], sent: list[str], refused: str | None
) -> None:
    _, answers = probed(frames, [(request, []) for request in sent])
    assert all(answer.url is None for answer in answers)
    if refused is None:
        assert answers == []
    else:
        (answer,) = answers
        assert re.search(refused, answer.what), answer.what
        assert "://can0" in answer.what  # the address, for an operator who knows better


def test_a_sensor_that_streams_is_found_without_a_question(probed: Probe) -> None:
    _, (answer,) = probed(STREAM, [(ATI_SERIAL, [])])
    assert answer.url == "robotous-can://can0"


@pytest.mark.parametrize(
    "turns",
    [
        [(ATI_SERIAL, ["205 4142AA"]), (ROBOTOUS_MODEL, [])],  # too short for a serial number
        [(ATI_SERIAL, ["205 4654313233343500"]), (ATI_FIRMWARE, []), (ROBOTOUS_MODEL, [])],
        [(ATI_SERIAL, []), (ROBOTOUS_MODEL, ["001 0600000000000000", "002 0000000000000000"])],  # to another command
        [(ATI_SERIAL, []), (ROBOTOUS_MODEL, ["001 0152465436302D48"])],  # half a name
        [(ATI_SERIAL, []), (ROBOTOUS_MODEL, ["001 01FFFFFFFFFFFFFF", "002 FFFFFFFFFFFFFFFF"])],  # no name
    ],
)
def test_answers_of_something_else_are_no_sensor(probed: Probe, turns: list[tuple[str, list[str]]]) -> None:
    assert probed([], turns)[1] == []


@pytest.mark.parametrize(
    ("turns", "bitrate", "found"),
    [
        (
            [(ATI_SERIAL, ["205 4654313233343500"]), (ATI_FIRMWARE, ["20F 03080002"])],
            250_000,
            Answer("ati-can://can0?bitrate=250000", "ATI NETCANOEM, serial FT12345, firmware 3.8 build 2"),
        ),
        (
            [(ATI_SERIAL, []), (ROBOTOUS_MODEL, ["001 0152465436302D48", "002 4130310000000000"])],
            1_000_000,
            Answer("robotous-can://can0", "Robotous RFT60-HA01"),
        ),
    ],
    ids=["ATI", "Robotous"],
)
def test_a_sensor_that_answers_is_named(
    probed: Probe, turns: list[tuple[str, list[str]]], bitrate: int, found: Answer
) -> None:
    assert probed([], turns, bitrate)[1] == [found]
