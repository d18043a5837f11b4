"""Messages of a fleet as a client of a real MQTT broker receives them."""

import gc
import json
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from socket import socket
from threading import Event
from typing import Any

import pytest

from ftdrive.errors import ConfigError
from ftdrive.fleet.mqtt import Broker, Messages
from ftdrive.fleet.state import FleetFinding
from tests.mosquitto import Mosquitto
from tests.unit.ftdrive.fleet.fleets import DRIFTING, NOW, cell, never_calibrated, reading
from tests.wire.waiting import wait_until

pytestmark = pytest.mark.slow  # every test needs a process of its own

A, B = "ftdrive/cells/A/state", "ftdrive/cells/B/state"


class Said(list[str]):
    """What the operator reads."""

    @property
    def text(self) -> str:
        return "\n".join(self)


@contextmanager
def messages(
    mosquitto: Mosquitto, user: str = "", prefix: str = "", scheme: str = "mqtt"
) -> Iterator[tuple[Messages, Said, Event]]:
    broker = Broker.of(f"{scheme}://{user}127.0.0.1:{mosquitto.port}{prefix}")
    said, wake = Said(), Event()
    with closing(Messages(broker, wake, said.append)) as found:
        yield found, said, wake


def cells_at(mosquitto: Mosquitto) -> set[str]:
    return {topic.split("/")[2] for topic in mosquitto.retained("ftdrive/cells/#")}


def server_at(mosquitto: Mosquitto) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(mosquitto.retained("ftdrive/server")["ftdrive/server"])
    return found


def test_each_cell_has_a_retained_message_and_the_server_one(tmp_path: Path) -> None:
    base = FleetFinding("base", ("A", "B"), "the base of A and B has tilted")
    gripper, drill = cell("A", drift=DRIFTING, due=NOW - timedelta(days=1)), cell("A", "drill", change="bias")
    with Mosquitto(tmp_path) as mosquitto, messages(mosquitto) as (found, said, _):
        found.update(reading(gripper, drill, never_calibrated("B"), findings=(base,), store_up=False))
        wait_until(lambda: len(mosquitto.retained()) == 3)
        kept = {topic: json.loads(payload) for topic, payload in mosquitto.retained().items()}
    assert not said
    assert kept["ftdrive/server"] == {
        "schema_version": 1,
        "online": True,
        "store_up": False,
        "state_utc": "2026-11-22T12:00:00+00:00",
        "cells": 2,
    }
    assert (kept[A]["cell"], [tool["tool"] for tool in kept[A]["tools"]]) == ("A", ["gripper", "drill"])
    assert kept[A]["tools"][0]["is_due"]
    assert kept[A]["tools"][0]["due"] == "2026-11-21T12:00:00+00:00"
    assert kept[A]["tools"][0]["drift"] == {"level_sigmas": 6.5, "found": True, "words": DRIFTING.words}
    assert (kept[A]["tools"][1]["is_due"], kept[A]["tools"][1]["change"]) == (False, "bias")
    uncalibrated = {"cell": "B", "is_due": True, "emulated": False}
    assert kept[B]["tools"] == [dict.fromkeys(kept[A]["tools"][0]) | uncalibrated]
    assert kept[A]["findings"] == kept[B]["findings"] == [{"kind": "base", "words": base.words}]


def test_a_cell_that_disappears_is_cleared_also_while_the_server_was_down(tmp_path: Path) -> None:
    with Mosquitto(tmp_path) as mosquitto:
        with messages(mosquitto) as (found, _, _):
            found.update(reading(cell("A"), cell("B"), cell("C")))
            wait_until(lambda: cells_at(mosquitto) == {"A", "B", "C"})
            found.update(reading(cell("A"), cell("C")))
            wait_until(lambda: cells_at(mosquitto) == {"A", "C"})
        assert not server_at(mosquitto)["online"]
        with messages(mosquitto) as (found, _, _):
            found.update(reading(cell("C")))
            wait_until(lambda: cells_at(mosquitto) == {"C"})
            assert server_at(mosquitto)["online"]


def test_a_prefix_keeps_two_servers_apart(tmp_path: Path) -> None:
    with (
        Mosquitto(tmp_path) as mosquitto,
        messages(mosquitto) as (one, _, _),
        messages(mosquitto, prefix="/hall 2") as (two, _, _),
    ):
        two.update(reading(cell("Zelle-ü.2")))
        wait_until(lambda: len(mosquitto.retained()) == 2)
        one.update(reading(cell("A")))
        wait_until(lambda: len(mosquitto.retained()) == 4)
        assert mosquitto.retained().keys() == {
            A,
            "ftdrive/server",
            "hall 2/ftdrive/cells/Zelle-ü.2/state",
            "hall 2/ftdrive/server",
        }


