"""Checks of an arm and its controller, and the payload that the controller should have."""

import math
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Final

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.after.weighing import true_tool
from ftcalib.judge import described_cell
from ftcalib.model import Array, skew
from ftdrive.cell.config import CellConfig, RobotConfig, ToolConfig
from ftdrive.cell.devices import build_arm
from ftdrive.checks.check import Check, check_diagnosis, who
from ftdrive.planning.geometry.kinematics import frames
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError, ModelUnknown
from ftdrivers.interfaces import NOT_REPORTED, ArmStatus, DeviceInfo, RobotArm
from ftdrivers.ur.kinematics import MODELS, kinematics_of

# Most by which the payload's centre of mass may lie outside the described tool, mm.
_PAYLOAD_MM: Final = 100.0
_LINK_S: Final = 0.5
_CLOCK_S: Final = 1.0
_LINK_TRIES: Final = 3
# Number of random postures at which the reported kinematics of an arm are compared with the nominal model.
_POSTURES: Final = 200
SLOWEST_SLIDER = 0.05
"""Lowest position of the speed slider, 0 to 1, at which the time-outs of moves are long enough."""
# Rated payloads from the data sheets of Universal Robots. Later arms of a model may carry more: see the label.
# The payload curve over the offset of the centre of mass is published only as a figure in the user manual.
RATED_KG: Final = (
    {"UR3": 3.0, "UR5": 5.0, "UR10": 10.0}
    | {"UR3e": 3.0, "UR5e": 5.0, "UR7e": 7.5, "UR10e": 10.0, "UR12e": 12.5, "UR16e": 16.0}
    | {"UR8long": 8.0, "UR15": 15.0, "UR18": 18.0, "UR20": 20.0, "UR30": 30.0}
)


def check_unreachable(error: DeviceError, host: str) -> Check:
    """Return the failed check of an arm that could not be opened, with its remedy."""
    fix = error.fix or f"run ping {host}"
    if isinstance(error, ModelUnknown):
        fix = f'write model = "ur5e" under [robot] in ftdrive.toml, or give --model: one of {", ".join(MODELS)}'
    return Check("robot.reachable", "failed", error.found, fix)


def check_arm(info: DeviceInfo, robot: RobotConfig) -> Check:
    """Check that the arm has the configured serial number, if [robot] serial is set."""
    name = "robot.identity"
    if robot.serial not in {None, info.serial}:
        found = f"the arm at {robot.host} has serial {info.serial}, but [robot] serial is {robot.serial}"
        if info.serial == NOT_REPORTED:
            return Check(name, "failed", f"{found}, so the two cannot be compared", "remove [robot] serial")
        return Check(name, "failed", found, "connect the configured arm, or correct [robot] serial")
    return Check(name, "ok", who(info))


def check_kinematics(info: DeviceInfo) -> Check:
    """Check that an arm reports its kinematics, and compare them with its nominal model."""
    name, own = "robot.kinematics", kinematics_of(info)
    if info.model not in MODELS:
        return Check(name, "skipped", f"the nominal kinematics of a {info.model} are unknown")
    if own is None:
        found = f"no kinematics reported: plans use nominal {info.model} kinematics with wider margins"
        return Check(name, "warning", found, "enable the primary client interface under Settings, Security, Services")
    q_rad = np.random.default_rng(0).uniform(-np.pi, np.pi, (_POSTURES, 6))
    real, nominal = frames(own, q_rad), frames(MODELS[info.model], q_rad)
    off_mm = 1e3 * np.linalg.norm(real.flange_m - nominal.flange_m, axis=1).max()
    chord = np.linalg.norm(real.R_base_flange - nominal.R_base_flange, axis=(1, 2)).max() / np.sqrt(8.0)
    off_deg = np.degrees(2 * np.arcsin(chord))
    found = f"kinematics reported, up to {off_mm:.1f} mm and {off_deg:.2f}° from a nominal {info.model}"
    return Check(name, "ok", f"{found}; plans use them")


def check_remote(arm: RobotArm) -> Check:
    """Check that the controller accepts programs from the network."""
    name = "robot.remote"
    try:
        remote = arm.in_remote_control()
    except DeviceError as error:
        return Check(name, "failed", error.found, error.fix or None)
    if remote is None:
        return Check(name, "skipped", "the controller does not report whether it accepts programs from the network")
    if remote:
        return Check(name, "ok", "remote control on")
    return Check(name, "failed", "local control", "press Local at the top right of the pendant, then Remote Control")


