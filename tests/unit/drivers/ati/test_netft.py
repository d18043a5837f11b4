"""RDT through pynetft: golden datagrams against a small scripted box, and what is done with its oddities."""

import math
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Self

import numpy as np
import pytest

from ftdrivers.ati.netft import (
    NetFtSensor,
    transformation_in,
)
from ftdrivers.errors import BadUrl, ConnectError, DeviceFault, StreamBroken
from ftdrivers.interfaces import Fact, Health
from ftdrivers.registry import sensor_from_url
from tests.cell_time import CellTime

START, STOP = bytes.fromhex("1234 0002 0000 0000"), bytes.fromhex("1234 0000 0000 0000")
RECORD = bytes.fromhex("00000001 000003E8 00000000 0016E360 FFDDAAF0 00989680 000186A0 FFFF3CB0 000061A8")
PAGE = (
    b"<netft><prodname>Ethernet Axia</prodname><cfgcpf>1000000</cfgcpf><cfgcpt>1000000</cfgcpt>"
    b"<scfgfu>N</scfgfu><scfgtu>Nm</scfgtu><cfgcalsn>FT12345</cfgcalsn></netft>"
)
FRAME = b"<cfgtfx>0;0;132.710;0;0;0</cfgtfx><scfgtdu>mm</scfgtdu><scfgtau>degrees</scfgtau>"
"""Of a live box, as are the range and the bias below."""


def record(number: int, status: int = 0) -> bytes:
    return struct.pack(">III", number, 999 + number, status) + RECORD[12:]


class Box:
    """Sends the records it is given after START, then one each 2 ms; ignores the first `deaf` requests to start.

    It and its driver live in the time of an emulated cell, which waits for both.
    """

    def __init__(self, *records: bytes, deaf: int = 0, page: bytes = PAGE) -> None:
        self.time = CellTime()
        self.records = list(records)
        self._deaf = deaf
        self.heard: list[bytes] = []
        self.asked = asked = list[str]()
        self.mute = False
        self.mute_and_then: list[bytes] = []
        """While it is not empty nothing is sent; the next request to start is answered by these records first."""
        self._end = threading.Event()

        class Pages(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                asked.append(self.path)
                self.send_response(200)
                self.send_header("Content-Length", str(len(page)))
                self.end_headers()
                self.wfile.write(page)

            def log_message(self, *_: object) -> None:
                pass

        self._http = HTTPServer(("127.0.0.1", 0), Pages)
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind(("127.0.0.1", 0))
        self._udp.settimeout(0.002)
        self._threads = [
            threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.01}),
            threading.Thread(target=self._run),
        ]

    def sensor(self, *, onrobot: bool = False) -> NetFtSensor:
        return NetFtSensor(
            "127.0.0.1",
            onrobot=onrobot,
            rdt_port=self._udp.getsockname()[1],
            http_port=self._http.server_port,
            clock=self.time.of_drivers,
        )

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._http.shutdown()
        for thread in self._threads:
            thread.join()
        self._http.server_close()
        self._udp.close()
        self.time.close()

    def _run(self) -> None:
        with self.time.of_devices.keeping_up():
            self._send()

    def _send(self) -> None:
        client, number = None, 0
        while not self._end.is_set():
            self.time.of_devices.follow()
            try:
                request, who = self._udp.recvfrom(100)
                self.heard.append(request)
                if request == START and self._deaf:
                    self._deaf -= 1
                else:
                    client = who if request == START else None
                    if client and self.mute_and_then:
                        self.records, self.mute_and_then = self.mute_and_then, []
            except TimeoutError:
                pass
            if client is not None and not self.mute and not self.mute_and_then:
                waiting, self.records = self.records, []
                number += len(waiting) or 1
                for datagram in waiting or [record(number)]:
                    self._udp.sendto(datagram, client)


