"""The Net F/T emulator without a wire: records and pages."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from ftmocks.sensors.netft import Command, NetFtBox, rdt_records

WRENCH = [1.5, -2.25, 10, 0.1, -0.05, 0.025]
VECTOR = "00000001 000003E8 00000000 0016E360 FFDDAAF0 00989680 000186A0 FFFF3CB0 000061A8"


def test_documented_record() -> None:
    counts = np.array([WRENCH]) * 1e6
    assert rdt_records(1, np.array([1000]), np.array([0]), counts) == bytes.fromhex(VECTOR)


@pytest.fixture
def box() -> NetFtBox:
    box = NetFtBox(lambda n: np.tile(WRENCH, (n, 1)))
    box.power_up()
    return box


def sent(box: NetFtBox) -> list[float]:
    return [float(value) for value in (box.counts(box.measured(1)[0])[0] / 1e6).round(9)]


def page(box: NetFtBox, path: str) -> dict[str, str]:
    content = box.page(path)
    assert content is not None
    return {element.tag: element.text or "" for element in ET.fromstring(content)}


@pytest.mark.parametrize(
    ("transform", "wrench"),
    [
        ((0, 0, 0, 0, 0, 0), [1, 2, 3, 0.1, 0.2, 0.3]),
        ((0, 0, 100, 0, 0, 0), [1, 2, 3, 0.1 + 0.2, 0.2 - 0.1, 0.3]),
        ((0, 0, 0, 90, 0, 0), [1, 3, -2, 0.1, 0.3, -0.2]),
        ((0, 0, 0, 90, 90, 0), [2, 3, 1, 0.2, 0.3, 0.1]),
        ((0, 0, 100, 90, 0, 0), [1, 3, -2, 0.1 + 0.2, 0.3, -0.2 + 0.1]),
    ],
)
def test_tool_transformation_as_in_the_library_of_ati(transform: tuple[float, ...], wrench: list[float]) -> None:
    box = NetFtBox(lambda n: np.tile([1, 2, 3, 0.1, 0.2, 0.3], (n, 1)), tool_transform=transform)
    box.power_up()
    assert sent(box) == pytest.approx(wrench)


def test_bias_command_and_settings_page(box: NetFtBox) -> None:
    before = sent(box)
    box.request(Command.BIAS, 0, ("127.0.0.1", 9))
    assert sent(box) == [0.0] * 6
    assert page(box, "/netftapi2.xml")["setbias"] != "745;17;447;184;-596;-253"
    box.power_up()
    assert sent(box) == before
    assert box.page("/setting.cgi?" + "&".join(f"setbias{i}=0" for i in range(6))) is not None
    assert page(box, "/netftapi2.xml")["setbias"] == "0;0;0;0;0;0"
    cleared = sent(box)
    assert cleared != before, "the gauges have an offset of their own"
    box.power_up()
    assert sent(box) == cleared


@pytest.mark.parametrize(
    "path",
    [
        "/",
        "/comm.cgi?comrdtrate=fast",
        "/config.cgi?cfgid=1&cfgtfx0=1",
        "/config.cgi?cfgtfx0=nan",
        "/setting.cgi?setbias0=40000",
    ],
)
def test_pages_that_are_not_there(box: NetFtBox, path: str) -> None:
    assert box.page(path) is None
