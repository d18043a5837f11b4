"""Debian's MQTT broker on a free port of this computer, and a client that listens to it."""

import shutil
import socket
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import pytest
from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion

from tests.wire.waiting import wait_until


def free_port() -> int:
    """Return a port that no program listens at."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
    return port


class Mosquitto:
    """A broker that starts and stops, always on the same port; it keeps no message from one start to the next.

    Skips the test where mosquitto is not installed. `lines` are added to its configuration.
    """

    def __init__(self, folder: Path, *, user: str | None = None, password: str = "", lines: Sequence[str] = ()) -> None:
        program = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")
        if program is None:
            pytest.skip("mosquitto is not installed")
        self.port = free_port()
        self._process: subprocess.Popen[bytes] | None = None
        self._user, self._password = user, password
        rights = f"allow_anonymous {str(user is None).lower()}"
        lines = [f"listener {self.port} 127.0.0.1", "user root", rights, *lines]
        if user is not None:
            subprocess.run(["mosquitto_passwd", "-b", "-c", folder / "passwords", user, password], check=True)
            lines.append(f"password_file {folder / 'passwords'}")
        configuration = folder / "mosquitto.conf"
        configuration.write_text("\n".join(lines) + "\n")
        self._command = [program, "-c", str(configuration)]

    def start(self) -> None:
        """Start, and return when it accepts connections."""
        self._process = subprocess.Popen(self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_until(self._accepts)

    def stop(self) -> None:
        """End it at once, as a power failure does."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def retained(self, topics: str = "#") -> dict[str, str]:
        """Return what a client receives that comes now, by topic."""
        found, is_end = dict[str, str](), list[bool]()

        def note(_client: Client, _data: object, message: MQTTMessage) -> None:
            if message.topic == "end":
                is_end.append(True)
            elif message.retain:
                found[message.topic] = message.payload.decode()

        def subscribe(client: Client, *_: object) -> None:  # a client of the closure would be a cycle with its sockets
            client.subscribe([(topics, 0), ("end", 0)])
            client.publish("end", b"")  # the broker sends it after what it has retained

        client = Client(CallbackAPIVersion.VERSION2)
        client.username_pw_set(self._user, self._password)
        client.on_message = note
        client.on_connect = subscribe
        client.connect("127.0.0.1", self.port)
        client.loop_start()
        wait_until(lambda: is_end)
        client.disconnect()
        client.loop_stop()
        return found

    def _accepts(self) -> bool:
        assert self._process is not None
        assert self._process.poll() is None, "mosquitto has ended"
        with socket.socket() as one:
            return one.connect_ex(("127.0.0.1", self.port)) == 0