def test_start_stop_and_record_are_golden() -> None:
    with Box(RECORD) as box:
        with box.sensor() as sensor:
            first = sensor.latest(timeout_s=0.5)
            samples = sensor.collect(0.1)
            info = sensor.identify()
        while len(box.heard) < 2:
            time.sleep(0.005)
    assert box.heard == [START, STOP]  # no bias, 0x0042
    np.testing.assert_allclose(first.wrench[0], [1.5, -2.25, 10, 0.1, -0.05, 0.025])
    assert first.counts[0].tolist() == [1_500_000, -2_250_000, 10_000_000, 100_000, -50_000, 25_000]
    assert (np.diff(samples.seq) == 1).all()
    assert (info.model, info.serial) == ("Ethernet Axia", "FT12345")
    assert info.facts["counts_per_N"] == Fact(1e6, "device")


@pytest.mark.parametrize(
    ("status", "says"),
    [(0x88000000, r"0x88000000 \(bit 27: gauge out of range, bit 31: any error\)"), (0x04000000, "gauge near")],
)
def test_a_fault_in_the_stream_is_named(status: int, says: str) -> None:
    with Box() as box, box.sensor() as sensor:
        box.records = [record(100_000, status)]
        with pytest.raises(DeviceFault, match=says):
            sensor.collect(1.0)


def test_a_device_that_does_not_answer() -> None:
    with pytest.raises(ConnectError, match="configuration cannot be read"):
        NetFtSensor("127.0.0.1", http_port=1).open()
    with pytest.raises(ConnectError, match="check"):
        NetFtSensor(" ", onrobot=True).open()


def test_missing_library_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pynetft", None)
    monkeypatch.delitem(sys.modules, "ftdrivers.ati.netft")
    with pytest.raises(BadUrl, match=r"install it with `.*netft"):
        sensor_from_url("ati-netft://192.168.1.1")


def test_rate_range_and_bias_are_the_devices() -> None:
    more = b"<comrdtrate>500</comrdtrate><cfgmr>330;330;990;30;30;30</cfgmr><setbias>745;17;447;184;-596;-253</setbias>"
    with Box(page=PAGE.replace(b"</netft>", more + b"</netft>")) as box, box.sensor() as sensor:
        facts = sensor.identify().facts
        assert facts["range"] == Fact((330.0, 330.0, 990.0, 30.0, 30.0, 30.0), "device")
        assert facts["software_bias"] == Fact((745.0, 17.0, 447.0, 184.0, -596.0, -253.0), "device")
        assert "tool_transformation" not in facts
        assert sensor.health().nominal_rate_Hz == 500
        assert set(box.asked) == {"/netftapi2.xml"}
    other_units = PAGE.replace(b">N<", b">lbf<").replace(b">Nm<", b">lbf-in<")
    with (
        Box(page=other_units.replace(b"</netft>", b"<cfgmr>1;1;2;1;1;1</cfgmr></netft>")) as box,
        box.sensor() as sensor,
    ):
        facts = sensor.identify().facts
        assert facts["counts_per_N"].value == pytest.approx(1e6 / 4.4482216152605)
        assert facts["counts_per_Nm"].value == pytest.approx(1e6 / 0.1129848290276167)
        assert facts["range"].value == pytest.approx(
            [4.4482216152605] * 2 + [8.896443230521] + [0.1129848290276167] * 3
        )
    without = more.replace(b"990;", b"").replace(b"745;17;447;184;-596;-253", b"0;0;0;0;0;0").replace(b"500", b"0")
    with Box(page=PAGE.replace(b"</netft>", without + b"</netft>")) as box, box.sensor() as sensor:
        facts = sensor.identify().facts
        assert "range" not in facts
        assert facts["software_bias"] == Fact((0.0,) * 6, "device")
        assert math.isnan(sensor.health().nominal_rate_Hz)


def test_tool_transformation_of_the_box_is_undone() -> None:
    """The torque about the origin of the transducer is the one sent plus d × F: 0.13271 m × (1.5, -2.25, 10) N."""
    with Box(RECORD, page=PAGE.replace(b"</netft>", FRAME + b"</netft>")) as box, box.sensor() as sensor:
        sample = sensor.latest(timeout_s=0.5)
        wrench = [1.5, -2.25, 10, 0.1 + 0.13271 * 2.25, -0.05 + 0.13271 * 1.5, 0.025]
        np.testing.assert_allclose(sample.wrench[0], wrench)
        assert sample.counts[0].tolist() == [1_500_000, -2_250_000, 10_000_000, 100_000, -50_000, 25_000]
        assert sensor.identify().facts["tool_transformation"].value == "0;0;132.710;0;0;0 (mm, degrees)"


