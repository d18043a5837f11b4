"""A sensor on Ethernet recorded, and played to its driver again: datagrams, and pages over HTTP."""

import http.client
import json
import math
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
import pynetft
import pytest
from click.testing import CliRunner, Result

from ftdrive.commands import transcript
from ftdrive.errors import ConfigError
from ftdrivers.ati.netft import NetFtSensor
from ftdrivers.clock import Clock
from ftdrivers.errors import BadTranscript, ConnectError, ProtocolError
from ftdrivers.interfaces import DeviceInfo, FtSamples
from ftdrivers.registry import sensor_from_url
from ftdrivers.transcript.player import Player
from ftdrivers.transcript.recorder import Page, Passage, Transcript, Writer
from ftdrivers.transcript.relays import _DatagramRelay, _PageRelay
from ftdrivers.transcript.taps import recording
from ftmocks.sensors.netft import NetFtBox

WRENCH = np.array([3.0, -2.0, 12.0, 0.3, -0.2, 0.1])
START, STOP = bytes.fromhex("1234 0002 0000 0000"), bytes.fromhex("1234 0000 0000 0000")
DURATION_S = 0.6
PLAIN = pynetft.Client, http.client.HTTPConnection
HEADER = {"url": "ati-netft://192.168.1.1?sign=1", "duration_s": 1.0}


@pytest.fixture
def clock(cell_time: Any) -> Clock:
    """The driver's and the player's."""
    return cell_time.of_drivers  # type: ignore[no-any-return]


@pytest.fixture
def started(cell_time: Any) -> Iterator[Callable[..., tuple[NetFtBox, str]]]:
    boxes: list[NetFtBox] = []

    def start(**options: Any) -> tuple[NetFtBox, str]:
        rng = np.random.default_rng(5)
        measure = lambda n: WRENCH + 1e-3 * rng.normal(size=(n, 6))  # noqa: E731
        boxes.append(NetFtBox(measure, rdt_port=0, rate_hz=500, clock=cell_time.of_devices, **options))
        ends = boxes[-1].start()
        where = f"{ends['host']}?rdt_port={ends['rdt_port']}&http_port={ends['http_port']}"
        return boxes[-1], f"ati-netft://{where}"

    yield start
    for box in boxes:
        box.stop()


@pytest.fixture
def url(started: Any) -> str:
    return str(started()[1])


def look(url: str, duration_s: float, clock: Clock) -> tuple[DeviceInfo, FtSamples]:
    with sensor_from_url(url, clock=clock) as sensor:
        return sensor.identify(), sensor.collect(duration_s)


def readings(samples: FtSamples) -> set[tuple[int, ...]]:
    return {(int(seq), *row) for seq, row in zip(samples.seq, samples.counts.tolist(), strict=True)}


def test_the_driver_sees_in_the_transcript_what_it_saw_on_the_wire(url: str, tmp_path: Path, clock: Clock) -> None:
    path = tmp_path / "sensor.jsonl"
    writer = Writer(path, {"url": url, "duration_s": DURATION_S}, clock)
    with recording(writer):
        identity, seen = look(url, DURATION_S + 0.3, clock)
    writer.end(error=None)
    assert (pynetft.Client, http.client.HTTPConnection) == PLAIN

    told = Transcript.load(path)
    records = [struct.unpack(">3I6i", passage.data) for passage in told.passages if not passage.sent]
    on_the_wire = {(seq, *counts) for seq, _, _, *counts in records}
    assert len(records) == len(on_the_wire)
    assert readings(seen) <= on_the_wire
    assert [passage.data for passage in told.passages if passage.sent] == [START, STOP]
    asked = [page.request.split(b" HTTP")[0] for page in told.pages]
    assert asked == [b"GET /netftapi2.xml", b"GET /netftcalapi.xml?index=0", b"GET /netftapi2.xml"]
    assert all(f"Host: 127.0.0.1:{dict(parse_qsl(url))['http_port']}".encode() in page.request for page in told.pages)

    player = Player(told, clock)
    with player as place:
        again, played = look(told.url_at(place), DURATION_S, clock)
    assert player.divergence is None
    assert again == identity
    assert readings(played) <= on_the_wire
    assert len(played) > 50