def check_safety(status: ArmStatus) -> Check:
    """Check that the safety system lets the arm move."""
    if status.fault is not None:
        return Check("robot.safety", "failed", status.fault.found, status.fault.fix)
    if status.safety_mode != "normal":
        fix = "check on the pendant that this mode is intended; calibrate asks for confirmation"
        return Check("robot.safety", "warning", f"safety mode {status.safety_mode}", fix)
    return Check("robot.safety", "ok", "powered, brakes released, no stop")


def check_program(status: ArmStatus) -> Check:
    """Check that no program runs on the controller."""
    if status.program == "stopped":
        return Check("robot.program", "ok", "no program runs; clients that only read cannot be detected")
    found = f"a program is active on the controller ({status.program})"
    return Check("robot.program", "warning", found, "stop it on the pendant: calibrate refuses to start while it runs")


def check_speed(status: ArmStatus) -> Check:
    """Check that the speed slider is high enough."""
    found = (
        f"speed slider at {100 * status.speed_slider:.0f} %; the controller allows {100 * status.speed_scaling:.0f} %"
    )
    if status.speed_slider < SLOWEST_SLIDER:
        fix = "raise the speed slider on the pendant, to 100 % if that is safe; ftdrive never changes it"
        return Check("robot.speed", "failed", f"{found}: the arm would hardly move", fix)
    return Check("robot.speed", "ok", found)


def check_payload(status: ArmStatus, tool: ToolConfig, sensor_kg: float | None) -> Check:
    """Check the payload set in the controller, and compare it with the described tool and sensor.

    The mass may differ by the larger of `PAYLOAD_KG` and `PAYLOAD_SHARE`; the centre must be near the tool.
    """
    name, payload_kg, p_m = "robot.payload", status.payload_kg, status.p_flange_payload_m
    if payload_kg is None:
        return Check(name, "skipped", "the controller does not report its payload: check it on the pendant")
    if payload_kg <= 0:
        fix = "on the pendant, set total mass and centre of mass of what the flange carries; otherwise the arm may stop"
        return Check(name, "failed", "no payload is set in the controller", fix)
    found = f"payload {payload_kg:.2f} kg"
    if p_m is None:
        found += "; its centre of mass is not reported"
    else:
        found += " at ({:.0f}, {:.0f}, {:.0f}) mm from the flange".format(*(1e3 * value for value in p_m))
        if tool.cylinders_mm and not _at_tool(p_m, tool):
            fix = "correct the centre of mass on the pendant, or [tool] cylinders_mm"
            return Check(name, "failed", f"{found}, outside the tool", fix)
    if tool.mass_kg is not None:
        expected_kg = tool.mass_kg + (sensor_kg or 0.0)
        found += f"; sensor and tool weigh {expected_kg:.2f} kg"
        if abs(payload_kg - expected_kg) > max(described_cell.PAYLOAD_KG, described_cell.PAYLOAD_SHARE * expected_kg):
            return Check(name, "failed", found, "correct the pendant's payload, or the masses in [tool] and [sensor]")
    if p_m is not None and not any(p_m):
        fix = "set the centre of gravity on the pendant: Installation, Payload"
        return Check(name, "warning", f"{found}; no real payload has its centre in the flange face", fix)
    return Check(name, "ok", found)


def check_weighed_payload(payload_kg: float | None, result: CalibrationResult, sensor_kg: float | None) -> Check:
    """Compare the controller's payload with the mass of a calibration plus `sensor_kg` for sensor and adapter."""
    name = "robot.payload"
    if payload_kg is None:
        return Check(name, "skipped", "the controller does not report its payload")
    for finding in described_cell.payload(payload_kg, result.mass_kg, sensor_kg):
        return Check(name, "warning", finding.found, finding.fix)
    known = "sensor" if sensor_kg is None else f"{sensor_kg:.2f} kg sensor"
    return Check(name, "ok", f"controller {payload_kg:.2f} kg; identified {result.mass_kg:.2f} kg + {known}")


