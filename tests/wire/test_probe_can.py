"""Which sensors are on a CAN bus: found by what is heard or by their answer, with nothing but requests to read."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from ftdrivers import probe as module
from ftdrivers.errors import ConnectError, PortInUse
from ftdrivers.probe import probe_can
from ftdrivers.registry import sensor_from_url
from ftmocks.sensors.ati_can import AtiCanNode
from ftmocks.sensors.robotous import RobotousCanNode

pytestmark = pytest.mark.slow  # every test needs a process of its own


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """All that these tests send comes many times in this time."""
    monkeypatch.setattr(module, "_LISTEN_BUS_S", 0.4)


@pytest.fixture
def start(cell_time: Any) -> Iterator[Callable[..., str]]:
    devices = []
    rng = np.random.default_rng(0)

    def measure(n: int) -> Any:
        return rng.normal(size=(n, 6)) + 3

    def run(kind: Any, **options: Any) -> str:
        devices.append(kind(measure, seed=1, clock=cell_time.of_devices, **options))
        return str(devices[-1].start())

    yield run
    for device in devices:
        device.stop()


@pytest.mark.parametrize(
    ("kind", "options", "bitrate", "base", "url", "what"),
    [
        (
            AtiCanNode,
            {"base": 0x7F, "bitrate": 500_000},
            500_000,
            0x7F,
            "ati-can://{}?interface=slcan&bitrate=500000&base=0x7F",
            "ATI NETCANOEM, serial FT12345, firmware 3.8 build 2",
        ),
        (RobotousCanNode, {}, 1_000_000, 0x20, "robotous-can://{}?interface=slcan", "Robotous RFT60-HA01"),
        (
            RobotousCanNode,
            {"streaming_at_start": True},
            1_000_000,
            0x20,
            "robotous-can://{}?interface=slcan",
            "it streams",
        ),
    ],
)
def test_a_sensor_shows_itself_and_its_address_works(
    start: Callable[..., str],
    cell_time: Any,
    kind: Any,
    options: dict[str, Any],
    bitrate: int,
    base: int,
    url: str,
    what: str,
) -> None:
    port = start(kind, **options)
    (answer,) = probe_can(port, interface="slcan", clock=cell_time.of_drivers, bitrate=bitrate, base=base)
    assert (answer.url, answer.what) == (url.format(port), what)
    assert answer.url is not None
    with sensor_from_url(answer.url, clock=cell_time.of_drivers) as sensor:
        assert len(sensor.collect(0.2).seq)


def test_the_address_of_an_adapter_with_a_strange_name_works(
    start: Callable[..., str], cell_time: Any, tmp_path: Path
) -> None:
    port = tmp_path / "my adapter #1?50%20"
    port.symlink_to(start(AtiCanNode))
    (answer,) = probe_can(str(port), interface="slcan", clock=cell_time.of_drivers, bitrate=250_000)
    assert answer.url is not None
    with sensor_from_url(answer.url, clock=cell_time.of_drivers) as sensor:
        assert len(sensor.collect(0.2).seq)


def test_a_bus_that_does_not_open() -> None:
    with pytest.raises(ConnectError, match="no-such-port does not exist"):
        probe_can("/dev/no-such-port", interface="slcan", bitrate=250_000)
    with pytest.raises(ConnectError, match=r"link set no-such-can up .*250000"):
        probe_can("no-such-can", interface="socketcan", bitrate=None)


def test_an_adapter_that_another_program_reads_is_left_alone(start: Callable[..., str], cell_time: Any) -> None:
    port = start(AtiCanNode)
    with sensor_from_url(f"ati-can://{port}?interface=slcan", clock=cell_time.of_drivers) as sensor:
        with pytest.raises(PortInUse, match=f"in use by another program; end it, `fuser -v {port}` names it"):
            probe_can(port, interface="slcan", clock=cell_time.of_drivers, bitrate=250_000)
        with pytest.raises(serial.SerialException):
            serial.Serial(port, exclusive=True)
        assert len(sensor.collect(0.2))
        assert sensor.health().stale == sensor.health().lost == 0
    with serial.Serial(port, exclusive=True, timeout=30) as line:
        line.write(b"V\r")
        assert line.read_until(b"V1013\r").endswith(b"V1013\r")  # behind all that the driver was still sent
        with pytest.raises(PortInUse):
            probe_can(port, interface="slcan", clock=cell_time.of_drivers, bitrate=250_000)
    (answer,) = probe_can(port, interface="slcan", clock=cell_time.of_drivers, bitrate=250_000)
    assert answer.url
