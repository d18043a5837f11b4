"""Payload and gravity of the emulated controller, through the unmodified ur_rtde."""

from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.control import ControlPath
from tests.wire.conftest import Station

COM_M = (0.0095, 0.0048, 0.0809)
INERTIA = (0.01, 0.02, 0.03, 0.0, -0.001, 0.0)
SETTINGS_CALLS = ("setPayload", "setTargetPayload", "setGravity")


def taken(station: Station, since: int = 0) -> list[str]:
    events = station.ask("state", since=since)["events"]
    return [event["why"] for event in events if event["why"] in SETTINGS_CALLS]


def test_a_payload_is_kept_when_our_program_has_ended(station: Station, arm: UrArm, control: ControlPath) -> None:
    before = len(station.ask("state")["events"])
    arm.set_payload(1.442, COM_M, INERTIA)
    arm.set_gravity((0.0, 0.3, 9.81))
    arm.close()
    arm.open()
    found = arm.controller_settings()
    assert (found.mass_kg, found.p_flange_com_m, found.inertia_kg_m2) == (1.442, COM_M, INERTIA)
    assert found.up_base_m_s2 in {None, (0.0, 0.3, 9.81)}  # only recent controllers report it
    assert station.ask("state")["payload_kg"] == 1.442
    if control == "ur-rtde":  # the functions of an interpreted program are no events
        assert taken(station, before) == ["setTargetPayload", "setGravity"]
    assert (arm.status().payload_kg, arm.status().program) == (1.442, "stopped")
