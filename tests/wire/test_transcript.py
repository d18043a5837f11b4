"""What a sensor and its driver say to each other, recorded, and played to the driver again."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from ftdrivers.clock import Clock, Follower
from ftdrivers.errors import ConnectError
from ftdrivers.interfaces import DeviceInfo, ForceTorqueSensor
from ftdrivers.registry import sensor_from_url
from ftdrivers.transcript import Player, Transcript, Writer, recording
from ftmocks.sensors.ati_can import AtiCanNode
from ftmocks.sensors.ati_serial import AtiSerialBox
from ftmocks.sensors.robotiq import RobotiqBox
from ftmocks.wires.faults import Faults
from tests.wire.sensor_kinds import KINDS

pytestmark = pytest.mark.slow  # every test needs a process of its own

WRENCH = np.array([3.0, -2.0, 12.0, 0.3, -0.2, 0.1])
NOISE = np.array([0.03] * 3 + [0.001] * 3)
STEPS = np.array([0.02] * 3 + [0.001] * 3)
"""Of the numbers of the coarsest device."""
DURATION_S = 0.6
PLAIN_BUS = can.Bus


def measured() -> Any:
    rng = np.random.default_rng(5)
    return lambda n: WRENCH + rng.normal(size=(n, 6)) * NOISE


RECORDED = ("ati-serial", "robotiq-ft300", "bota", "ati-can")


@pytest.fixture(params=RECORDED)
def url(request: pytest.FixtureRequest, cell_time: Any) -> Iterator[str]:
    kind = KINDS[request.param]
    module, _, name = kind.emulator.partition(":")
    device = getattr(import_module(module), name)(measured(), seed=1, clock=cell_time.of_devices, **kind.options)
    yield f"{request.param}://{device.start()}?{kind.query}".rstrip("?")
    device.stop()


@pytest.fixture
def clock(cell_time: Any) -> Clock:
    """The driver's and the player's."""
    return cell_time.of_drivers  # type: ignore[no-any-return]


@contextmanager
def joined(port: str, channel: str, clock: Clock) -> Iterator[None]:
    """Join the bus of an slcan adapter to a CAN interface that is no serial port: python-can's own."""
    ended = threading.Event()

    def forward(source: can.BusABC, to: can.BusABC) -> None:
        while not ended.is_set():
            clock.now_ns()  # a cell's time waits for this thread
            if frame := source.recv(clock.poll_s):
                to.send(frame)

    with (
        can.Bus(port, interface="slcan", bitrate=250_000, sleep_after_open=0.0) as adapter,
        can.Bus(channel, interface="virtual") as bus,
    ):
        threads = [Follower(clock, partial(forward, *ends), "bridge") for ends in ((adapter, bus), (bus, adapter))]
        for thread in threads:
            thread.start()
        try:
            yield
        finally:
            ended.set()
            for thread in threads:
                thread.join()


def look(sensor: ForceTorqueSensor, duration_s: float) -> tuple[DeviceInfo, np.ndarray[Any, Any]]:
    with sensor:
        return sensor.identify(), sensor.collect(duration_s).wrench


def test_the_driver_sees_in_the_transcript_what_it_saw_on_the_wire(url: str, tmp_path: Path, clock: Clock) -> None:
    path = tmp_path / "sensor.jsonl"
    writer = Writer(path, {"url": url, "duration_s": DURATION_S}, clock)
    with recording(writer):
        identity, wrench = look(sensor_from_url(url, clock=clock), DURATION_S + 0.3)
    assert not path.exists()  # only when it is whole
    writer.end(error=None)
    assert [file.name for file in tmp_path.iterdir()] == ["sensor.jsonl"]

    transcript = Transcript.load(path)
    assert transcript.header["url"] == url
    player = Player(transcript, clock)
    with player as port:
        again, played = look(sensor_from_url(transcript.url_at(port), clock=clock), DURATION_S)
    assert player.divergence is None
    assert again == identity
    assert len(played) > 3  # how many of a polled device is a matter of the machine
    tolerance = 6 * NOISE / np.sqrt(len(played)) + STEPS
    assert (np.abs(played.mean(axis=0) - wrench.mean(axis=0)) < tolerance).all()
    recorded = {row.tobytes() for row in wrench}  # not another noise of the same device but these very samples
    assert sum(row.tobytes() in recorded for row in played) > 0.7 * len(played)