def _at_tool(p_flange_m: Sequence[float], tool: ToolConfig) -> bool:
    x_mm, y_mm, z_mm = (1e3 * value for value in p_flange_m)
    reach_mm = max(math.hypot(*row[3:]) + row[2] / 2 for row in tool.cylinders_mm)
    length_mm = max(row[1] for row in tool.cylinders_mm)
    return math.hypot(x_mm, y_mm) <= reach_mm + _PAYLOAD_MM and -_PAYLOAD_MM <= z_mm <= length_mm + _PAYLOAD_MM


def check_link(arm: RobotArm, clock: Clock, *, usual_s: float, gap_s: float) -> Check:
    """Check the response times of the arm in 0.5 s: median below `usual_s`, 90 % below `gap_s`; best of three."""
    name, found = "robot.link", ""
    # Try again, because a briefly busy computer is not a bad link.
    for _ in range(_LINK_TRIES):
        try:
            with clock.keeping_up():
                took_s = _answers_s(arm, clock)
        except DeviceError as error:
            return _silent(name, error)
        median_s = float(np.median(took_s))
        found = f"the arm answers in {1e3 * median_s:.0f} ms (median), at most {1e3 * max(took_s):.0f} ms"
        if median_s < usual_s and np.quantile(took_s, 0.9) < gap_s:
            return Check(name, "ok", found)
    limit = f"allowed: median {1e3 * usual_s:.0f} ms, 90 % within {1e3 * gap_s:.0f} ms"
    return Check(name, "failed", f"{found} ({limit})", "use a network cable, and reduce the load on this computer")


def _answers_s(arm: RobotArm, clock: Clock) -> list[float]:
    took_s, end_s = list[float](), clock.now_s() + _LINK_S
    while (started_s := clock.now_s()) < end_s:
        arm.state()
        took_s.append(clock.now_s() - started_s)
    return took_s


def check_clock(arm: RobotArm, clock: Clock) -> Check:
    """Compare the clock rates of controller and computer, from time differences within each clock alone."""
    t_host_ns, t_device_s = list[int](), list[float]()
    try:
        with clock.keeping_up():
            while not t_host_ns or t_host_ns[-1] - t_host_ns[0] < _CLOCK_S * 1e9:
                clock.sleep(0.02)
                status = arm.status()
                t_host_ns.append(status.t_host_ns)
                t_device_s.append(status.t_device_s)
    except DeviceError as error:
        return _silent("clock.pace", error)
    host_s = (np.asarray(t_host_ns) - t_host_ns[0]) / 1e9
    pace = float(np.polyfit(host_s, np.asarray(t_device_s) - t_device_s[0], 1)[0])
    found = f"rate of the controller's clock relative to this computer: {pace:.4f}, over {host_s[-1]:.1f} s"
    if abs(pace - 1) < 0.02:
        return Check("clock.pace", "ok", found)
    return Check("clock.pace", "warning", found, "close other programs on this computer, and check the network")


def _silent(name: str, error: DeviceError) -> Check:
    return Check(name, "failed", error.found, error.fix or "check the robot and the network")


def check_flange(arm: RobotArm, status: ArmStatus) -> Check:
    """Check that the flange pose can be read without control of the arm."""
    name = "robot.flange"
    if status.tcp_offset is None:
        found = "the controller does not report its TCP offset, so poses can only be read with control of the arm"
        return Check(name, "skipped", found)
    try:
        p_mm = 1e3 * arm.state().p_base_flange_m
    except DeviceError as error:
        return _silent(name, error)
    where = ", ".join(f"{value:.0f}" for value in p_mm)
    return Check(name, "ok", f"TCP offset reported; flange at ({where}) mm in base")


