"""Which protocol is used at which place, and the errors of places that cannot be probed."""

from functools import partial
from pathlib import Path
from typing import Any

import pytest

from ftcalib.errors import UsageError
from ftdrive.checks import computer, discovery
from ftdrive.checks.discovery import is_place, places, probe_place, sensor_at
from ftdrivers.clock import REAL
from ftdrivers.errors import ConnectError
from ftdrivers.probe import Answer

FOUND = Answer("ati-can://can0?bitrate=500000", "ATI")
REFUSED = Answer(None, "a Robotous was not asked")


@pytest.fixture
def can0(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An interface that is up, on a computer that is made up; the folder of its facts."""
    folder = tmp_path / "class/net/can0"
    folder.mkdir(parents=True)
    (folder / "type").write_text("280\n")
    (folder / "flags").write_text("0x40081\n")
    monkeypatch.setattr(discovery, "can_details", lambda name: {"bitrate": 500_000} if name == "can0" else {})
    monkeypatch.setattr(discovery, "check_can_interface", partial(computer.check_can_interface, sys=tmp_path))
    monkeypatch.setattr(discovery, "can_interfaces", partial(computer.can_interfaces, tmp_path))
    return folder


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The calls of the probes."""
    calls: list[Any] = []

    def probe_can(channel: str, **options: Any) -> list[Answer]:
        calls.append((channel, options))
        return [FOUND, REFUSED]

    monkeypatch.setattr(discovery, "probe_can", probe_can)
    monkeypatch.setattr(discovery, "probe_serial", lambda port, clock: calls.append((port, clock)))
    return calls


@pytest.mark.parametrize(("place", "base"), [("can0", 0x20), ("socketcan://can0", 0x20), ("can0?base=0x7F", 0x7F)])
@pytest.mark.usefixtures("can0")
def test_an_interface_of_the_kernel_is_asked_at_its_own_bit_rate(place: str, base: int, asked: list[Any]) -> None:
    assert is_place(place)
    assert sensor_at(place) == FOUND.url
    assert asked == [("can0", {"interface": "socketcan", "bitrate": 500_000, "base": base, "clock": REAL})]
    assert places()[0] == "can0"


def test_an_adapter_whose_name_is_written_like_in_any_address(asked: list[Any], tmp_path: Path) -> None:
    port = tmp_path / "my port"
    port.symlink_to("/dev/null")
    probe_place(f"slcan://{tmp_path}/my%20port?bitrate=250000")
    assert [channel for channel, _ in asked] == [str(port)]


def test_a_port_without_more_is_a_serial_sensor(asked: list[Any], tmp_path: Path) -> None:
    assert probe_place("/dev/null") == []
    assert asked == [("/dev/null", REAL)]
    with pytest.raises(ConnectError, match=f"{tmp_path}/ttyUSB0 does not exist; plug the adapter in"):
        probe_place(f"{tmp_path}/ttyUSB0")
    assert not is_place("ati-serial:///dev/ttyUSB0")


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("slcan:///dev/null", "no bit rate.*slcan:///dev/ttyACM0.bitrate=250000"),
        ("slcan://", "cannot be probed"),
        ("ati-can://can0", "cannot be probed"),
        ("slcan:///dev/null?bitrate=fast", "must be a whole number"),
        ("can0?rate=1000", "option rate; known: base, bitrate"),
        ("can0?base=0x80", "allowed are 0 to 127"),
    ],
)
def test_a_place_that_is_not_written_well(place: str, words: str, asked: list[Any]) -> None:
    with pytest.raises(UsageError, match=words):
        probe_place(place)
    assert asked == []


@pytest.mark.parametrize(
    ("place", "port"), [("ttyUSB0", "/dev/ttyUSB0"), ("socketcan:///dev/null", "/dev/null")], ids=["name", "path"]
)
def test_a_serial_port_is_no_can_interface(place: str, port: str, asked: list[Any]) -> None:
    with pytest.raises(ConnectError, match=rf"is not a CAN interface; .* {port}, .* slcan://{port}\?bitrate=250000$"):
        probe_place(place)
    assert asked == []


@pytest.mark.usefixtures("can0")
@pytest.mark.parametrize(
    ("answers", "words"),
    [
        ([], "answers on can0: check its power"),
        ([REFUSED], "a Robotous was not asked"),
        ([FOUND, Answer("robotous-can://can0", "R")], "give the address of one, ati-can.* or robotous"),
    ],
)
def test_only_one_sensor_is_the_sensor(answers: list[Answer], words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discovery, "probe_can", lambda *_, **__: answers)
    with pytest.raises(UsageError, match=words):
        sensor_at("can0")
