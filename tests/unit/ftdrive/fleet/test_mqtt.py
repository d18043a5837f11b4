"""Addresses of MQTT brokers, and what is published there, with a fake client."""

import json
from threading import Event
from types import SimpleNamespace
from typing import Any, cast

import pytest
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from ftdrive.errors import ConfigError
from ftdrive.fleet.mqtt import Broker, Messages
from tests.unit.ftdrive.fleet.fleets import cell, reading


@pytest.mark.parametrize(
    ("url", "wanted"),
    [
        ("mqtt://broker", Broker("broker", 1883, False, None, None, "")),
        ("mqtts://broker/", Broker("broker", 8883, True, None, None, "")),
        ("mqtt://u:p%40%2F@10.0.0.2:1884/plant/hall", Broker("10.0.0.2", 1884, False, "u", "p@/", "plant/hall/")),
        ("mqtt://u@[::1]:99", Broker("::1", 99, False, "u", None, "")),
    ],
)
def test_an_address_has_everything_a_client_needs(url: str, wanted: Broker) -> None:
    assert Broker.of(url) == wanted


@pytest.mark.parametrize(
    "url",
    [
        "broker",
        "http://u:secret@broker",
        "mqtt://",
        "mqtt://u:secret@broker:99999",
        "mqtt://u:12/secret@broker",  # a slash in the password ends the host
        "mqtt://u:secret/@broker",
        "mqtt://u:secret#@broker",
        "mqtt://u:secret@broker/a+b",
        "mqtt://u:secret@broker/a%2Bb",
        "mqtt://u:secret@broker/plant/#",
        "mqtt://u:secret@broker/a%00b",
        "mqtt://u:secret@broker/$SYS",
        "mqtt://u:secret@broker?tls=1",
        "mqtt://u:secret@bro..ker",
    ],
)
def test_a_wrong_address_is_refused_without_its_password(url: str) -> None:
    with pytest.raises(ConfigError, match="--mqtt is no address of a broker: give mqtt://") as error:
        Broker.of(url)
    assert "secret" not in str(error.value)


def test_a_password_is_never_printed() -> None:
    broker = Broker.of("mqtt://u:secret@[::1]")
    assert "secret" not in repr(broker)
    assert str(broker) == "[::1]:1883"


class FakeClient:
    """A client of a broker that keeps what is published, and answers when the test says so."""

    on_connect: Any
    on_connect_fail: Any
    on_disconnect: Any
    on_message: Any

    def __init__(self, version: CallbackAPIVersion) -> None:
        assert version is CallbackAPIVersion.VERSION2
        self.called: list[tuple[Any, ...]] = []
        self.retained: dict[str, bytes] = {}

    def __getattr__(self, name: str) -> Any:
        return lambda *given, **named: self.called.append((name, *given, *named.values()))

    def publish(self, topic: str, payload: bytes, *, retain: bool) -> None:
        assert retain
        self.called.append(("publish", topic))
        self.retained[topic] = payload

    def connects(self, name: str = "Success") -> None:
        self.on_connect(self, None, None, ReasonCode(PacketTypes.CONNACK, name), None)

    def disconnects(self) -> None:
        self.on_disconnect(self, None, None, ReasonCode(PacketTypes.DISCONNECT, "Server shutting down"), None)

    def take(self) -> list[tuple[Any, ...]]:
        taken, self.called = self.called, []
        return taken


