"""Which sensor is on a port: found by its stream or by its answer, with nothing but requests to read."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftdrivers.errors import ConnectError
from ftdrivers.probe import probe_serial
from ftdrivers.registry import sensor_from_url
from ftmocks.sensors.ati_can import AtiCanNode
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
        (AtiSerialBox, {"streaming_at_start": True}, "ati-serial", "streams"),
        (RobotiqBox, {}, "robotiq-ft300", "serial FTS-1234"),
        (RobotiqBox, {"streaming_at_start": True}, "robotiq-ft300", "streams"),
        (RobotousSerialBox, {}, "robotous-serial", "Robotous RFT"),
        (RobotousSerialBox, {"streaming_at_start": True}, "robotous-serial", "streams"),
        (BotaBox, {"boot_s": 0.5}, "bota", "boots"),
        (BotaBox, {"streaming_at_start": True}, "bota", "streams"),
        (BotaBox, {"streaming_at_start": True, "baud_code": 3}, "bota", "streams"),
        (AtiCanNode, {}, None, None),  # behind an slcan adapter: not a question for a serial port
    ],
)
def test_a_sensor_shows_itself(
    kind: Any, options: dict[str, Any], scheme: str | None, what: str | None, cell_time: Any
) -> None:
    device = kind(measure, seed=1, clock=cell_time.of_devices, **options)
    try:
        port = device.start()
        answer = probe_serial(port, cell_time.of_drivers)
    finally:
        device.stop()
    if scheme is None or what is None:
        assert answer is None
    else:
        assert answer is not None
        assert answer.url is not None
        assert answer.url.partition("?")[0] == f"{scheme}://{port}"
        assert what in answer.what


def test_the_address_of_a_port_with_a_strange_name_works(tmp_path: Path, cell_time: Any) -> None:
    port, rng = tmp_path / "my port #1?50%20", np.random.default_rng(1)
    box = BotaBox(lambda n: rng.normal(size=(n, 6)), seed=1, clock=cell_time.of_devices, boot_s=0.5)
    try:
        port.symlink_to(box.start())
        answer = probe_serial(str(port), cell_time.of_drivers)
        assert answer is not None
        assert answer.url is not None
        with sensor_from_url(answer.url, clock=cell_time.of_drivers) as sensor:
            assert len(sensor.collect(0.2).seq)
    finally:
        box.stop()


def test_a_port_that_is_not_there() -> None:
    with pytest.raises(ConnectError, match="does not open"):
        probe_serial("/dev/no-such-port")
