"""The state of each cell as retained messages on an MQTT broker."""

import json
import re
import sys
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Event, Lock, Thread
from typing import Any, Final, Self
from urllib.parse import unquote, urlsplit

from ftcalib.files import JSON
from ftdrive.errors import ConfigError
from ftdrive.fleet.serve import FleetReading
from ftdrive.http_gate import with_port
from ftdrivers.installation import missing_extra

try:
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion
except ImportError:
    raise ConfigError(missing_extra("--mqtt", "paho-mqtt", "fleet")) from None

SCHEMA_VERSION: Final = 1
# Longest time between two attempts to connect; the first is after 1 s.
RECONNECT_S: Final = 60
_PORTS: Final = {"mqtt": 1883, "mqtts": 8883}
# Bad user name or password, and not authorized.
_REJECTED: Final = {134, 135}
# Wildcards, control characters and the broker's own topics, and what is left of a password that is not escaped.
_NO_TOPIC: Final = re.compile(r"[@+#\x00-\x1f\x7f]|^\$")
# So long a broker may take to receive the last message; then it sends the last will.
_GOODBYE_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class Broker:
    """An MQTT broker, and where in its topics the messages go."""

    host: str
    port: int
    is_tls: bool
    user: str | None
    password: str | None = field(repr=False)
    prefix: str
    """Before every topic: empty, or with a slash at its end."""

    @classmethod
    def of(cls, url: str) -> Self:
        """Read mqtt://[user:password@]host[:port][/prefix], or mqtts.

        Raises
        ------
        ConfigError
            It is no such address. The message does not repeat it, because it may contain a password.
        """
        try:
            parts = urlsplit(url)
            host, port = parts.hostname or "", parts.port
            host.encode("idna")
        except ValueError:  # also of a password with characters that must be escaped
            host, port = "", None
        prefix = "" if not host else unquote(parts.path).strip("/")
        if not host or parts.scheme not in _PORTS or re.search(r"[?#]", url) or _NO_TOPIC.search(prefix):
            raise ConfigError(
                "--mqtt is no address of a broker: give mqtt://[USER:PASSWORD@]HOST[:PORT][/PREFIX] or mqtts://…, with "
                "special characters as %XX"
            )
        user, password = (None if text is None else unquote(text) for text in (parts.username, parts.password))
        is_tls = parts.scheme == "mqtts"
        return cls(host, port or _PORTS[parts.scheme], is_tls, user, password, f"{prefix}/" if prefix else "")

    def __str__(self) -> str:
        return with_port(self.host, self.port)


