"""What a push would change, as it is printed before the word is typed."""

from dataclasses import replace

import numpy as np
import pytest

from ftdrive.checks.arm import FlangeLoad
from ftdrive.session.settings_push import Push
from ftdrive.words.session import proposal_in_lines, settings_in_words
from ftdrivers.interfaces import ControllerSettings, DeviceInfo

OLD = ControllerSettings(0.6, (0.0, 0.0, 0.03), (0.0,) * 6, (0.0, 0.0, 9.82))
NEW = ControllerSettings(1.442, (0.0095, 0.0048, 0.0809), (0.0,) * 6)
LOAD = FlangeLoad(1.442, np.array([0.0095, 0.0048, 0.0809]), 0.0011, np.array([2e-4, 3e-4, 4e-4]))
PUSH = Push(
    OLD,
    NEW,
    {"arm": DeviceInfo("UR5e", "1", "5.15")},
    {"sensor_mass_kg": 0.25, "sensor_height_mm": 33.0, "payload_at_calibration_kg": 0.6005},
    load=LOAD,
)


def test_old_and_new_values_stand_beside_one_another() -> None:
    assert proposal_in_lines(PUSH) == [
        "            controller        new               change",
        "mass, kg    0.600             1.442             +0.842",
        "centre, mm  (0.0, 0.0, 30.0)  (9.5, 4.8, 80.9)  (+9.5, +4.8, +50.9)",
        "The centre is in flange axes. One sigma is 0.0011 kg and 0.20, 0.30, 0.40 mm. The inertia stays that of a "
        "point mass: gravity does not reveal it.",
        "The load is 3.56 kg below the rated payload of a UR5e, 5 kg; also compare with the payload curve in its "
        "user manual.",
        "Included are sensor and adapter, 0.25 kg; their centre is taken half way up the sensor's height of 33 mm.",
    ]


def test_what_speaks_against_the_change_is_printed() -> None:
    contact = np.array([3.0, 0.0, -4.0, 0.03, 0.04, 0.0])
    reason = {**PUSH.reason, "payload_at_calibration_kg": 0.7}
    lines = proposal_in_lines(replace(PUSH, contact=contact, reason=reason))
    assert lines[-2] == "At the calibration, the payload in the controller was 0.700 kg."
    assert lines[-1].startswith("The reading differs from a free tool by 5.0 N, 0.05 N·m. ")
    inertia = replace(NEW, inertia_kg_m2=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0))
    assert "The inertia is kept:" in proposal_in_lines(replace(PUSH, new=inertia))[3]


def test_a_restored_gravity_has_the_table_and_its_source() -> None:
    unknown = replace(OLD, up_base_m_s2=None)
    push = Push(unknown, ControllerSettings(up_base_m_s2=(0.5, 0.0, 9.8)), PUSH.devices, {"restores": "push.json"})
    assert proposal_in_lines(push) == [
        "               controller    new                    change",
        "gravity, m/s²  not reported  (0.500, 0.000, 9.800)",
        "The new values restore those before push.json.",
    ]


class FakeLean:
    def __init__(self, *, is_significant: bool = True) -> None:
        self.is_significant = is_significant

    def __str__(self) -> str:
        return "leans by 1.8°"


@pytest.mark.parametrize(
    ("up", "significant", "sent", "words"),
    [
        ((0.0, 0.0, 9.82), True, False, "the controller is set to level; --gravity sends it."),
        ((0.0, 0.0, 9.82), False, False, "the controller is set to level."),
        ((0.0, 0.008, 9.82), True, True, "the controller is set to level."),
        ((0.0, 0.0095, 9.82), True, True, "the controller is set to (0.000, 0.009, 9.820) m/s²."),
        ((0.0, 0.0, -9.82), True, True, "the controller is set to (0.000, 0.000, -9.820) m/s²."),
    ],
)
def test_a_base_that_leans_is_compared_with_the_controller(
    up: tuple[float, ...], significant: bool, sent: bool, words: str
) -> None:
    new = replace(NEW, up_base_m_s2=up) if sent else NEW
    lean = FakeLean(is_significant=significant)
    push = replace(PUSH, old=replace(OLD, up_base_m_s2=up), new=new, lean=lean)  # type: ignore[arg-type]
    assert proposal_in_lines(push)[-1] == f"The base leans by 1.8°; {words}"
    unknown = replace(push, old=replace(OLD, up_base_m_s2=None))
    assert proposal_in_lines(unknown)[-1].endswith("the controller does not report its gravity.")


def test_what_a_controller_reports_is_one_line() -> None:
    assert settings_in_words(OLD) == "0.600 kg at (0.0, 0.0, 30.0) mm, gravity (0.000, 0.000, 9.820) m/s²"
    assert settings_in_words(replace(OLD, up_base_m_s2=None)) == "0.600 kg at (0.0, 0.0, 30.0) mm"
    for nothing in (None, ControllerSettings()):
        assert settings_in_words(nothing) == "the controller does not report its payload: compare it at the pendant"