@pytest.mark.parametrize(
    ("distance", "angle", "per_m", "per_degree"),
    [("in", "degrees", 1 / 0.0254, 1.0), ("ft", "degrees", 1 / 0.3048, 1.0), ("cm", "radians", 100.0, math.pi / 180)],
)
def test_tool_transformation_turns_about_x_then_y_then_z(
    distance: str, angle: str, per_m: float, per_degree: float
) -> None:
    """Compare with ATI's own matrix, F' = R F and T' = R (T - d × F) with the rows of R as in ftconfig.c."""
    d, turns = np.array([0.01, -0.02, 0.1]), np.radians([20.0, -30.0, 40.0])
    (sx, sy, sz), (cx, cy, cz) = np.sin(turns), np.cos(turns)
    R = np.array(
        [
            [cy * cz, sx * sy * cz + cx * sz, sx * sz - cx * sy * cz],
            [-cy * sz, -sx * sy * sz + cx * cz, sx * cz + cx * sy * sz],
            [sy, -sx * cy, cx * cy],
        ]
    )
    force, torque = np.array([1.0, 2.0, 3.0]), np.array([0.4, 0.5, 0.6])
    sent = np.concatenate([R @ force, R @ (torque - np.cross(d, force))])
    values = ";".join(f"{value:.15g}" for value in [*(per_m * d), *(per_degree * np.degrees(turns))])
    page = f"<cfgtfx>{values}</cfgtfx><scfgtdu>{distance}</scfgtdu><scfgtau>{angle}</scfgtau>".encode()
    np.testing.assert_allclose(transformation_in(page) @ sent, [*force, *torque], atol=1e-9)


@pytest.mark.parametrize(
    "page", [FRAME.replace(b"mm", b"yd"), FRAME.replace(b"degrees", b""), FRAME.replace(b"0;", b"")]
)
def test_tool_transformation_that_cannot_be_undone_is_refused(page: bytes) -> None:
    with (
        Box(page=PAGE.replace(b"</netft>", page + b"</netft>")) as box,
        pytest.raises(ConnectError, match=r"cannot be undone.*set it to zero"),
    ):
        box.sensor().open()


@pytest.mark.slow
def test_silence_ends_the_stream() -> None:
    with Box() as box, box.sensor() as sensor:
        box.mute = True
        heard_s = sensor.latest(timeout_s=0.5).t_host_ns[0] / 1e9
        with pytest.raises(StreamBroken, match=r"ended \(nothing arrived for 0\.3"):
            sensor.collect(60.0)
        # The silence ended it, not the time of `collect`; a busy computer adds to the 0.3 s.
        assert 0.3 <= box.time.of_drivers.now_s() - heard_s < 30


@pytest.mark.slow
def test_what_was_thrown_away_is_counted_since_open() -> None:
    with Box(*map(record, [1, 2, 2, 3, 5, 4, 6]), RECORD[:-1]) as box:
        sensor = box.sensor()
        sensor.recover = True
        counted: list[tuple[int, int, int]] = []

        def wait_for(condition: Callable[[Health], bool]) -> None:
            while not condition(health := sensor.health()):
                counted.append((health.duplicated, health.out_of_order, health.malformed))
                time.sleep(0.005)

        with sensor:
            wait_for(lambda health: (health.duplicated, health.out_of_order, health.malformed) == (1, 1, 1))
            counted.clear()
            box.mute_and_then = [*map(record, [1, 2, 2, 3])]
            wait_for(lambda health: health.reconnects > 0)
            wait_for(lambda health: health.duplicated == 2)
            sensor.latest(timeout_s=1.0)
        after = sensor.health()
        assert (after.duplicated, after.out_of_order, after.malformed) == (2, 1, 1)
        assert set(counted) <= {(1, 1, 1), (2, 1, 1)}  # nothing is forgotten while there is no stream
        sensor.open()
        assert sensor.health().duplicated == 0
        sensor.close()
