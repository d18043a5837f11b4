"""The findings of doctor in made-up states of a sensor and an arm, and their fixes."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult
from ftcalib.poses.information import Guess
from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig
from ftdrive.checks import arm as of_arm
from ftdrive.checks import sensor as of_sensor
from ftdrive.checks.check import Check, check_calibration, compare_devices
from ftdrive.checks.computer import SensorAddress
from ftdrivers.errors import (
    ConnectError,
    DeviceError,
    DeviceFault,
    DeviceTimeout,
    NoDashboard,
    ProtocolError,
    StreamBroken,
)
from ftdrivers.interfaces import NOT_REPORTED, ArmStatus, DeviceInfo, Fact, FtSamples, Health
from ftdrivers.ur.kinematics import MODELS
from tests.own_kinematics import drawn
from tests.unit.ftdrive.fake_cell import STATUS as PLAYING
from tests.unit.ftdrive.fake_cell import Lab

FACTS = {
    "serial": Fact("FT1", "device"),
    "counts_per_N": Fact(1e6, "device"),
    "counts_per_Nm": Fact(1e6, "device"),
    "range": Fact((130.0, 130.0, 400.0, 10.0, 10.0, 10.5), "configured"),
    "sign": Fact(-1, "configured"),
}


def test_what_the_sensor_itself_changes_is_reported() -> None:
    facts = FACTS | {
        "software_bias": Fact((745.0, 0.0, 0.0, 0.0, 0.0, -253.0), "device"),
        "tool_transformation": Fact("0;0;132.71;0;0;0 (mm, degrees)", "device"),
    }
    found = {check.name: check for check in of_sensor.check_identity(DeviceInfo("Net F/T", "FT1", "1", facts))}
    assert "(745, 0, 0, 0, 0, -253)" in found["sensor.bias"].found
    assert "undoes" in found["sensor.origin"].found
    assert "132.71" in found["sensor.origin"].found


def test_what_is_assumed_or_unknown_of_a_sensor_is_a_warning() -> None:
    facts = {name: Fact(1e6, "assumed") for name in ("counts_per_N", "counts_per_Nm")}
    info = DeviceInfo("Mini45", NOT_REPORTED, "3.6", facts)
    found = {check.name: check for check in of_sensor.check_identity(info)}
    warned = {name for name, check in found.items() if check.state == "warning"}
    assert warned == {"sensor.identity", "sensor.counts", "sensor.range"}
    assert "serial=" in str(found["sensor.identity"].fix)
    assert "range=300,30" in str(found["sensor.range"].fix)
    assert {check.state for check in of_sensor.check_identity(DeviceInfo("plain", "1", "2"))} == {"ok", "warning"}
    for known in ("counts_per_N", "counts_per_Nm"):
        half = of_sensor.check_identity(DeviceInfo("Nano", "FT1", "1", {known: Fact(1e6, "device")}))
        assert [check.found for check in half if check.name == "sensor.counts"] == [
            "the driver does not report its scale"
        ]


TOOL = ToolConfig(cylinders_mm=((0.0, 200.0, 100.0),))
STATUS = replace(PLAYING, program="stopped", speed_slider=0.5, payload_kg=1.2, p_flange_payload_m=(0.0, 0.01, 0.05))


def arm_checks(status: ArmStatus, tool: ToolConfig = TOOL, sensor_kg: float | None = None) -> dict[str, Check]:
    checks = [
        of_arm.check_safety(status),
        of_arm.check_program(status),
        of_arm.check_speed(status),
        of_arm.check_payload(status, tool, sensor_kg),
    ]
    return {check.name: check for check in checks}


@pytest.mark.parametrize(
    ("different", "name", "state", "words"),
    [
        ({"fault": DeviceFault("protective stop", "clear it")}, "robot.safety", "failed", "clear it"),
        ({"safety_mode": "reduced"}, "robot.safety", "warning", "calibrate asks"),
        ({"program": "playing"}, "robot.program", "warning", "refuses to start"),
        ({"payload_kg": 0.0}, "robot.payload", "failed", "on the pendant"),
        ({"payload_kg": 0.0, "p_flange_payload_m": None}, "robot.payload", "failed", "on the pendant"),
        ({"p_flange_payload_m": (0.0, 0.0, 0.0)}, "robot.payload", "warning", "centre of gravity"),
        ({"speed_slider": 0.04}, "robot.speed", "failed", "on the pendant"),
        ({"payload_kg": None}, "robot.payload", "skipped", ""),
    ],
)
def test_an_arm_that_is_not(different: dict[str, Any], name: str, state: str, words: str) -> None:
    found = arm_checks(replace(STATUS, **different))
    assert {other for other, check in found.items() if check.state != "ok"} == {name}
    assert found[name].state == state
    assert words in (found[name].fix or "")


@pytest.mark.parametrize(("remote", "state"), [(True, "ok"), (False, "failed"), (None, "skipped")])
def test_remote_control(remote: bool | None, state: str, lab: Lab) -> None:
    lab.arm.remote = remote
    assert of_arm.check_remote(lab.arm).state == state


def test_a_remote_control_that_cannot_be_queried_fails(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_dashboard() -> None:
        raise NoDashboard("ur5 says: Timeout connecting", "enable the dashboard server")

    monkeypatch.setattr(lab.arm, "in_remote_control", no_dashboard)
    found = of_arm.check_remote(lab.arm)
    assert (found.state, found.fix) == ("failed", "enable the dashboard server")


@pytest.mark.parametrize(
    ("info", "state", "words"),
    [
        (DeviceInfo("UR5e", "A1", "5.15"), "warning", "no kinematics reported: plans use nominal UR5e"),
        (DeviceInfo("UR5e", "A1", "5.15", {"kinematics": Fact(MODELS["UR5e"].numbers, "device")}), "ok", "0.0 mm"),
        (
            DeviceInfo("UR5e", "A1", "5.15", {"kinematics": Fact(drawn("UR5e").numbers, "device")}),
            "ok",
            "5.2 mm and",
        ),
        (DeviceInfo("Acme", "A1", "5.15"), "skipped", "are unknown"),
    ],
)
def test_how_far_an_arm_is_from_its_nominal_model(info: DeviceInfo, state: str, words: str) -> None:
    found = of_arm.check_kinematics(info)
    assert (found.state, words in found.found) == (state, True)


def test_the_arm_is_the_configured_one() -> None:
    info = DeviceInfo("UR5e", "A1", "5.15")
    assert of_arm.check_arm(info, RobotConfig("ur5")).state == "ok"
    assert of_arm.check_arm(info, RobotConfig("ur5", serial="A1")).state == "ok"
    other = of_arm.check_arm(info, RobotConfig("ur5", serial="B2"))
    assert (other.state, "has serial A1, but [robot] serial is B2" in other.found) == ("failed", True)


@pytest.mark.parametrize(
    ("mass_kg", "p_flange_payload_m", "state"),
    [
        (None, (0.0, 0.0, 0.05), "ok"),
        (1.6, (0.0, 0.0, 0.05), "ok"),
        (1.8, (0.0, 0.0, 0.05), "failed"),  # 1.8 kg and 0.1 kg of the sensor are 0.7 kg more
        (None, (0.14, 0.0, 0.05), "ok"),
        (None, (0.16, 0.0, 0.05), "failed"),  # 50 mm of the tool and 100 mm
        (None, (0.0, 0.0, 0.31), "failed"),
        (None, (0.0, 0.0, -0.11), "failed"),
        (None, None, "ok"),
    ],
)
def test_a_payload_is_compared_with_the_described_tool(
    mass_kg: float | None, p_flange_payload_m: tuple[float, ...] | None, state: str
) -> None:
    status = replace(STATUS, p_flange_payload_m=p_flange_payload_m)
    assert arm_checks(status, replace(TOOL, mass_kg=mass_kg), 0.1)["robot.payload"].state == state
    assert arm_checks(status, ToolConfig())["robot.payload"].state == "ok"  # nothing is described


@pytest.mark.parametrize(("mass_kg", "state"), [(2.0, "ok"), (2.1, "failed"), (None, "skipped")])
def test_the_tool_must_fit_the_range_of_the_sensor(mass_kg: float | None, state: str) -> None:
    cell = CellConfig(RobotConfig(""), SensorConfig(""), replace(TOOL, mass_kg=mass_kg))
    assert of_sensor.check_tool_weight((50.0, 50.0, 50.0, 10.0, 10.0, 10.0), cell).state == state
    assert of_sensor.check_tool_weight(None, cell).state == "skipped"


@pytest.mark.parametrize(
    ("rest", "mass_kg", "state", "says"),
    [
        ((0, 0, 50, 1, 0, 0), 1.0, "ok", "50.0 N in Fz, 17 % of its range"),
        ((0, 0, -160, 1, 0, 0), 1.0, "warning", "160.0 N in Fz"),
        ((0, 0, 260, 0, 0, 0), None, "warning", "260.0 N in Fz, 87 % of its range"),
        ((0, 0, 260, 0, 0, 0), 2.0, "failed", "260.0 N in Fz, 87 % of its range"),
        ((1800, 400, 25_400, -76, 0, 0), None, "failed", "25400.0 N in Fz, 8467 % of its range"),
        ((0, 0, 0, 0, 28, 0), None, "failed", "28.0 N·m in Ty, 93 % of its range"),
    ],
)
def test_what_a_sensor_reads_at_rest_must_leave_enough_of_its_range(
    rest: tuple[float, ...], mass_kg: float | None, state: str, says: str
) -> None:
    cell = CellConfig(RobotConfig(""), SensorConfig(""), replace(TOOL, mass_kg=mass_kg))
    limits = np.array([300.0] * 3 + [30.0] * 3)
    wrench = np.array([rest], dtype=float)
    check = of_sensor.check_rest(wrench, limits, cell, zero_is_arbitrary=False)
    assert (check.state, says in check.found) == (state, True)
    assert bool(check.fix) == (state != "ok")
    assert of_sensor.check_rest(wrench, limits, cell, zero_is_arbitrary=True).state == "skipped"
    assert of_sensor.check_rest(wrench, None, cell, zero_is_arbitrary=False).state == "skipped"


PORT = SensorAddress.of("bota:///dev/ttyUSB7")
BY_NETWORK = SensorAddress.of("ati-netft://192.168.1.1")
BY_PCAN = SensorAddress.of("ati-can://PCAN_USBBUS1?interface=pcan")


def stream(
    rate_Hz: float,
    *,
    nominal_Hz: float = 100.0,
    status: int = 0,
    address: SensorAddress = PORT,
    **counted: Any,
) -> dict[str, Check]:
    n = round(2 * rate_Hz)
    samples = FtSamples.of(np.arange(n), np.arange(n), np.zeros((n, 6)), counts=np.zeros((n, 6)), status=status)
    health = Health(received=n, lost=0, malformed=0, rate_Hz=rate_Hz, age_s=0.001, nominal_rate_Hz=nominal_Hz)
    health = replace(health, **counted)
    return {check.name: check for check in of_sensor.check_stream(samples, health, address, 2.0)}


def test_a_healthy_stream_and_three_that_are_not() -> None:
    assert {check.state for check in stream(100).values()} == {"ok"}
    slow = stream(62.5)["sensor.rate"]
    assert slow.state == "failed"
    assert "ttyUSB7/latency_timer" in str(slow.fix)
    assert stream(93)["sensor.rate"].state == "warning"
    assert stream(100, lost=1)["sensor.lost"].state == "warning"
    assert stream(100, lost=20)["sensor.lost"].state == "failed"
    assert stream(100, status=0x4000)["sensor.status"].found == "status 0x4000"
    assert stream(7, nominal_Hz=np.nan)["sensor.rate"].state == "ok"


@pytest.mark.parametrize(("rate_Hz", "state"), [(96, "ok"), (109, "ok"), (115, "failed"), (200, "failed")])
def test_a_rate_that_is_too_high(rate_Hz: float, state: str) -> None:
    rate = stream(rate_Hz)["sensor.rate"]
    assert rate.state == state
    assert ("samples are duplicated" in str(rate.fix)) == (state != "ok")


GUESS = Guess(1.2, 1.0, 1.0, sensor=SensorMatrix.usual())


def test_noise_at_rest_under_a_hand_and_none_at_all() -> None:
    noise = np.random.default_rng(0).normal(size=(2000, 6)) * ([0.03] * 3 + [0.001] * 3)
    level, accuracy = of_sensor.check_noise(noise, 2.0, 2.0, GUESS)
    assert (level.state, accuracy.state) == ("ok", "ok")
    assert "σ (0.03" in level.found
    assert "1.2 kg" in accuracy.found
    hand = noise.copy()
    hand[1000:, 2] += 0.5
    assert of_sensor.check_noise(hand, 2.0, 2.0, GUESS)[0].state == "warning"
    (dead,) = of_sensor.check_noise(np.ones((2000, 6)), 2.0, 2.0, GUESS)
    assert dead.state == "failed"
    one_axis, no_number = noise.copy(), noise.copy()
    one_axis[:, 4] = 0.3
    no_number[7, 1] = np.nan
    for bad, words in ((noise[:10], "10 samples"), (one_axis, "Ty did not change"), (no_number, "not numbers")):
        (check,) = of_sensor.check_noise(bad, 2.0, 2.0, GUESS)
        assert (check.state, words in check.found) == ("failed", True)


rotations = st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(rng=seed).as_matrix())


@given(rotations, rotations, st.floats(3, 100))
def test_push_names_axis_and_sign(R_base_flange: Any, R_flange_sensor: Any, size_N: float) -> None:
    R_sensor_base = (R_base_flange @ R_flange_sensor).T
    check, moved = of_sensor.check_push(R_sensor_base @ [size_N, 0, 0], R_base_flange, R_flange_sensor, 1)
    assert check.state == "ok"
    assert moved["base"]["axis"] == "+X"
    np.testing.assert_allclose(moved["flange"]["force_N"], R_base_flange.T @ [size_N, 0, 0], atol=1e-9)

    check, moved = of_sensor.check_push(R_sensor_base @ [-size_N, 0, 0], R_base_flange, R_flange_sensor, -1)
    assert (check.state, moved["base"]["axis"]) == ("failed", "-X")
    assert "sign = 1 " in str(check.fix)

    check, moved = of_sensor.check_push(R_sensor_base @ [0, -size_N, 0], R_base_flange, R_flange_sensor, 1)
    assert (check.state, moved["base"]["axis"]) == ("failed", "-Y")
    assert "sign" not in str(check.fix)


@pytest.mark.parametrize(
    ("payload_kg", "sensor_kg", "state", "words"),
    [
        (None, 0.3, "skipped", "does not report"),
        (1.72, 0.3, "ok", "controller 1.72 kg; identified 1.44 kg + 0.30 kg sensor"),
        (1.72, None, "ok", "identified 1.44 kg + sensor"),
        (3.0, 0.3, "warning", "payload of 3.00 kg, but the load on the sensor is 1.44 kg"),
    ],
)
def test_the_payload_is_compared_with_the_weighed_load(
    payload_kg: float | None, sensor_kg: float | None, state: str, words: str
) -> None:
    calibration = cast(CalibrationResult, SimpleNamespace(mass_kg=1.44))
    check = of_arm.check_weighed_payload(payload_kg, calibration, sensor_kg)
    assert (check.name, check.state) == ("robot.payload", state)
    assert words in check.found
    assert (state == "warning") == bool(
        check.fix and check.fix.startswith("set the payload in the controller to 1.74 kg")
    )


@pytest.mark.parametrize(
    ("factor", "drifts", "state"), [(1.0, 0.0, "ok"), (3.0, 0.0, "warning"), (1.0, 5.0, "skipped")]
)
def test_noise_is_compared_with_that_of_the_calibration(factor: float, drifts: float, state: str) -> None:
    sigma = np.repeat([0.1, 0.004], 3)
    cov = np.tile(np.diag(sigma**2 / 500), (6, 1, 1))
    R = Rotation.random(6, rng=1).as_matrix()
    dataset = CalibrationDataset(R, np.zeros((6, 6)), cov, np.full(6, 500), np.full(6, np.nan))
    rng = np.random.default_rng(1)
    wrench = factor * sigma * rng.normal(size=(1000, 6)) + drifts * sigma * np.linspace(0, 1, 1000)[:, None]
    check = of_sensor.check_noise_change(wrench, dataset)
    assert check.state == state
    unknown = CalibrationDataset(R, np.zeros((6, 6)), None, np.zeros(6, np.int64), np.full(6, np.nan))
    assert of_sensor.check_noise_change(wrench, unknown).state == "skipped"


def test_push_without_mounting_or_without_a_push() -> None:
    check, moved = of_sensor.check_push(np.array([0.5, -9.0, 1.0]), np.eye(3), None, 1)
    assert check.state == "skipped"
    assert moved["sensor"]["axis"] == "-Y"
    assert moved["flange"] is moved["base"] is None
    check, _ = of_sensor.check_push(np.array([0.5, 0.0, 0.0]), np.eye(3), np.eye(3), 1)
    assert check.state == "failed"


def device(serial: str, model: str = "M") -> DeviceInfo:
    return DeviceInfo(model, serial, NOT_REPORTED)


def test_calibration_of_another_sensor() -> None:
    made_with = {"arm": {"serial": "A", "model": "UR5e"}, "sensor": {"serial": "S", "model": "M"}}
    provenance = {"devices": made_with, "created_utc": "2026-01-01"}
    result = cast(CalibrationResult, SimpleNamespace(provenance=provenance, verdict="good"))
    assert check_calibration(result, {"arm": device("A", "UR5e"), "sensor": device("S")}).state == "ok"
    other = check_calibration(result, {"arm": device("A"), "sensor": device("T")})
    assert other.state == "failed"
    assert "sensor S, but the sensor T" in other.found
    unknown = check_calibration(result, {"arm": device("A"), "sensor": device(NOT_REPORTED)})
    assert unknown.state == "warning"
    assert "cannot check" in unknown.found
    assert "serial=" in str(unknown.fix)
    both = check_calibration(result, {"arm": device("B"), "sensor": device(NOT_REPORTED)})
    assert (both.state, both.fix) == ("failed", "run ftdrive calibrate")


@pytest.mark.parametrize(("made", "connected"), [("S", NOT_REPORTED), (NOT_REPORTED, "S"), (NOT_REPORTED,) * 2])
def test_a_calibration_of_another_model_is_of_another_sensor_without_serial_numbers(made: str, connected: str) -> None:
    devices = {"sensor": {"serial": made, "model": "ATI F/T (NETCANOEM, CAN)"}}
    result = cast(CalibrationResult, SimpleNamespace(provenance={"devices": devices}, verdict="good"))
    check = check_calibration(result, {"sensor": device(connected, "Bota force/torque sensor")})
    assert (check.state, check.fix) == ("failed", "run ftdrive calibrate")
    assert "ATI F/T (NETCANOEM, CAN), but Bota" in check.found
    same = check_calibration(result, {"sensor": device(connected, "ATI F/T (NETCANOEM, CAN)")})
    assert same.state == "warning"


@pytest.mark.parametrize("devices", [{"sensor": {"serial": NOT_REPORTED}}, {"sensor": {}}, {}, None])
def test_a_calibration_that_does_not_know_its_sensor_cannot_be_checked(devices: object) -> None:
    result = cast(CalibrationResult, SimpleNamespace(provenance={"devices": devices}, verdict="good"))
    for serial in ("FT12345", NOT_REPORTED):
        (words,) = compare_devices(result, {"sensor": device(serial)}).unknown
        assert "cannot check that the calibration belongs to this sensor" in words
        assert not compare_devices(result, {"sensor": device(serial)}).others


ALLOWED = Check("permissions.port", "ok", "may be read and written")
FORBIDDEN = Check("permissions.port", "failed", "may not", "sudo usermod")


def wrapped(error: DeviceError) -> ConnectError:
    """As a driver raises an error that occurred while it was opened."""
    outer = ConnectError(error.found, error.fix)
    outer.__cause__ = error
    return outer


def not_opened(found: str, cure: str = "") -> ConnectError:
    """As a driver raises an error of the system about its port."""
    outer = ConnectError(found, cure)
    outer.__cause__ = OSError(13, "Permission denied")
    return outer


@pytest.mark.parametrize(
    ("address", "ask"), [(PORT, "run ftdrive devices --probe"), (BY_NETWORK, "run ping ")], ids=["serial", "network"]
)
def test_to_the_cure_of_a_silence_belongs_how_to_see_who_answers(address: SensorAddress, ask: str) -> None:
    check = of_sensor.check_sensor_error("sensor.stream", DeviceTimeout("silent", "check cable"), address, [ALLOWED])
    assert str(check.fix).startswith("check cable; ")
    assert str(check.fix).partition(": ")[2].startswith(ask)


@pytest.mark.parametrize(
    ("error", "address", "permission", "cure"),
    [
        (not_opened("the port does not open"), PORT, FORBIDDEN, "sudo usermod"),
        (not_opened("cannot be opened (13)", "plugged in?"), PORT, FORBIDDEN, "sudo usermod"),
        (DeviceTimeout("silent for 0.4 s", "check cable and power"), PORT, FORBIDDEN, "sudo usermod"),
        (StreamBroken("the port is gone (x)", "plug it in"), PORT, FORBIDDEN, "sudo usermod"),
        (ConnectError("no port may be read"), PORT, FORBIDDEN, "sudo usermod"),
        (ConnectError("serial number A answers", "check the address"), PORT, FORBIDDEN, "check the address"),
        (wrapped(ProtocolError("slot 3 is empty", "choose another")), PORT, FORBIDDEN, "choose another"),
        (ConnectError("does not open"), PORT, ALLOWED, "ftdrive devices --probe /dev/ttyUSB7"),
        (DeviceTimeout("silent"), PORT, ALLOWED, "ftdrive devices --probe /dev/ttyUSB7"),
        (DeviceTimeout("silent"), BY_NETWORK, ALLOWED, "ping 192.168.1.1"),
        (wrapped(DeviceTimeout("no reply")), PORT, ALLOWED, "supply and cable"),
        (DeviceTimeout("silent"), BY_PCAN, ALLOWED, "ftdrive doctor again"),
        (StreamBroken("interrupted (silent; check cable)"), BY_PCAN, ALLOWED, "supply and cable"),
        (DeviceFault("status 4"), PORT, FORBIDDEN, "switch the sensor off and on"),
        (wrapped(DeviceFault("status 4")), PORT, ALLOWED, "switch the sensor off and on"),
        (ProtocolError("no intact record"), PORT, ALLOWED, "ftdrive devices --probe"),
    ],
)
def test_another_cure_is_shown_where_the_way_to_a_sensor_is_wrong_or_its_message_names_none(
    error: DeviceError, address: SensorAddress, permission: Check, cure: str
) -> None:
    found = of_sensor.check_sensor_error("sensor.stream", error, address, [permission])
    assert (found.name, found.state, found.found) == ("sensor.stream", "failed", error.found)
    assert cure in str(found.fix)


@pytest.mark.parametrize(("own", "shown"), [("check the robot", "check the robot"), ("", "run ping ur5")])
def test_the_error_of_an_arm_that_names_no_cure_gets_one(own: str, shown: str) -> None:
    check = of_arm.check_unreachable(StreamBroken("ur5:30004 was lost (x; y)", own), "ur5")
    assert (check.found, check.fix) == ("ur5:30004 was lost (x; y)", shown)


def test_a_wrench_without_the_weight_of_the_tool_is_compensated() -> None:
    cell = CellConfig(RobotConfig(""), SensorConfig(""), ToolConfig(mass_kg=2.0))
    for share, state in ((0.0, "warning"), (0.095, "warning"), (0.1, "ok"), (1.0, "ok")):
        check = of_sensor.check_compensated(np.tile([0.0, 12.0 * share, -16.0 * share, 9.0, 9.0, 9.0], (50, 1)), cell)
        assert check.state == state
        assert f"{20 * share:.1f} N, and the tool weighs 19.6 N" in check.found
    assert of_sensor.check_compensated(np.ones((50, 6)), replace(cell, tool=ToolConfig())).state == "skipped"
