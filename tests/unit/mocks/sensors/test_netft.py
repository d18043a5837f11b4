"""The Net F/T emulator without a wire: records and pages."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from ftmocks.sensors.ati_gauges import REFERENCE
from ftmocks.sensors.netft import Command, NetFtBox, rdt_records, transform_matrix

WRENCH = [1.5, -2.25, 10, 0.1, -0.05, 0.025]
VECTOR = "00000001 000003E8 00000000 0016E360 FFDDAAF0 00989680 000186A0 FFFF3CB0 000061A8"


def test_documented_record() -> None:
    counts = np.array([WRENCH]) * 1e6
    assert rdt_records(1, np.array([1000]), np.array([0]), counts) == bytes.fromhex(VECTOR)


def test_sequence_numbers_wrap_and_counts_are_clipped() -> None:
    data = rdt_records(2**32 - 1, np.array([2**32, 5]), np.array([0x80010000, 0]), np.array([[9e9] * 6, [-9e9] * 6]))
    assert data.hex(" ", 36).split() == [
        "ffffffff" + "00000000" + "80010000" + 6 * "7fffffff",
        "00000000" + "00000005" + "00000000" + 6 * "80000000",
    ]


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


def test_configuration_page(box: NetFtBox) -> None:
    box.status = 0x80010000
    configuration = page(box, "/netftapi2.xml")
    expected = {
        "prodname": "Net F/T",
        "cfgcpf": "1000000",
        "cfgcpt": "1000000",
        "scfgfu": "N",
        "scfgtu": "Nm",
        "cfgfu": "2",
        "cfgtu": "3",
        "cfgcalsel": "0",
        "cfgcalsn": "FT12345",
        "comrdte": "Enabled",
        "comrdtrate": "7000",
        "comrdtbsiz": "5",
        "runstat": "0x80010000",
    }
    assert expected.items() <= configuration.items()


@pytest.mark.parametrize(
    ("transform", "wrench"),
    [
        ((0, 0, 0, 0, 0, 0), [1, 2, 3, 0.1, 0.2, 0.3]),
        ((0, 0, 100, 0, 0, 0), [1, 2, 3, 0.1 + 0.2, 0.2 - 0.1, 0.3]),
        ((10, 0, 0, 0, 0, 0), [1, 2, 3, 0.1, 0.2 + 0.03, 0.3 - 0.02]),
        ((0, 0, 0, 90, 0, 0), [1, 3, -2, 0.1, 0.3, -0.2]),
        ((0, 0, 0, 0, 90, 0), [-3, 2, 1, -0.3, 0.2, 0.1]),
        ((0, 0, 0, 0, 0, 90), [2, -1, 3, 0.2, -0.1, 0.3]),
        ((0, 0, 0, 90, 90, 0), [2, 3, 1, 0.2, 0.3, 0.1]),
        ((0, 0, 100, 90, 0, 0), [1, 3, -2, 0.1 + 0.2, 0.3, -0.2 + 0.1]),
    ],
)
def test_tool_transformation_as_in_the_library_of_ati(transform: tuple[float, ...], wrench: list[float]) -> None:
    box = NetFtBox(lambda n: np.tile([1, 2, 3, 0.1, 0.2, 0.3], (n, 1)), tool_transform=transform)
    box.power_up()
    assert sent(box) == pytest.approx(wrench)


def test_tool_transformation_in_inches_and_radians() -> None:
    box = NetFtBox(lambda n: np.tile(WRENCH, (n, 1)), distance_unit=1, angle_unit=2)
    box.tool_transform = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    box.power_up()
    expected = transform_matrix(np.array([0.0254, 0.0508, 0.0762]), np.array([0.1, 0.2, 0.3])) @ WRENCH
    assert sent(box) == pytest.approx(expected.tolist())
    assert page(box, "/netftapi2.xml")["cfgtfx"] == "1.000;2.000;3.000;0.100;0.200;0.300"
    assert page(box, "/netftapi2.xml")["scfgtdu"] == "in"
    assert page(box, "/netftapi2.xml")["scfgtau"] == "radians"


def test_the_bias_is_in_gauge_counts_before_the_transformation() -> None:
    bias = [100, -200, 300, -400, 500, -600]
    box = NetFtBox(lambda n: np.tile(WRENCH, (n, 1)), bias=bias, gauge_offset=0, tool_transform=(0, 0, 100, 0, 0, 0))
    box.power_up()
    fx, fy, fz, tx, ty, tz = np.array(WRENCH) - [-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608]
    assert sent(box) == pytest.approx([fx, fy, fz, tx + 0.1 * fy, ty - 0.1 * fx, tz])
    np.testing.assert_allclose(REFERENCE.matrix @ bias / 1e6, [-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608])


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
        "/comm.cgi?what=1",
        "/config.cgi?cfgcalsel=1",
        "/config.cgi?cfgid=1&cfgtfx0=1",
        "/config.cgi?cfgtfx0=nan",
        "/config.cgi?cfgtdu=6",
        "/setting.cgi?setbias0=40000",
        "/setting.cgi?setbias0=1.5",
    ],
)
def test_pages_that_are_not_there(box: NetFtBox, path: str) -> None:
    assert box.page(path) is None


def test_saturation_clips_at_the_rating_of_the_transducer(box: NetFtBox) -> None:
    box.measure = lambda n: np.tile([0, 0, -500.0, 0, 0, 0], (n, 1))
    measured, saturated = box.measured(1)
    assert measured[0, 2] == -400
    assert saturated.all()
    box.measure = lambda n: np.tile(WRENCH, (n, 1))
    box.saturated_axis = 3
    measured, saturated = box.measured(1)
    assert measured[0, 3] == 10
    assert saturated.all()
