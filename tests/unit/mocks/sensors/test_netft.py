"""The Net F/T emulator without a wire: records and pages."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from ftmocks.sensors.netft import Calibration, NetFtBox, rdt_records

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
    return NetFtBox(lambda n: np.tile(WRENCH, (n, 1)))


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


def test_calibration_page(box: NetFtBox) -> None:
    calibration = page(box, "/netftcalapi.xml?index=0")
    assert calibration["calsn"] == "FT12345"
    assert calibration["calmr"] == "130;130;400;10;10;10"
    assert (calibration["calcpf"], calibration["calfu"], calibration["caltu"]) == ("1000000", "2", "3")


def test_rate_is_set_over_http(box: NetFtBox) -> None:
    assert box.page("/comm.cgi?comrdtrate=500&comrdtbsiz=50") is not None
    assert (box.rate_hz, box.buffer_size) == (500, 40)
    assert page(box, "/netftapi2.xml")["comrdtrate"] == "500"
    assert box.page("/comm.cgi?comrdtrate=9000") is not None
    assert box.rate_hz == 7000


@pytest.mark.parametrize("path", ["/", "/comm.cgi?comrdtrate=fast", "/comm.cgi?what=1", "/config.cgi?cfgcalsel=1"])
def test_pages_that_are_not_there(box: NetFtBox, path: str) -> None:
    assert box.page(path) is None


def test_counts_in_the_units_of_the_configuration(box: NetFtBox) -> None:
    box.calibration = Calibration(counts_per_force=1000, counts_per_torque=100, force_unit=1, torque_unit=1)
    assert page(box, "/netftapi2.xml")["scfgfu"] == "lbf"
    box.measure = lambda n: np.tile([4.4482216152605, 0, 0, 0.1129848290276167, 0, 0], (n, 1))
    counts, saturated = box._counts(2)
    np.testing.assert_allclose(counts, [[1000, 0, 0, 100, 0, 0]] * 2)
    assert not saturated.any()


def test_saturation_clips_at_the_rating(box: NetFtBox) -> None:
    box.measure = lambda n: np.tile([0, 0, -500.0, 0, 0, 0], (n, 1))
    counts, saturated = box._counts(1)
    assert counts[0, 2] == -400e6
    assert saturated.all()
    box.measure = lambda n: np.tile(WRENCH, (n, 1))
    box.saturated_axis = 3
    counts, saturated = box._counts(1)
    assert counts[0, 3] == 10e6
    assert saturated.all()
