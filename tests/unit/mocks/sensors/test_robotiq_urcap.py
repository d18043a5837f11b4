"""The text stream of the emulated URCap."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from ftmocks.sensors.robotiq_urcap import RobotiqUrcap

WRENCH = [12.34, -5.67, 100, 0.15, -0.025, 1]
TEXT = b"( 12.340000 , -5.670000 , 100.000000 , 0.150000 , -0.025000 , 1.000000 )"


@contextmanager
def connected(box: RobotiqUrcap, count: int) -> Iterator[list[socket.socket]]:
    where = box.start()
    clients = [socket.create_connection((where["host"], where["port"]), timeout=30) for _ in range(count)]
    try:
        yield clients
    finally:
        for client in clients:
            client.close()
        box.stop()


def received(client: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += client.recv(count - len(data))
    return data


def test_every_client_receives_readings_in_the_resolution_of_the_sensor() -> None:
    box = RobotiqUrcap(lambda n: np.tile(np.array(WRENCH) + 0.0004, (n, 1)), port=0)
    with connected(box, 2) as clients:
        clients[0].sendall(b"SET ZRO")
        for client in clients:
            assert received(client, 3 * len(TEXT)) == 3 * TEXT, "without anything between"
        clients[0].close()
        assert received(clients[1], 20 * len(TEXT)) == 20 * TEXT
