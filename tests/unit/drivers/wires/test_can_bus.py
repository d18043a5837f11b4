"""A CAN bus behind an slcan adapter, on a pseudo-terminal."""

import os
from collections.abc import Iterator
from contextlib import suppress

import pytest

from ftdrivers.errors import StreamBroken
from ftdrivers.wires.can_bus import CanBus

ROOM = 65536
"""More than a pseudo-terminal holds."""


@pytest.fixture
def adapter() -> Iterator[tuple[int, str]]:
    master, slave = os.openpty()
    yield master, os.ttyname(slave)
    os.close(slave)


def test_an_adapter_that_takes_nothing_for_a_while_is_not_gone(adapter: tuple[int, str]) -> None:
    master, path = adapter
    bus = CanBus("a sensor", path, "slcan", 250_000)
    bus.open()
    tty = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    with suppress(BlockingIOError):
        while True:
            os.write(tty, bytes(1024))
    os.close(tty)
    for _ in range(3):
        bus.send(0x20, b"lost")
    os.set_blocking(master, False)
    with suppress(BlockingIOError):
        while True:
            os.read(master, ROOM)
    bus.send(0x20, b"\x01\x02")
    assert os.read(master, ROOM) == b"t02020102\r"
    os.close(master)
    with pytest.raises(StreamBroken, match="was lost"):
        bus.send(0x20, b"")
    bus.close()