def test_a_broker_that_is_down_ends_nothing_and_is_mentioned_once(tmp_path: Path) -> None:
    with Mosquitto(tmp_path) as mosquitto, messages(mosquitto) as (found, said, wake):
        mosquitto.stop()
        found.update(reading(cell("A")))
        wait_until(lambda: said)
        found.update(reading(cell("B")))
        mosquitto.start()
        wait_until(lambda: len(said) == 2)
        wait_until(lambda: cells_at(mosquitto) == {"B"})
        mosquitto.stop()
        wait_until(lambda: len(said) == 3)
        found.update(replace(reading(cell("C")), store_up=False))
        mosquitto.start()
        wait_until(lambda: len(said) == 4)
        wait_until(lambda: cells_at(mosquitto) == {"C"})
        assert not wake.is_set()
    where = f"The MQTT broker 127.0.0.1:{mosquitto.port}"
    assert said[0] == f"{where} does not answer (Connection refused). ftdrive tries to reconnect."
    assert said[1] == said[3] == f"{where} answers again."
    assert said[2].startswith(f"{where} does not answer (")


@pytest.mark.parametrize("user", ["cell:wrong-secret@", "other:right-secret@", ""])
def test_a_wrong_password_is_one_sentence(user: str, tmp_path: Path) -> None:
    with (
        Mosquitto(tmp_path, user="cell", password="right-secret") as mosquitto,
        messages(mosquitto, user) as (found, said, wake),
    ):
        found.update(reading(cell("A")))
        assert wake.wait(60)
        with pytest.raises(ConfigError, match=r"rejects the connection \(.+\): check user and password") as error:
            found.update(reading(cell("A")))
    assert "secret" not in str(error.value)
    assert not said


def test_a_right_password_is_accepted_and_a_later_rejection_is_an_outage(tmp_path: Path) -> None:
    with (
        Mosquitto(tmp_path, user="cell", password="right secret/@") as mosquitto,
        messages(mosquitto, "cell:right%20secret%2F%40@") as (found, said, wake),
    ):
        found.update(reading(cell("A")))
        wait_until(lambda: cells_at(mosquitto) == {"A"})
        mosquitto.stop()
        wait_until(lambda: said)
        (tmp_path / "passwords").write_text("")
        mosquitto.start()
        found.update(reading(cell("A")))
        assert not wake.wait(2.5)
        found.update(reading(cell("A")))
    assert len(said) == 1
    assert "secret" not in said.text


def test_the_last_will_says_that_the_server_is_gone(tmp_path: Path) -> None:
    with Mosquitto(tmp_path) as mosquitto, messages(mosquitto) as (found, _, _):
        found.update(reading(cell("A")))
        wait_until(lambda: cells_at(mosquitto) == {"A"})
        found._client._reconnect_on_failure = False
        found._client.socket().shutdown(2)  # type: ignore[union-attr]
        wait_until(lambda: not server_at(mosquitto)["online"])
        assert cells_at(mosquitto) == {"A"}


@pytest.mark.filterwarnings("ignore:unclosed <ssl:ResourceWarning")  # paho leaves it to the garbage collector
def test_a_certificate_must_be_one_that_the_computer_trusts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("openssl is not installed")
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    command = f"req -x509 -nodes -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -keyout {key} -out {certificate}"
    about = ["-subj", "/CN=broker", "-addext", "subjectAltName=IP:127.0.0.1"]
    subprocess.run([openssl, *command.split(), *about], check=True, capture_output=True)
    with Mosquitto(tmp_path, lines=(f"certfile {certificate}", f"keyfile {key}")) as mosquitto:
        with messages(mosquitto, scheme="mqtts") as (found, said, _):
            found.update(reading(cell("A")))
            wait_until(lambda: said)
            assert "CERTIFICATE_VERIFY_FAILED" in said.text
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        with messages(mosquitto, scheme="mqtts") as (found, said, _):
            found.update(reading(cell("A")))
            wait_until(lambda: found._answers)
            assert not said
        open_sockets = [one for one in vars(found._client).values() if isinstance(one, socket) and one.fileno() >= 0]
        assert not open_sockets
    gc.collect()
