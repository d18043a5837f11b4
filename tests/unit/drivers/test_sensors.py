"""Every sensor has what docs/how-to/add-a-sensor.md asks for; what is missing is named."""

import re
from collections.abc import Iterator
from fnmatch import fnmatch
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from ftdrivers.sensors import SENSORS, SensorKind
from ftmocks.sensors.catalogue import KINDS, WRIST
from tests.wire.sensor_kinds import KINDS as ROWS

ROOT = Path(__file__).parents[3]
SCHEMES = {WRIST: WRIST} | {name: kind.scheme for name, kind in KINDS.items()}


def missing(scheme: str, kind: SensorKind) -> Iterator[str]:
    """Name what a sensor lacks, with the file that has to have it."""
    module, _, name = kind.driver.partition(":")
    if find_spec(module.rpartition(".")[0]) is None or find_spec(module) is None:
        yield f"{module}: the module of the driver"
    else:
        driver = import_module(module)
        if not hasattr(getattr(driver, name, None), "from_url"):
            yield f"{module}: the class {name} with from_url"
        if kind.wire == "serial" and not hasattr(driver, "SERIAL_PROBES"):
            yield f"{module}: SERIAL_PROBES, by which `devices --probe` finds the sensor"
        if kind.wire == "can" and not hasattr(getattr(driver, name, None), "probe"):
            yield f"{module}: the class {name} with probe, by which `devices --probe` finds the sensor"
    tests = f"tests/unit/drivers/{module.split('.')[1]}"
    if not list((ROOT / tests).glob("test_*.py")):
        yield f"{tests}: a test of the codec with the bytes that the vendor's document prints"
    if not kind.emulated and kind.wire != "topic":
        yield "drivers/ftdrivers/sensors.py: the names of its emulators"
    for emulator in kind.emulated:
        if SCHEMES.get(emulator) != scheme:
            yield f"mocks/ftmocks/sensors: the emulator {emulator}, in KINDS of its module"
    if scheme not in {row.scheme for row in ROWS.values()} and kind.wire != "topic":
        yield "tests/wire/sensor_kinds.py: a row, which runs the tests of every driver"
    page = (ROOT / "docs/reference/sensors.md").read_text(encoding="utf-8")
    if f"| `{scheme}:" not in page:
        yield "docs/reference/sensors.md: a row with its address"
    if not any(fnmatch(scheme, row) for row in re.findall(r"^\| `([\w*-]+)` \|", page, re.MULTILINE)):
        yield "docs/reference/sensors.md: a row with what it reports about itself"


@pytest.mark.parametrize("scheme", SENSORS)
def test_a_sensor_has_all_that_it_needs(scheme: str) -> None:
    assert not (lines := list(missing(scheme, SENSORS[scheme]))), "\n".join(lines)


def test_every_emulated_sensor_has_a_driver() -> None:
    assert {name: scheme for scheme, kind in SENSORS.items() for name in kind.emulated} == SCHEMES