def test_frames_of_a_can_interface_are_played_by_an_slcan_adapter(tmp_path: Path, cell_time: Any, clock: Clock) -> None:
    path = tmp_path / "sensor.jsonl"
    url = "ati-can://transcript?interface=virtual&bitrate=250000"
    writer = Writer(path, {"url": url, "duration_s": DURATION_S}, clock)
    device = AtiCanNode(measured(), seed=1, clock=cell_time.of_devices)
    try:
        with joined(device.start(), "transcript", clock), recording(writer):
            identity, wrench = look(sensor_from_url(url, clock=clock), DURATION_S + 0.3)
    finally:
        device.stop()
    writer.end(error=None)
    assert can.Bus is PLAIN_BUS

    transcript = Transcript.load(path)
    assert transcript.frames
    assert transcript.passages[0].data == b"t2050\r"  # the serial number is asked for first
    player = Player(transcript, clock)
    with player as port:
        again, played = look(sensor_from_url(transcript.url_at(port), clock=clock), DURATION_S)
    assert player.divergence is None
    assert again == identity
    recorded = {row.tobytes() for row in wrench}
    assert sum(row.tobytes() in recorded for row in played) > 0.7 * len(played) > 2


@pytest.mark.parametrize(
    ("frame", "line"),
    [
        (can.Message(arbitration_id=0x2A, is_extended_id=False, data=b"\x01\xff"), b"t02A201FF\r"),
        (can.Message(arbitration_id=0x12345, is_extended_id=True, data=b""), b"T000123450\r"),
        (can.Message(arbitration_id=0x2A, is_extended_id=False, is_remote_frame=True, dlc=3), b"r02A3\r"),
        (can.Message(is_error_frame=True), b""),
    ],
)
def test_a_frame_becomes_a_line(frame: can.Message, line: bytes, tmp_path: Path) -> None:
    path = tmp_path / "frames.jsonl"
    writer = Writer(path, {"url": "x", "duration_s": 1})
    with (
        can.Bus("lines", interface="virtual") as other,
        recording(writer),
        can.Bus("lines", interface="virtual") as bus,
    ):
        other.send(frame)
        assert bus.recv(1.0) is not None
    writer.end()
    assert b"".join(passage.data for passage in Transcript.load(path).passages) == line


@pytest.fixture
def ati(cell_time: Any) -> Iterator[str]:
    device = AtiSerialBox(measured(), seed=1, clock=cell_time.of_devices)
    yield f"ati-serial://{device.start()}"
    device.stop()


def test_a_sensor_that_fails_leaves_a_transcript_that_fails_alike(tmp_path: Path, cell_time: Any, clock: Clock) -> None:
    device = RobotiqBox(measured(), seed=1, faults=Faults(stall=True), clock=cell_time.of_devices)
    path = tmp_path / "dead.jsonl"
    try:
        url = f"robotiq-ft300://{device.start()}"
        writer = Writer(path, {"url": url, "duration_s": 1.0}, clock)
        with recording(writer), pytest.raises(ConnectError):
            look(sensor_from_url(url, clock=clock), 1.0)
        writer.end(error="ConnectError")
    finally:
        device.stop()
    transcript = Transcript.load(path)
    assert any(passage.sent for passage in transcript.passages)
    assert not any(not passage.sent for passage in transcript.passages)
    with Player(transcript, clock) as port, pytest.raises(ConnectError):
        look(sensor_from_url(transcript.url_at(port), clock=clock), 1.0)