def examine_arm(
    cell: CellConfig, stack: ExitStack, *, usual_s: float, gap_s: float
) -> tuple[list[Check], RobotArm | None]:
    """Open the arm until `stack` ends; return all checks that need no control, and the arm, or None if it is silent.

    The times are as in `check_link`.
    """
    if not cell.robot.host:
        found = "only the sensor is checked, because [robot] host and --robot are not set"
        return [Check("robot.reachable", "skipped", found)], None
    arm = stack.enter_context(closing(build_arm(cell)))
    try:
        arm.open()
        info, status = arm.identify(), arm.status()
    except DeviceError as error:
        return [check_unreachable(error, cell.robot.host)], None
    flange = check_flange(arm, status)
    return [
        Check("robot.reachable", "ok", f"{cell.robot.host} answers"),
        check_arm(info, cell.robot),
        check_kinematics(info),
        check_remote(arm),
        *map(check_diagnosis, arm.diagnose()),
        check_safety(status),
        check_program(status),
        check_speed(status),
        check_payload(status, cell.tool, cell.sensor.mass_kg),
        flange,
        *([check_link(arm, cell.clock, usual_s=usual_s, gap_s=gap_s)] if flange.state == "ok" else []),
        check_clock(arm, cell.clock),
    ], arm


@dataclass(frozen=True, slots=True, eq=False)
class FlangeLoad:
    """Mass and centre of mass of everything below the flange: the payload of the controller."""

    mass_kg: float
    p_flange_com_m: Array
    """(3,) centre of mass, flange axes."""
    sigma_kg: float
    sigma_m: Array
    """(3,) standard deviation of `p_flange_com_m`."""


def flange_load(
    result: CalibrationResult, sensor_kg: float, height_m: float, p_flange_sensor_com_m: Array | None = None
) -> FlangeLoad:
    """Return the payload: sensor and adapter plus the tool identified by a calibration.

    The mass is ``m = m_tool + m_sensor``, its centre ``(m_tool c_tool + m_sensor c_sensor) / m`` with
    ``c_tool = p_flange_sensor + R_flange_sensor p_sensor_com``.

    `sensor_kg` and `p_flange_sensor_com_m` (3,) are the mass and centre of sensor and adapter; `height_m` is the height
    of the sensor's origin above the flange face. By default the centre is at half this height on the flange axis, with
    a uniform distribution over the height as its uncertainty.
    """
    # Mass and height of the sensor are configured, because gravity does not determine them.
    tool_kg, p_sensor_com_m = true_tool(result)
    arm_m = result.R_flange_sensor @ p_sensor_com_m
    c_tool_m = np.array([0.0, 0.0, height_m]) + arm_m
    c_sensor_m = np.array([0.0, 0.0, height_m / 2]) if p_flange_sensor_com_m is None else p_flange_sensor_com_m
    mass_kg = tool_kg + sensor_kg
    share = tool_kg / mass_kg
    com_m = share * c_tool_m + (1 - share) * c_sensor_m

    # Derivatives of (m, com) with respect to the tool mass, and to the error coordinates of `Parameters.moved`.
    by_mass = np.concatenate([[1.0], (c_tool_m - com_m) / mass_kg])
    jacobian = np.zeros((4, 15))
    jacobian[:, 3:6] = np.outer(by_mass, result.gravity_force_base_N / (result.weight_N * result.g_m_s2))
    jacobian[1:, 0:3] = share * skew(arm_m)
    jacobian[1:, 9:12] = share * result.R_flange_sensor
    covariance = jacobian @ result.tool_covariance @ jacobian.T
    gain_variance = float(np.square(result.sigma["mass_kg"])) - covariance[0, 0]  # `sigma` includes the gain
    covariance += max(gain_variance, 0.0) * np.outer(by_mass, by_mass)
    if p_flange_sensor_com_m is None:
        covariance[3, 3] += ((1 - share) * height_m) ** 2 / 12
    sigma = np.sqrt(np.diag(covariance))
    return FlangeLoad(mass_kg, com_m, float(sigma[0]), sigma[1:])


def margin_in_words(mass_kg: float, model: str) -> str:
    """Describe how far a mass is below the rated payload of an arm."""
    rated_kg = RATED_KG.get(model)
    if rated_kg is None:
        return f"{mass_kg:.2f} kg; the rated payload of a {model} is unknown: compare with its data sheet"
    curve = "also compare with the payload curve in its user manual"
    if mass_kg > rated_kg:
        over_kg = mass_kg - rated_kg
        return (
            f"{over_kg:.2f} kg above the rated payload of a {model}, {rated_kg:g} kg: see the label of the arm; {curve}"
        )
    return f"{rated_kg - mass_kg:.2f} kg below the rated payload of a {model}, {rated_kg:g} kg; {curve}"