class Messages:
    """Publishes the state of a fleet, and reconnects as long as it is open.

    A cell is published when its state has changed, and after each connection, because a broker may have lost it.
    Messages of cells that the fleet no longer has are cleared. All messages have quality of service 0. Those that are
    lost with a connection are published again with the next.

    Parameters
    ----------
    broker : Broker
    wake : Event
        Set when the broker rejects user or password, so that `update` is called at once.
    say : callable
        Takes a sentence for the operator, from any thread.
    """

    def __init__(self, broker: Broker, wake: Event, say: Callable[[str], None]) -> None:
        self._broker, self._wake, self._say = broker, wake, say
        self._lock = Lock()
        # What is retained at the broker, or will be, by topic.
        self._wanted: dict[str, bytes] = {}
        self._rejection: str | None = None
        # Whether the broker has answered last; None before its first answer or silence.
        self._answers: bool | None = None
        self._was_connected = self._is_open = False
        self._server_topic = f"{broker.prefix}ftdrive/server"
        self._cell_topics = f"{broker.prefix}ftdrive/cells/+/state"
        self._offline = _encoded({"schema_version": SCHEMA_VERSION, "online": False})
        self._client = client = Client(CallbackAPIVersion.VERSION2)
        client.reconnect_delay_set(1, RECONNECT_S)
        client.will_set(self._server_topic, self._offline, qos=1, retain=True)
        if broker.user is not None:
            client.username_pw_set(broker.user, broker.password)
        if broker.is_tls:
            client.tls_set()
        client.on_connect, client.on_connect_fail = self._on_connect, self._on_connect_fail
        client.on_disconnect, client.on_message = self._on_disconnect, self._on_message

    def update(self, reading: FleetReading) -> None:
        """Publish what has changed; the first call connects.

        Raises
        ------
        ConfigError
            The broker rejects user or password. Once it has accepted them, that counts as an outage.
        """
        if self._rejection is not None:
            raise ConfigError(
                f"the MQTT broker {self._broker} rejects the connection ({self._rejection}): check user and password"
            )
        wanted = {self._server_topic: _encoded(_about_server(reading))}
        for name, content in _about_cells(reading).items():
            wanted[self._cell_topics.replace("+", name)] = _encoded(content)
        with self._lock:
            before, self._wanted = self._wanted, wanted
            if self._answers:
                for topic in before.keys() - wanted.keys():
                    self._retain(topic, b"")
                for topic, payload in wanted.items():
                    if before.get(topic) != payload:
                        self._retain(topic, payload)
        if not self._is_open:
            self._is_open = True
            self._client.connect_async(self._broker.host, self._broker.port)
            self._client.loop_start()

    def close(self) -> None:
        """Publish that the server ends, and disconnect; waits for the broker for a second at most."""
        with self._lock:
            self._is_open = False
            if self._answers:
                self._retain(self._server_topic, self._offline)
        self._client.disconnect()
        stopping = Thread(target=self._stop, daemon=True)  # it may be in an attempt to connect
        stopping.start()
        stopping.join(_GOODBYE_S)

    def _stop(self) -> None:
        self._client.loop_stop()
        self._client.reinitialise()  # closes its sockets, which would else wait for the garbage collector

    # ------------------------------------------------------------------------------------------------ thread of paho

    def _on_connect(self, _client: Client, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        # Every connection publishes all again: with QoS 1 an old state would follow a newer one and stay retained.
        if reason.is_failure:
            if reason.value in _REJECTED and not self._was_connected:
                self._rejection = str(reason)
                self._client.disconnect()
                self._wake.set()
            else:
                self._lost(str(reason))
            return
        with self._lock:
            if not self._is_open:
                return
            if self._answers is False:
                self._say(f"The MQTT broker {self._broker} answers again.")
            self._answers = self._was_connected = True
            # Retained messages, also of cells that are gone.
            self._client.subscribe(self._cell_topics)
            for topic, payload in self._wanted.items():
                self._retain(topic, payload)

    def _on_connect_fail(self, _client: Client, _data: Any) -> None:
        if self._is_open:
            # Paho calls this where it handles the error.
            self._lost(_words(sys.exception()))

    def _on_disconnect(self, _client: Client, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if self._is_open and self._rejection is None:
            self._lost(str(reason))

    def _on_message(self, _client: Client, _data: Any, message: Any) -> None:
        with self._lock:
            if message.retain and message.topic not in self._wanted:
                self._retain(message.topic, b"")

    def _lost(self, reason: str) -> None:
        """Print once that the broker does not answer."""
        with self._lock:
            if self._answers is not False:
                self._say(f"The MQTT broker {self._broker} does not answer ({reason}). ftdrive tries to reconnect.")
            self._answers = False

    def _retain(self, topic: str, payload: bytes) -> None:
        """Have the broker keep a message; an empty one clears the topic."""
        self._client.publish(topic, payload, retain=True)


def _about_server(reading: FleetReading) -> dict[str, JSON]:
    return {
        "schema_version": SCHEMA_VERSION,
        "online": True,
        "store_up": reading.store_up,
        "state_utc": reading.read.isoformat(),
        "cells": len({one.cell for one in reading.fleet.cells}),
    }


def _about_cells(reading: FleetReading) -> dict[str, dict[str, JSON]]:
    """Return the message of each cell by name: its tools, and the findings that concern it."""
    tools, findings = defaultdict[str, list[JSON]](list), defaultdict[str, list[JSON]](list)
    for one in reading.fleet.cells:
        tools[one.cell].append(one.to_dict(reading.now))
    for finding in reading.fleet.findings:
        for cell in finding.cells:
            findings[cell].append({"kind": finding.kind, "words": finding.words})
    return {
        name: {"schema_version": SCHEMA_VERSION, "cell": name, "tools": some, "findings": findings[name]}
        for name, some in tools.items()
    }


def _encoded(content: dict[str, JSON]) -> bytes:
    return json.dumps(content, ensure_ascii=False).encode()


def _words(error: BaseException | None) -> str:
    return getattr(error, "strerror", None) or str(error or "no connection")
