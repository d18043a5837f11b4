"""What a push would change, as it is printed before the word is typed."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from syrupy.assertion import SnapshotAssertion

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


class FakeLean:
    def __init__(self, *, is_significant: bool = True) -> None:
        self.is_significant = is_significant

    def __str__(self) -> str:
        return "leans by 1.8°"


REASON = {**PUSH.reason, "payload_at_calibration_kg": 0.7}
UNKNOWN = replace(OLD, up_base_m_s2=None)
INERTIA = replace(NEW, inertia_kg_m2=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0))
RESTORED = Push(UNKNOWN, ControllerSettings(up_base_m_s2=(0.5, 0.0, 9.8)), PUSH.devices, {"restores": "push.json"})


def leaning(*up: float, significant: bool = True, sent: bool = True) -> Push:
    known = up or None
    lean: Any = FakeLean(is_significant=significant)
    new = replace(NEW, up_base_m_s2=known) if sent else NEW
    return replace(PUSH, old=replace(OLD, up_base_m_s2=known), new=new, lean=lean)


PUSHES = {
    "payload": PUSH,
    "contact": replace(PUSH, contact=np.array([3.0, 0.0, -4.0, 0.03, 0.04, 0.0]), reason=REASON),
    "inertia": replace(PUSH, new=INERTIA),
    "restored": RESTORED,
    "leans": leaning(0.0, 0.0, 9.82, sent=False),
    "leans-sent": leaning(0.0, 0.008, 9.82),
    "leans-sent-inverted": leaning(0.0, 0.0, -9.82),
    "leans-not-reported": leaning(),
}


@pytest.mark.parametrize("name", PUSHES)
def test_what_a_push_would_change(name: str, snapshot: SnapshotAssertion) -> None:
    assert "\n".join(proposal_in_lines(PUSHES[name])) == snapshot


def test_what_a_controller_reports_is_one_line() -> None:
    assert settings_in_words(OLD) == "0.600 kg at (0.0, 0.0, 30.0) mm, gravity (0.000, 0.000, 9.820) m/s²"
    assert settings_in_words(replace(OLD, up_base_m_s2=None)) == "0.600 kg at (0.0, 0.0, 30.0) mm"
    for nothing in (None, ControllerSettings()):
        assert settings_in_words(nothing) == "the controller does not report its payload: compare it on the pendant"
