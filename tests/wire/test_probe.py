"""Which sensor is on a port: found by its stream or by its answer, with nothing but requests to read."""

from typing import Any

import numpy as np
import pytest

from ftdrivers.errors import ConnectError
from ftdrivers.probe import probe_serial
from ftmocks.sensors.ati_serial import AtiSerialBox
from ftmocks.sensors.bota import BotaBox
from ftmocks.sensors.robotiq import RobotiqBox
from ftmocks.sensors.robotous import RobotousSerialBox

pytestmark = pytest.mark.slow  # every test needs a process of its own


def measure(n: int) -> Any:
    return np.random.default_rng(n).normal(size=(n, 6)) + 3


@pytest.mark.parametrize(
    ("kind", "options", "scheme", "what"),
    [
        (AtiSerialBox, {}, "ati-serial", "serial FT"),
        (RobotiqBox, {"streaming_at_start": True}, "robotiq-ft300", "streams"),
        (RobotousSerialBox, {}, "robotous-serial", "Robotous RFT"),
        (BotaBox, {"streaming_at_start": True, "baud_code": 3}, "bota", "streams"),
    ],
)
def test_a_sensor_shows_itself(kind: Any, options: dict[str, Any], scheme: str, what: str, cell_time: Any) -> None:
    device = kind(measure, seed=1, clock=cell_time.of_devices, **options)
    try:
        port = device.start()
        answer = probe_serial(port, cell_time.of_drivers)
    finally:
        device.stop()
    assert answer is not None
    assert answer.url is not None
    assert answer.url.partition("?")[0] == f"{scheme}://{port}"
    assert what in answer.what


def test_a_port_that_is_not_there() -> None:
    with pytest.raises(ConnectError, match="does not open"):
        probe_serial("/dev/no-such-port")
