"""Options of the tests on hardware: without `--device` none of them runs."""

from collections.abc import Iterator
from typing import Any

import pytest

from ftdrivers.interfaces import ForceTorqueSensor
from ftdrivers.registry import sensor_from_url


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("device", "tests on hardware")
    group.addoption("--device", metavar="URL", help="address of a real sensor, such as ati-can://can0")
    group.addoption("--serial", metavar="N", help="its serial number; any other device ends the run")
    group.addoption("--arm", metavar="HOST", help="address of the arm that carries the sensor")
    group.addoption("--move", action="store_true", help="move the arm by a few degrees, after a typed confirmation")


def option(config: pytest.Config, name: str) -> Any:
    """Return an option, None also where this folder is not what pytest was asked to run."""
    return config.getoption(name, default=None)


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    if option(config, "--device"):
        if not option(config, "--serial"):
            raise pytest.UsageError("--device needs --serial: the number on the label of the sensor")
        config.option.numprocesses = 0  # one process has the device
        config.option.dist = "no"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not option(config, "--device"):
        for item in items:
            if "device" in item.path.parts:
                item.add_marker(pytest.mark.skip(reason="needs a real sensor: --device URL --serial N"))


@pytest.fixture(scope="session")
def url(request: pytest.FixtureRequest) -> str:
    return str(option(request.config, "--device"))


@pytest.fixture(scope="session")
def sensor(request: pytest.FixtureRequest, url: str) -> Iterator[ForceTorqueSensor]:
    """The device, streaming."""
    wanted = option(request.config, "--serial")
    with sensor_from_url(url) as sensor:
        if (found := sensor.identify().serial) != wanted:
            pytest.exit(f"{url} is the sensor with serial number {found}, not {wanted}: check --device", returncode=3)
        yield sensor