@pytest.mark.slow
def test_a_sensor_that_fails_leaves_a_transcript_that_fails_alike(tmp_path: Path, started: Any, clock: Clock) -> None:
    box, url = started(rdt_enabled=False)
    writer = Writer(tmp_path / "dead.jsonl", {"url": url, "duration_s": 1.0}, clock)
    with recording(writer), pytest.raises(ConnectError, match="no sample"):
        look(url, 1.0, clock)
    box.stop()
    writer.end(error="ConnectError")
    told = Transcript.load(tmp_path / "dead.jsonl")
    assert {passage.data for passage in told.passages} == {START, STOP}
    player = Player(told, clock)
    with player as place, pytest.raises(ConnectError, match="no sample"):
        look(told.url_at(place), 1.0, clock)
    assert player.divergence is None


def test_nobody_there_is_told_by_the_driver_and_in_the_file(tmp_path: Path, started: Any, clock: Clock) -> None:
    box, url = started()
    box.stop()
    writer = Writer(tmp_path / "gone.jsonl", {"url": url, "duration_s": 1.0}, clock)
    with recording(writer):
        for more, cause in (("", "closed connection|reset"), ("&onrobot=1", "no sample")):
            with pytest.raises(ConnectError, match=cause):
                look(url + more, 1.0, clock)
        with pytest.raises(ConnectError, match=r"[Nn]ame"):
            NetFtSensor("no such host", onrobot=True).open()
    writer.end(error="ConnectError")
    lines = [json.loads(line) for line in (tmp_path / "gone.jsonl").read_text().splitlines()]
    (page,) = [line for line in lines if line.get("event") == "page"]
    assert "refused" in page["error"]
    assert page["reply"] == ""
    assert all("refused" in line["error"] for line in lines if line.get("event") == "unreachable")
    assert [line["datagrams"] for line in lines if line.get("event") == "open"] == [True]


@contextmanager
def ends(count: int) -> Iterator[list[socket.socket]]:
    """UDP sockets; the first has a port of this computer."""
    with ExitStack() as opened:
        sockets = [opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(count)]
        for end in sockets:
            end.settimeout(5)
        sockets[0].bind(("127.0.0.1", 0))
        yield sockets


ODD = (b"first", b"", b"x", bytes(1400), b"last")


