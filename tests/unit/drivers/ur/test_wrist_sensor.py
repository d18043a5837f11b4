"""The wrist sensor over RTDE, against a small scripted controller."""

import os
import socket
import struct
import threading
import time
from contextlib import suppress
from typing import Self

import numpy as np
import pytest

from drivers.errors import ConnectError, StreamBroken
from drivers.interfaces import Fact
from drivers.registry import BadUrl, sensor_from_url
from drivers.ur import rtde
from drivers.ur.sensor import UrWristSensor

HOST = f"127.84.{os.getpid() % 251}.1"  # its own loopback address: the port is fixed
RAW = [20_000.0, -4_000.0, 1_000.0, 50.0, -20.0, 10.0]


class Controller:
    """Answers the greeting, then tells `times` once and goes on in steps of 2 ms."""

    def __init__(self, *times: float, types: bytes = b"DOUBLE,VECTOR6D", raw: list[float] | None = None) -> None:
        self._times = list(times)
        self._raw = raw or RAW
        self._answers = {
            "V": bytes.fromhex("00045601"),
            "v": bytes.fromhex("001376 00000005 0000000f 00000000 00000001"),
            "O": rtde.encode(rtde.SETUP_OUTPUTS, b"\x01" + types),
            "S": bytes.fromhex("00045301"),
        }
        self.heard: list[bytes] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._listener = socket.create_server((HOST, rtde.PORT))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.hang_up()
        self._thread.join(5)

    def hang_up(self) -> None:
        self._end.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _run(self) -> None:
        with suppress(OSError):
            client, _ = self._listener.accept()
            with client:
                while not self.heard or chr(self.heard[-1][2]) != "S":
                    request = client.recv(4096)
                    if not request:
                        return
                    self.heard.append(request)
                    answer = self._answers[chr(request[2])]
                    if request[2:3] == b"O" and b"ft_raw_wrench" not in request:
                        answer = rtde.encode(rtde.SETUP_OUTPUTS, b"\x01DOUBLE")
                    client.sendall(answer)
                t_s = 100.0
                while not self._end.wait(0.002):
                    t_s = self._times.pop(0) if self._times else t_s + 0.002
                    client.sendall(rtde.encode(rtde.DATA, b"\x01" + struct.pack(">7d", t_s, *self._raw)))


def sensor() -> UrWristSensor:
    return UrWristSensor(HOST, counts_per_N=200.0, counts_per_Nm=100.0)


def test_raw_wrench_is_scaled_as_told_and_only_read() -> None:
    with Controller() as controller, sensor() as wrist:
        samples = wrist.collect(0.1)
        info = wrist.identify()
    np.testing.assert_allclose(samples.wrench[0], [100, -20, 5, 0.5, -0.2, 0.1])
    assert samples.counts.shape == (len(samples), 0)
    assert (np.diff(samples.seq) == 1).all()
    np.testing.assert_allclose(np.diff(samples.t_device_s), 0.002, atol=1e-9)
    assert "ft_raw_wrench" in info.model
    assert info.facts["counts_per_N"] == Fact(200.0, "configured")
    assert "serial" not in info.facts
    assert info.firmware == "5.15.0.1"
    assert controller.heard[2] == rtde.encode_setup_outputs(500.0, ("timestamp", "ft_raw_wrench"))
    assert [chr(request[2]) for request in controller.heard] == ["V", "v", "O", "S"]


def test_skipped_cycles_are_gaps() -> None:
    with Controller(99.998, 100.0, 100.002, 100.01, 100.012), sensor() as wrist:
        wrist.collect(0.05)
        assert wrist.health().lost >= 3
        assert wrist.health().nominal_rate_Hz == 500


def test_a_clock_that_goes_back_ends_the_stream() -> None:
    backwards = Controller(*[50 + 0.002 * k for k in range(50)], 1.0)
    with backwards, sensor() as wrist, pytest.raises(StreamBroken, match=r"went back to 1\.000 s"):
        wrist.collect(1.0)


def test_lost_connection() -> None:
    with Controller() as controller, sensor() as wrist:
        begin = time.monotonic()
        threading.Timer(0.1, controller.hang_up).start()
        with pytest.raises(StreamBroken, match="connection was lost"):
            wrist.collect(5.0)
        assert time.monotonic() - begin < 0.6


def test_old_controllers_do_not_tell() -> None:
    with Controller(types=b"DOUBLE,NOT_FOUND"), pytest.raises(ConnectError, match=r"PolyScope 5\.9 or later"):
        sensor().open()


def test_a_wrench_that_is_no_number_ends_the_stream() -> None:
    with Controller(raw=[float("nan")] * 6), pytest.raises(ConnectError, match="no wrench"):
        sensor().open()


def test_nobody_there() -> None:
    with pytest.raises(ConnectError, match="cannot be reached"):
        sensor().open()


@pytest.mark.parametrize(
    ("query", "says"),
    [
        ("", "'counts_per_N' is missing: the unit of ft_raw_wrench is not documented"),
        ("?counts_per_N=1", "'counts_per_Nm' is missing"),
        ("?counts_per_N=0&counts_per_Nm=1", "must be a positive number"),
        ("?counts_per_N=nan&counts_per_Nm=1", "must be a positive number"),
        ("?counts_per_N=1&counts_per_Nm=x", "must be a positive number"),
    ],
)
def test_without_a_scale_there_is_no_sensor(query: str, says: str) -> None:
    with pytest.raises(BadUrl, match=says):
        sensor_from_url(f"ur-ft://192.168.1.10{query}")
