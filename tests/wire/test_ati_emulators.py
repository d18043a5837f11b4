"""The emulated ATI sensors behind their pseudo-terminals, as python-can and pyserial see them."""

import termios
from contextlib import ExitStack
from typing import Any

import can
import numpy as np
import pytest
import serial

from ftmocks.sensors.ati_can import AtiCanNode
from ftmocks.sensors.ati_serial import AtiSerialBox
from tests.wire.waiting import LIMIT_S, drain, wait_until

WRENCH = np.array([-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608])
START, STARTED = bytes.fromhex("0A 46 55 A3 9D"), bytes.fromhex("0A 46 01 A2 62")
UNPLUGGED = (serial.SerialException, can.CanError, OSError, termios.error)


def constant(count: int) -> Any:
    return np.tile(WRENCH, (count, 1))


@pytest.mark.parametrize("make", [AtiCanNode, AtiSerialBox])
def test_unplugging_fails_the_client_and_stop_is_idempotent(make: type[AtiCanNode | AtiSerialBox]) -> None:
    device = make(constant)
    device.stop()
    with ExitStack() as stack:
        stack.callback(device.stop)
        port = stack.enter_context(serial.Serial(device.start(), timeout=LIMIT_S))
        with pytest.raises(RuntimeError, match="runs already"):
            device.start()
        device.unplug()
        with pytest.raises(UNPLUGGED):
            port.read(1)
        with pytest.raises(UNPLUGGED):
            port.write(b"\r")
    device.stop()
    device.stop()


def test_can_host_that_never_reads_costs_frames_not_memory() -> None:
    asked = answered = 0

    def counted(count: int) -> Any:
        nonlocal answered
        answered += 1
        return constant(count)

    node = AtiCanNode(counted, boot_s=0.05)
    with ExitStack() as stack:
        stack.callback(node.stop)
        port = stack.enter_context(serial.Serial(node.start(), timeout=LIMIT_S))
        port.write(b"S5\rO\r")
        while not node.dropped_frames:
            port.write(b"t2000\r" * 50)
            port.flush()
            asked += 50
        wait_until(lambda: answered == asked)
        assert len(node._answers) + len(node._unsent) < 40_000, "the answers to one read of 4096 bytes"
        received, firmware = drain(port), b"t20F403080002\r"
        while firmware not in received:  # a request whose answer has no room is lost too
            port.write(b"t20F0\r")
            received += drain(port)
        lines = set(received.split(b"\r"))
        assert lines == {b"", b"z", b"t200800000064012C01F4", b"t2016FF38FE70FDA8", firmware[:-1]}


def test_serial_host_that_does_not_read_loses_whole_records() -> None:
    rng = np.random.default_rng(3)
    box = AtiSerialBox(lambda n: WRENCH + rng.normal(scale=[0.05] * 3 + [0.002] * 3, size=(n, 6)))
    with ExitStack() as stack:
        stack.callback(box.stop)
        port = stack.enter_context(serial.Serial(box.start(), 1_250_000, timeout=LIMIT_S))
        port.write(START)
        assert port.read(5) == STARTED
        wait_until(lambda: box.dropped_frames > 100)
        assert len(box._unsent) < 13
        records = np.frombuffer(port.read(13 * 4000), dtype=np.uint8).reshape(-1, 13)
        assert len(records) == 4000
        assert ((records[:, :12].sum(axis=1) & 0x7F) == (records[:, 12] & 0x7F)).all()
        assert port.in_waiting < 20_000