def test_every_datagram_of_the_device_stays_one_and_others_do_not_pass(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.jsonl", HEADER)
    with ends(3) as (device, stranger, driver), _DatagramRelay(writer, *device.getsockname()) as relay:
        writer.event("open", datagrams=True)
        driver.sendto(START, ("127.0.0.1", relay.port))
        request, far = device.recvfrom(100)
        assert request == START
        stranger.sendto(b"not from the device", far)
        for data in ODD:
            device.sendto(data, far)
        assert tuple(driver.recv(2000) for _ in ODD) == ODD
    writer.end()
    assert tuple((p.sent, p.data) for p in Transcript.load(tmp_path / "a.jsonl").passages) == (
        (True, START),
        *((False, data) for data in ODD),
    )


def test_who_asks_from_a_new_socket_gets_nothing_that_an_old_one_asked_for(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.jsonl", HEADER)
    with ends(3) as (device, before, driver), _DatagramRelay(writer, *device.getsockname()) as relay:
        writer.event("open", datagrams=True)
        places = []
        for end in (before, driver):
            end.sendto(START, ("127.0.0.1", relay.port))
            places.append(device.recvfrom(100)[1])
        for data, place in zip((b"old", b"new"), places, strict=True):
            device.sendto(data, place)
        assert driver.recv(100) == b"new"
    writer.end()
    assert [p.data for p in Transcript.load(tmp_path / "a.jsonl").passages] == [START, START, b"new"]


def test_the_last_request_reaches_the_device(tmp_path: Path) -> None:
    """Else it would stream on to nobody."""
    writer = Writer(tmp_path / "a.jsonl", HEADER)
    with ends(2) as (device, driver):
        relay = _DatagramRelay(writer, *device.getsockname())
        driver.sendto(STOP, ("127.0.0.1", relay.port))
        relay._ended.set()  # before the relay has had its turn
        with relay:
            pass
        device.setblocking(False)
        assert device.recv(100) == STOP
    writer.discard()


@pytest.mark.parametrize(("port", "host"), [(80, b"no-such-host"), (8080, b"no-such-host:8080")])
def test_the_device_is_called_by_its_own_name(port: int, host: bytes, tmp_path: Path) -> None:
    writer = Writer(tmp_path / "a.jsonl", HEADER)
    with _PageRelay(writer, "no-such-host", port) as relay:
        here = f"127.0.0.1:{relay.port}".encode()
        request = b"GET /%b HTTP/1.1\r\nHost: %b\r\nAccept: */*\r\n\r\n"
        assert relay.for_the_device(request % (here, here)) == request % (here, host)
    writer.discard()


def made_up(*passages: tuple[float, bool, bytes], pages: tuple[Page, ...] = ()) -> Transcript:
    told = tuple(Passage(round(1e9 * t_s), sent, data) for t_s, sent, data in passages)
    return Transcript(HEADER, 0, told, {}, datagrams=True, pages=pages)


def ports_of(place: str) -> tuple[tuple[str, int], tuple[str, int]]:
    host, _, options = place.partition("?")
    ports = {key: int(value) for key, value in parse_qsl(options)}
    return (host, ports["rdt_port"]), (host, ports["http_port"])


def test_datagrams_are_played_one_by_one_to_whoever_asked_last() -> None:
    told = made_up(
        (0.0, True, START),
        *((1e-3, False, data) for data in ODD),
        (0.5, True, STOP),
        (0.5, True, START),
        (0.5, False, b"2"),
    )
    player = Player(told)
    with player as place:
        assert told.url_at(place) == f"ati-netft://127.0.0.1?sign=1&{place.partition('?')[2]}"
        for expected in (ODD, (b"2",)):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as driver:
                driver.settimeout(5)
                driver.sendto(START, ports_of(place)[0])
                assert tuple(driver.recv(2000) for _ in expected) == expected
    assert player.divergence is None


def test_what_is_late_comes_all_the_same() -> None:
    """A thousand datagrams that are due at once, more than the socket of a driver holds: portions, all in order."""
    data = [struct.pack(">I", n) for n in range(1000)]
    player = Player(made_up((0.0, True, START), *((0.0, False, one) for one in data)))
    with player as place, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as driver:
        driver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        driver.settimeout(5)
        driver.sendto(START, ports_of(place)[0])
        assert [driver.recv(100) for _ in data] == data


@pytest.mark.parametrize("foreign", [b"\x12\x34", START[:-1] + b"\x01", START + b"\x00", b"hello"])
def test_a_datagram_that_was_not_recorded_ends_in_silence_with_a_reason(foreign: bytes) -> None:
    player = Player(made_up((0.0, True, START), (0.001, False, b"1")))
    with player as place, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as driver:
        driver.sendto(foreign, ports_of(place)[0])
        driver.sendto(START, ports_of(place)[0])
        driver.settimeout(0.3)
        with pytest.raises(TimeoutError):
            driver.recv(100)
    assert player.divergence == (f"the driver sent {foreign.hex(' ')}, the recording has {START.hex(' ')}")


def page(path: str, reply: bytes) -> Page:
    return Page(f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode(), reply, 0.001)


def test_pages_are_answered_in_their_order_and_the_last_one_again() -> None:
    told = made_up(pages=(page("/a", b"1"), page("/b", b"other"), page("/a", b"2"), page("/mute", b"")))
    player = Player(told)

    def ask(path: str) -> bytes:
        with socket.create_connection(ports_of(place)[1], timeout=5) as driver:
            driver.sendall(f"GET {path} HTTP/1.0\r\nAccept: */*\r\n\r\n".encode())
            return driver.recv(100)

    with player as place:
        assert [ask(path) for path in ("/a", "/a", "/b", "/a", "/mute")] == [b"1", b"2", b"other", b"2", b""]
        assert player.divergence is None
        assert ask("/c") == b""
        assert player.divergence == "the driver requested GET /c, which is not in the recording"
        assert ask("/b") == b"other"


def test_a_player_that_nobody_opens_ends() -> None:
    before = threading.active_count()
    with Player(made_up()):
        pass
    assert threading.active_count() == before


GOOD = {"t_ns": 2, "event": "page", "request": "47", "reply": "", "took_s": 0.5}


def load(tmp_path: Path, page: dict[str, Any]) -> Transcript:
    lines = ({"format": "ftdrive.transcript/1", **HEADER}, {"t_ns": 1, "event": "open", "datagrams": True}, page)
    (tmp_path / "a.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return Transcript.load(tmp_path / "a.jsonl")


def test_a_page_is_read(tmp_path: Path) -> None:
    assert load(tmp_path, GOOD).pages == (Page(b"G", b"", 0.5),)


@pytest.mark.parametrize(
    "wrong",
    [{"took_s": -0.1}, {"took_s": 1e9}, {"took_s": math.nan}, {"took_s": None}, {"request": "4"}, {"reply": None}],
)
def test_a_damaged_page_is_refused(wrong: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(BadTranscript, match="line 3"):
        load(tmp_path, GOOD | wrong)


@pytest.fixture(autouse=True)
def _cell_time(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command knows nothing of an emulator that a test has started."""
    monkeypatch.setattr(transcript, "sensor_from_url", lambda url, **_: sensor_from_url(url, clock=clock))
    monkeypatch.setattr(transcript, "Writer", lambda path, header, *_: Writer(path, header, clock))
    monkeypatch.setattr(transcript, "Player", lambda told, *_: Player(told, clock))


def run(*arguments: str) -> Result:
    return CliRunner().invoke(transcript.transcript, arguments)


@pytest.fixture
def recorded(url: str, tmp_path: Path) -> list[str]:
    path = tmp_path / "whole.jsonl"
    outcome = run("record", "--sensor", url, "-o", str(path), "--duration", "1", "--json")
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    return path.read_text().splitlines(keepends=True)


def play(lines: list[str], tmp_path: Path) -> Result:
    path = tmp_path / "played.jsonl"
    path.write_text("".join(lines))
    return run("play", str(path), "--json")


def test_the_commands_record_and_play_it(recorded: list[str], tmp_path: Path) -> None:
    outcome = play(recorded, tmp_path)
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    told = json.loads(outcome.stdout)
    assert told["played"]["identity"] == told["recorded"]["identity"]
    assert told["played"]["identity"]["serial"] == "FT12345"
    assert told["played"]["mean_force_N"] == pytest.approx(WRENCH[:3], abs=0.002)
    assert told["played"]["mean_torque_Nm"] == pytest.approx(WRENCH[3:], abs=0.002)


def test_a_file_that_was_cut_is_played_as_far_as_it_goes(recorded: list[str], tmp_path: Path) -> None:
    outcome = play(recorded[: len(recorded) * 3 // 4], tmp_path)
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    played = json.loads(outcome.stdout)["played"]
    assert 0 < played["duration_s"] < 1
    assert played["samples"] > 10
    assert "broken off" in outcome.stderr


def test_a_file_that_was_cut_before_the_first_datagram_says_so(recorded: list[str], tmp_path: Path) -> None:
    first = next(n for n, line in enumerate(recorded) if '"rx"' in line)
    outcome = play(recorded[:first], tmp_path)
    assert isinstance(outcome.exception, BadTranscript)
    assert "anything to measure" in str(outcome.exception)


def test_a_driver_that_asks_something_else_is_told_what(recorded: list[str], tmp_path: Path) -> None:
    elsewhere = b"/elsewhere.xml HTTP/1.1".hex()
    outcome = play([line.replace(b"/netftcalapi.xml".hex(), elsewhere) for line in recorded], tmp_path)
    assert isinstance(outcome.exception, ProtocolError)
    assert "GET /netftcalapi.xml?index=0" in str(outcome.exception)


def test_an_emulated_arm_is_refused_before_it_is_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transcript, "sensor_reached", lambda url, _: pytest.fail(f"{url} was started"))
    outcome = run("record", "--simulate", "--sensor", "emulated://ur-ft", "-o", str(tmp_path / "a.jsonl"))
    assert isinstance(outcome.exception, ConfigError)
    assert "emulated://ur-ft" in str(outcome.exception)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("ur-ft://192.168.1.10?counts_per_N=1&counts_per_Nm=1", "capture TCP port 30004 of the arm with Wireshark"),
        ("own-wire://192.168.1.10", "neither on a serial port or a CAN bus nor an ati-netft"),
    ],
)
def test_other_sensors_on_ethernet_are_refused_with_the_way_out(url: str, words: str, tmp_path: Path) -> None:
    outcome = run("record", "--sensor", url, "-o", str(tmp_path / "a.jsonl"))
    assert isinstance(outcome.exception, ConfigError)
    assert words in str(outcome.exception)
    assert list(tmp_path.iterdir()) == []