class Fleet:
    """Messages of a fleet to a fake broker."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, url: str = "mqtt://broker") -> None:
        monkeypatch.setattr("ftdrive.fleet.mqtt.Client", FakeClient)
        self.wake, self.said = Event(), list[str]()
        self.messages = Messages(Broker.of(url), self.wake, self.said.append)
        self.client = cast("FakeClient", self.messages._client)

    def published(self) -> list[str]:
        return [call[1] for call in self.client.take() if call[0] == "publish"]


SERVER, A, B = "ftdrive/server", "ftdrive/cells/A/state", "ftdrive/cells/B/state"
LOST = "The MQTT broker broker:1883 does not answer ({}). ftdrive tries to reconnect."


def test_user_certificate_and_last_will_are_those_of_the_address(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = Fleet(monkeypatch)
    offline = b'{"schema_version": 1, "online": false}'
    will = ("will_set", SERVER, offline, 1, True)
    assert plain.client.take() == [("reconnect_delay_set", 1, 60), will]
    called = Fleet(monkeypatch, "mqtts://u:p@broker:99/hall").client.take()
    assert called[1:] == [("will_set", f"hall/{SERVER}", *will[2:]), ("username_pw_set", "u", "p"), ("tls_set",)]


def test_only_changes_are_published_and_all_after_a_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet(monkeypatch)
    fleet.client.take()
    fleet.messages.update(reading(cell("A"), cell("B")))
    fleet.messages.update(reading(cell("A"), cell("B")))
    assert fleet.client.take() == [("connect_async", "broker", 1883), ("loop_start",)]
    fleet.client.connects()
    assert ("subscribe", "ftdrive/cells/+/state") in fleet.client.called
    assert fleet.published() == [SERVER, A, B]
    fleet.messages.update(reading(cell("A"), cell("B")))
    assert fleet.published() == []
    fleet.messages.update(reading(cell("A", mass_kg=2.0)))
    assert fleet.published() == [B, SERVER, A]
    assert fleet.client.retained[B] == b""
    assert json.loads(fleet.client.retained[SERVER])["cells"] == 1
    assert json.loads(fleet.client.retained[A])["tools"][0]["mass_kg"] == 2.0
    fleet.client.connects()
    assert fleet.published() == [SERVER, A]
    assert not fleet.said


def test_a_cell_that_is_gone_is_cleared_when_the_broker_shows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet(monkeypatch)
    fleet.messages.update(reading(cell("A")))
    fleet.client.connects()
    fleet.client.take()
    for topic, retain in ((A, True), (B, True), ("ftdrive/cells/C/state", False)):
        fleet.client.on_message(fleet.client, None, SimpleNamespace(topic=topic, retain=retain))
    assert fleet.published() == [B]


def test_an_outage_is_printed_once_until_it_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet(monkeypatch)
    fleet.messages.update(reading(cell("A")))
    try:
        raise ConnectionRefusedError(111, "Connection refused")
    except OSError:
        fleet.client.on_connect_fail(fleet.client, None)
    fleet.client.on_connect_fail(fleet.client, None)
    assert fleet.said == [LOST.format("Connection refused")]
    fleet.client.take()
    fleet.messages.update(reading(cell("B")))
    assert fleet.client.take() == []
    fleet.client.connects()
    assert fleet.published() == [SERVER, B]
    fleet.client.disconnects()
    fleet.client.connects("Not authorized")  # after a connection that is an outage
    assert fleet.said[1:] == ["The MQTT broker broker:1883 answers again.", LOST.format("Server shutting down")]
    fleet.messages.update(reading(cell("B")))
    assert not fleet.wake.is_set()


@pytest.mark.parametrize("name", ["Bad user name or password", "Not authorized"])
def test_a_rejection_at_the_start_is_one_sentence(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet(monkeypatch)
    fleet.messages.update(reading(cell("A")))
    fleet.client.take()
    fleet.client.connects(name)
    assert fleet.client.take() == [("disconnect",)]
    fleet.client.disconnects()
    assert fleet.wake.is_set()
    assert not fleet.said
    with pytest.raises(ConfigError, match=rf"broker:1883 rejects the connection \({name}\)"):
        fleet.messages.update(reading(cell("A")))


def test_a_busy_broker_at_the_start_is_an_outage(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet(monkeypatch)
    fleet.messages.update(reading(cell("A")))
    fleet.client.connects("Server busy")
    assert fleet.said == [LOST.format("Server busy")]
    assert not fleet.wake.is_set()


def test_a_failed_attempt_without_a_reason_is_no_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet(monkeypatch)
    fleet.messages.update(reading(cell("A")))
    fleet.client.on_connect_fail(fleet.client, None)
    assert fleet.said == [LOST.format("no connection")]


@pytest.mark.parametrize("answers", [True, False])
def test_the_end_is_published_if_the_broker_answers(answers: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet(monkeypatch)
    fleet.messages.update(reading(cell("A")))
    if answers:
        fleet.client.connects()
    fleet.client.take()
    fleet.messages.close()
    goodbye = [("publish", SERVER)] if answers else []
    assert fleet.client.take() == [*goodbye, ("disconnect",), ("loop_stop",), ("reinitialise",)]
    fleet.client.disconnects()
    fleet.client.on_connect_fail(fleet.client, None)
    fleet.client.connects()
    assert not fleet.said
    assert fleet.client.take() == []
