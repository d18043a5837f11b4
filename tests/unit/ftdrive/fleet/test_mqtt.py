"""Addresses of MQTT brokers."""

import pytest

from ftdrive.errors import ConfigError
from ftdrive.fleet.mqtt import Broker


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
