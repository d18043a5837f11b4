"""Emulators keep the rate of their sensor in the cell's time, and lose no sample when the computer stalls."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ftmocks.clock import LEAD_NS, CellClock
from ftmocks.sensors.ati_can import AtiCanNode
from ftmocks.sensors.ati_serial import AtiSerialBox
from ftmocks.sensors.bota import BotaBox, banner
from ftmocks.sensors.netft import RECORD, Command, NetFtBox
from ftmocks.sensors.robotiq import RobotiqBox
from ftmocks.sensors.robotous import RobotousCanNode, RobotousSerialBox
from ftmocks.wires.device import Pacer
from ftmocks.wires.faults import Faults
from ftmocks.wires.pty import PtyDevice
from ftmocks.wires.slcan import CanFrame
from tests.unit.mocks.real_time import RealTime

STEP_S = 0.001
BAUD_115200 = bytes.fromhex("0A 10 00 1F 00 01 02 00 02 56 CE")
START = bytes.fromhex("0A 46 55 A3 9D")
FT300_READ = bytes.fromhex("09 03 00 B4 00 06 84 A6")


def still(count: int) -> NDArray[np.float64]:
    return np.zeros((count, 6))


class Bench:
    """A device whose thread the test plays: a turn every millisecond of real time, and what it sends."""

    def __init__(self, make: Callable[..., Any]) -> None:
        self.real = RealTime()
        self.clock = CellClock(self.real)
        self.device = make(clock=self.clock)
        self.arrivals: list[tuple[float, int]] = []
        """When a piece was sent (s since the start), and its length."""
        self.begun_s = self.clock.now_s()
        if isinstance(self.device, PtyDevice):
            self.device._send = self._send  # type: ignore[method-assign]
        else:
            self.device._socket = self
        self.device._power_up()

    def run(self, duration_s: float, step_s: float = STEP_S) -> None:
        with self.clock.keeping_up():
            for _ in range(round(duration_s / step_s)):
                self.turn()
                self.real.pass_s(step_s)
            self.turn()

    def turn(self) -> None:
        self.device._tick(self.clock.follow() * 1e-9)

    @property
    def sent_bytes(self) -> int:
        return sum(size for _, size in self.arrivals)

    def _send(self, data: bytes, record_bytes: int) -> int:
        assert record_bytes or not data
        if data:
            self.arrivals.append((self.clock.now_s() - self.begun_s, len(data)))
        return 0

    def sendto(self, data: bytes, _client: object) -> None:
        self._send(data, len(data))


def net_box(**options: Any) -> NetFtBox:
    return NetFtBox(still, rate_hz=700, streaming_at_start=("127.0.0.1", 1), **options)


def opened_node(**options: Any) -> RobotousCanNode:
    """A CAN sensor that streams, behind an adapter that a client has opened."""
    node = RobotousCanNode(still, streaming_at_start=True, **options)
    node.rate_code = 8
    power_up = node._power_up

    def power_up_and_open() -> None:
        power_up()
        node._adapter.feed(b"S8\rO\r")

    node._power_up = power_up_and_open  # type: ignore[method-assign]
    return node


def fast_uart(**options: Any) -> RobotousSerialBox:
    box = RobotousSerialBox(still, streaming_at_start=True, baud_code=1, **options)
    box.rate_code = 8
    return box


STREAMS: dict[str, tuple[Callable[..., Any], int, float]] = {
    "ati-serial": (lambda **options: AtiSerialBox(still, streaming_at_start=True, **options), 13, 7000),
    "bota": (lambda **options: BotaBox(still, streaming_at_start=True, **options), 37, 100),
    "bota-fast": (lambda **options: BotaBox(still, streaming_at_start=True, sinc_length=64, **options), 37, 800),
    "robotiq": (lambda **options: RobotiqBox(still, streaming_at_start=True, **options), 16, 100),
    "robotous-serial": (fast_uart, 19, 1000),
    "robotous-can": (opened_node, 44, 1000),
    "netft": (net_box, RECORD.itemsize, 700),
}
"""How to make it, bytes a sample, samples a second."""


@pytest.mark.parametrize("name", STREAMS)
def test_a_stream_keeps_its_rate_and_comes_evenly(name: str) -> None:
    make, sample_bytes, rate_hz = STREAMS[name]
    bench = Bench(make)
    bench.run(1.0)
    assert bench.sent_bytes / sample_bytes == pytest.approx(rate_hz, abs=max(1, 0.002 * rate_hz))
    assert max(b - a for (a, _), (b, _) in pairwise(bench.arrivals)) < 1 / rate_hz + 2.5 * STEP_S


@pytest.mark.parametrize("name", STREAMS)
def test_a_stall_of_the_computer_stops_the_stream_and_loses_nothing(name: str) -> None:
    make, sample_bytes, rate_hz = STREAMS[name]
    bench = Bench(make)
    bench.run(0.3)
    before, before_s = bench.sent_bytes / sample_bytes, bench.clock.now_s()
    bench.real.pass_s(2.0)
    bench.run(0.3)
    took_s = bench.clock.now_s() - before_s
    assert took_s < 0.3 + 0.25, "the stall is lost, but for the debt"
    largest = max(size for at_s, size in bench.arrivals if at_s > before_s - bench.begun_s)
    assert largest <= sample_bytes * (LEAD_NS * 1e-9 * rate_hz + 2), "no more than the lead at once"
    assert bench.sent_bytes / sample_bytes - before == pytest.approx(took_s * rate_hz, abs=1 + 0.005 * rate_hz)


def test_a_slow_line_streams_what_fits() -> None:
    bench = Bench(lambda **options: AtiSerialBox(still, **options))
    for request in (BAUD_115200, START):
        bench.device._received(request)
        bench.run(0.005)
    before = bench.sent_bytes
    bench.run(1.0)
    assert (bench.sent_bytes - before) / 13 == pytest.approx(115_200 / (11 * 13), abs=3)


def test_the_pause_before_a_frame_ends_it() -> None:
    bench = Bench(lambda **options: RobotiqBox(still, **options))
    bench.device._received(FT300_READ[:3])
    bench.run(0.9 * RobotiqBox.frame_gap_s, RobotiqBox.frame_gap_s / 10)
    bench.device._received(FT300_READ[3:])
    bench.run(0.9 * RobotiqBox.frame_gap_s, RobotiqBox.frame_gap_s / 10)
    assert bench.sent_bytes == 0, "the frame may go on"
    bench.run(0.2 * RobotiqBox.frame_gap_s, RobotiqBox.frame_gap_s / 10)
    assert bench.sent_bytes == 17


@pytest.mark.parametrize(("pause_s", "streaming"), [(0.04, False), (0.06, True)])
def test_a_pause_restarts_the_count_of_a_jam(pause_s: float, streaming: bool) -> None:
    bench = Bench(STREAMS["ati-serial"][0])
    bench.run(0.1)
    bench.device._received(bytes(7))
    bench.run(pause_s)
    bench.device._received(bytes(7))
    assert bench.device.streaming is streaming


def test_delays_are_in_the_time_of_the_cell() -> None:
    bench = Bench(lambda **options: BotaBox(still, streaming_at_start=True, faults=Faults(delay_s=0.15), **options))
    bench.run(1.0)
    assert bench.arrivals[0][0] == pytest.approx(0.15, abs=2 * STEP_S)
    assert bench.sent_bytes / 37 == pytest.approx(86, abs=1)


def test_a_reset_node_is_silent_until_it_has_booted() -> None:
    bench = Bench(lambda **options: AtiCanNode(still, boot_s=0.15, **options))
    node = bench.device
    assert node._answer(CanFrame(0x20C)) == []
    bench.run(0.14)
    assert node._answer(CanFrame(0x205)) == []
    bench.run(0.02)
    assert node._answer(CanFrame(0x205)) == [CanFrame(0x205, b"FT12345\0")]


def test_a_banner_comes_when_the_sensor_has_booted() -> None:
    bench = Bench(lambda **options: BotaBox(still, boot_s=0.1, **options))
    bench.run(0.5)
    (setup_s, setup_bytes), (banner_s, banner_bytes) = bench.arrivals[:2]
    assert (setup_s, banner_s) == pytest.approx((0.05, 0.1), abs=2 * STEP_S)
    assert banner_bytes in (len(banner(12345)), len(banner(12345)) + 37)
    assert bench.sent_bytes - setup_bytes - len(banner(12345)) == pytest.approx(37 * 41, abs=37)


def test_a_count_of_samples_is_honoured() -> None:
    bench = Bench(lambda **options: NetFtBox(still, rate_hz=1000, **options))
    bench.device._request(Command.REAL_TIME, 25, ("127.0.0.1", 1))
    bench.run(0.5)
    assert [size for _, size in bench.arrivals] == [RECORD.itemsize] * 25
    assert not bench.device.streaming


def test_pacer_is_on_schedule() -> None:
    real = RealTime()
    clock = CellClock(real)
    pacer = Pacer(clock)
    assert (pacer.due(clock.now_s()), pacer.wait_s(0.0), pacer.running) == (0, None, False)
    pacer.start(100)
    counts = []
    for _ in range(335):
        real.pass_s(0.003)
        counts.append(pacer.due(clock.now_s()))
    assert counts[0] == 1, "the first sample at once"
    assert set(counts) == {0, 1}
    assert sum(counts) == pacer.made == 101
    assert all(a + b < 2 for a, b in pairwise(counts))
    pacer.stop()
    real.pass_s(10.0)
    assert pacer.due(clock.now_s()) == 0


@pytest.mark.parametrize("name", STREAMS)
def test_samples_are_measured_when_they_are_due_however_late_the_thread_is(name: str) -> None:
    bench = Bench(STREAMS[name][0])
    times_s: list[float] = []

    def measured(count: int) -> NDArray[np.float64]:
        due_s = bench.device.sample_times_s(count)
        assert due_s[-1] <= bench.clock.now_s()
        times_s.extend(due_s)
        return still(count)

    bench.device.measure = measured
    for step_s in (0.001, 0.007, 0.0003):
        bench.run(0.2, step_s)
    np.testing.assert_allclose(np.diff(times_s), 1 / STREAMS[name][2], rtol=1e-3 if name == "bota-fast" else 1e-6)
