"""What is looked at before anything moves. A check answers with what it found; one that failed forbids to go on."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.data.dwell_mean import LEAST_SAMPLES
from drivers.clock import Clock
from drivers.errors import DriverError
from drivers.interfaces import ForceTorqueSensor, FtSamples, RobotArm
from ftdrive.cell.config import CellConfig
from ftdrive.checks import computer, devices
from ftdrive.checks.computer import RATE_TOLERANCE, Check
from ftdrive.checks.controller_settings import PAYLOAD_KG, PAYLOAD_SHARE
from ftdrive.errors import NotAccepted, PlanRefused
from ftdrive.planning.approach import Approach
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.plan import Plan
from ftdrive.planning.search.nodes import WRIST_6_RAD
from ftdrive.session.events import Checked
from ftdrive.session.guards import AXES, G_M_S2, Limits, ModelGuard, Tripped

Array = NDArray[np.float64]

LISTEN_S: Final = 2.0
_LINK_S: Final = 0.5
_LINK_TRIES: Final = 3
_EDGE_RAD: Final = float(np.radians(5))
"""Each question takes the controller some 10 ms. Between two points no part is more than 1 mm off their chord."""
_ROUNDED_RAD: Final = float(np.radians(1))
"""A plan is made for where the arm stands, rounded."""
_LOAD: Final = 0.8
_PAYLOAD_M: Final = 0.1
"""How far outside of the described tool the centre of the payload may be."""


@dataclass(frozen=True, slots=True, eq=False)
class Before:
    """Everything the checks look at."""

    cell: CellConfig
    arm: RobotArm
    sensor: ForceTorqueSensor
    certifier: Certifier
    plan: Plan
    approach: Approach
    runs: Path
    known: bool
    """Whether this plan has run to its end on this arm before: its edges were asked of the controller then."""
    quiet: FtSamples
    """Two seconds of the sensor at rest."""
    resumed: bool
    """Whether a part of the plan has run before."""
    limits: Limits
    sensor_range: Array | None = None


Row = Callable[[Before], Checked]
"""Of the hazard table."""


def check_workcell(before: Before) -> Checked:
    """Row 3: tool, planes and boxes are described, can be, and are as a person measured them."""
    check = computer.check_workcell(before.cell, before.certifier.arm.name)
    return replace(_told("workcell", check), passed=check.state == "ok")


def check_plan(before: Before) -> Checked:
    """Rows 2 and 25: every move of the plan is proven clear, for this arm, tool and scene."""
    try:
        before.plan.require(before.certifier)
    except PlanRefused as error:
        return _failed("plan", str(error))
    clear = 1e3 * min(step.clearance_m for step in before.plan.steps)
    return _passed("plan", f"{len(before.plan.steps)} moves proven clear, nearest {clear:.0f} mm; joint moves only")


def check_approach(before: Before) -> Checked:
    """Row 5: so is the way from where the arm stands to the first pose."""
    approach = before.approach
    if not approach.certified:
        return _failed("approach", "the way to the first pose is not proven clear: jog the arm near it")
    if not len(approach.q_rad):
        return _passed("approach", "the arm stands at the first pose")
    return _passed(
        "approach", f"moves: {len(approach.q_rad)}, proven clear, nearest {1e3 * approach.clearance_m:.0f} mm"
    )


def check_cable(before: Before) -> Checked:
    """Row 1: wrist 3 stays in its window about where it stands, for that is how the cable lies."""
    stands = before.arm.state().q_rad[5]
    turns = [step.q_rad[5] for step in before.plan.steps]  # an approach turns it no farther
    low, high = min(turns), max(turns)
    where, least, most = np.degrees([stands, low, high])
    found = f"wrist 3 stands at {where:.0f}°, it turns between {least:.0f}° and {most:.0f}°"
    has_been_there = (before.known or before.resumed) and low <= stands <= high
    if has_been_there or max(high - stands, stands - low) <= WRIST_6_RAD + _ROUNDED_RAD:
        return _passed("cable", found)
    window = np.degrees(WRIST_6_RAD)
    return _failed(
        "cable",
        f"{found}, more than {window:.0f}° to one side, which may wind up the cable: jog it to between "
        f"{most - window:.0f}° and {least + window:.0f}°, or make a new plan where it stands",
    )


def check_safety_limits(before: Before) -> Checked:
    """Row 3: the controller accepts every pose, and before the first run points of the way between."""
    nodes = np.array([step.q_rad for step in before.plan.steps])
    path = np.vstack([nodes, nodes[:1]])
    step_rad = np.inf if before.known else _EDGE_RAD
    for way in (path, before.approach.q_rad):
        if len(way) and (words := forbidden(before.arm, way, step_rad)):
            return _failed("limits", words)
    return _passed("limits", "the controller accepts every pose" + ("" if before.known else " and the ways between"))


def forbidden(arm: RobotArm, q_rad: Array, step_rad: float = _EDGE_RAD) -> str:
    """Say where the controller's safety limits forbid straight moves through joint vectors (n, 6); empty if nowhere."""
    for q in edges(q_rad, step_rad):
        if not arm.within_safety_limits(q.tolist()):
            return (
                f"the controller's safety limits forbid joints {np.degrees(q).round().astype(int).tolist()} degrees: "
                "bring joints 1 to 3 to another posture, or see the safety settings"
            )
    return ""


def check_safety(before: Before) -> Checked:
    """Rows 10, 11 and 12: the safety system lets the arm move."""
    return _told("safety", devices.check_safety(before.arm.status()))


def check_remote(before: Before) -> Checked:
    """Row 21: the controller takes programs from here."""
    try:
        return _told("remote", devices.check_remote(before.arm.in_remote_control()))
    except DriverError as error:
        return _failed("remote", str(error))


def require_no_program(arm: RobotArm, clock: Clock, limits: Limits) -> None:
    """Row 21: raise `NotAccepted` where a program is, and stays, on the controller: no session ends one to begin."""
    deadline_s = clock.now_s() + limits.program_ends_s
    while (program := arm.status().program) != "stopped":
        if clock.now_s() > deadline_s:
            raise NotAccepted(
                f"another program is on the controller ({arm.reported_program() or program}): stop it at the pendant, "
                "then start again; nothing was touched"
            )
        clock.sleep(0.02)


def check_model(before: Before) -> Checked:
    """Rows 8 and 9: it is the arm that is meant, and its flange is where this model has it."""
    state, info, robot = before.arm.state(), before.arm.identify(), before.cell.robot
    if robot.serial not in {None, info.serial}:
        return _failed(
            "model",
            f"the arm at {robot.host} has serial {info.serial}, [robot] serial says {robot.serial}: correct one",
        )
    try:
        ModelGuard(before.limits, before.certifier).judge(state)
    except Tripped as trip:
        return _failed("model", str(trip))
    return _passed("model", f"{info.model}, serial {info.serial}: the flange is where its joints have it")


def check_payload(before: Before) -> Checked:
    """Row 7: the controller knows about what it carries."""
    status = before.arm.status()
    told = status.payload_kg
    if told is None:
        return _passed("payload", "this controller does not tell its payload: compare it at the pendant")
    if (check := devices.check_payload(status)).state == "failed":
        return _told("payload", check)
    if words := _misplaced(before):
        return _failed("payload", words)
    parts = (before.cell.tool.mass_kg, before.cell.sensor.mass_kg)
    if parts[0] is None:
        return _passed("payload", f"the controller carries {told:.2f} kg; nothing in [tool] to compare it with")
    expected = sum(part for part in parts if part is not None)
    if abs(told - expected) > max(PAYLOAD_KG, PAYLOAD_SHARE * expected):
        return _failed(
            "payload",
            f"the controller carries {told:.2f} kg, sensor and tool are {expected:.2f} kg: correct one of the two",
        )
    return _passed("payload", f"the controller carries {told:.2f} kg, sensor and tool are {expected:.2f} kg")


def _misplaced(before: Before) -> str:
    """Say that the controller has the payload's centre where no tool is; empty if it has not, or does not tell."""
    told = before.arm.status().p_flange_payload_m
    if told is None:
        return ""
    tool = before.certifier.arm.tool
    across, along = float(np.hypot(told[0], told[1])), told[2]
    reach, length = max(part.reach_m for part in tool), max(part.to_m for part in tool)
    if across <= reach + _PAYLOAD_M and -_PAYLOAD_M <= along <= length + _PAYLOAD_M:
        return ""
    x, y, z = (1e3 * value for value in told)
    return (
        f"the controller has the payload's centre at ({x:.0f}, {y:.0f}, {z:.0f}) mm from the flange, where the tool is "
        "not: correct it at the pendant, or the tool's cylinders"
    )


def check_slider(before: Before) -> Checked:
    """Row 22: a slow arm only takes longer, but not for ever; the slider is never touched."""
    return _told("slider", devices.check_speed(before.arm.status()))


def check_sensor(before: Before) -> Checked:
    """Rows 14 and 15: all six axes live, at their rate."""
    wrench, nominal = before.quiet.wrench, before.sensor.health().nominal_rate_Hz
    if len(wrench) < LEAST_SAMPLES:
        return _failed("sensor", f"{len(wrench)} samples in {LISTEN_S:g} s: check its rate")
    if not np.isfinite(wrench).all():
        return _failed("sensor", "the sensor says something that is no number: check its cable and supply")
    span_s = float(before.quiet.t_host_ns[-1] - before.quiet.t_host_ns[0]) / 1e9
    rate_Hz = (len(wrench) - 1) / max(span_s, 1e-3)
    if np.isfinite(nominal) and abs(rate_Hz / nominal - 1) > RATE_TOLERANCE:
        return _failed("sensor", f"{rate_Hz:.0f} Hz instead of {nominal:.0f}: see `ftdrive doctor`")
    dead = [AXES[i] for i in np.flatnonzero(np.ptp(wrench, axis=0) == 0)]
    if dead:
        return _failed("sensor", f"{', '.join(dead)} did not change for {span_s:.1f} s: the sensor is stuck")
    std = wrench.std(axis=0)
    return _passed("sensor", f"{rate_Hz:.0f} Hz, noise {std[:3].max():.3f} N, {std[3:].max():.4f} N·m")


def check_load(before: Before) -> Checked:
    """Row 13: twice the tool's weight fits into the sensor's range."""
    mass_kg = before.cell.tool.mass_kg
    if before.sensor_range is None or mass_kg is None:
        what = "the tool's mass" if mass_kg is None else "the sensor's range"
        return _passed("load", f"not compared: {what} is not known; a sensor that tells an overload stops the arm")
    weight_N = mass_kg * G_M_S2
    lever_m = max(part.to_m for part in before.certifier.arm.tool)
    share = max(
        2 * weight_N / float(before.sensor_range[:3].min()),
        2 * weight_N * lever_m / float(before.sensor_range[3:].min()),
    )
    words = f"twice the tool's weight is {100 * share:.0f} % of the sensor's range"
    return _passed("load", words) if share <= _LOAD else _failed("load", f"{words}: take a larger sensor")


def check_link(before: Before) -> Checked:
    """Row 16: states of the arm come soon and without gaps, in one of three half seconds."""
    limits, clock, words = before.limits, before.cell.clock, ""
    limit_s = limits.link_usual_s
    if before.arm.status().tcp_offset is None:
        limit_s += limits.link_asked_s
    for _ in range(_LINK_TRIES):  # a computer that is busy for a moment is no bad link
        try:
            with clock.keeping_up():
                took_s = _answers_s(before.arm, clock)
        except DriverError as error:
            return _failed("link", str(error))
        usual_s = float(np.median(took_s))
        words = f"the arm answers within {1e3 * usual_s:.0f} ms, once {1e3 * max(took_s):.0f} ms"
        if usual_s < limit_s and np.quantile(took_s, 0.9) < limits.link_gap_s:
            return _passed("link", words)
    limit = f"{1e3 * limit_s:.0f} ms are usual at most"
    return _failed("link", f"{words} ({limit}): use a cable, and give this computer and network less to do")


def _answers_s(arm: RobotArm, clock: Clock) -> list[float]:
    """Ask the arm for its state again and again; return how long it took each time."""
    took_s, end_s = list[float](), clock.now_s() + _LINK_S
    while (started_s := clock.now_s()) < end_s:
        arm.state()
        took_s.append(clock.now_s() - started_s)
    return took_s


def check_disk(before: Before) -> Checked:
    """Row 26: poses can be written, and there is room for them."""
    return _told("disk", computer.check_disk(before.runs))


CHECKS: Final[Sequence[Row]] = (
    check_safety,
    check_remote,
    check_model,
    check_payload,
    check_slider,
    check_link,
    check_sensor,
    check_load,
    check_workcell,
    check_plan,
    check_approach,
    check_cable,
    check_disk,
)
"""In the order in which they are told. None of them takes control of the arm."""

IN_CONTROL: Final[Sequence[Row]] = (check_safety_limits,)
"""What only a program on the controller can answer, asked when all else is well."""

AGAIN: Final[Sequence[Row]] = (*(check for check in CHECKS if check is not check_approach), *IN_CONTROL)
"""What is looked at once more before a stopped session goes on: all, but that the way on is judged by itself."""


def edges(q_rad: Array, step_rad: float) -> Array:
    """Points (m, 6) along straight moves through joint vectors (n, 6), no further apart than `step_rad`."""
    parts = []
    for start, end in pairwise(q_rad):
        count = max(1, int(np.ceil(np.abs(end - start).max() / step_rad)))
        parts.append(start + np.arange(count)[:, None] / count * (end - start))
    return np.vstack([*parts, q_rad[-1:]])


@contextmanager
def awake() -> Iterator[str]:
    """Row 18: keep the computer from going to sleep where systemd can; yields what was done, in words."""
    asleep = "this computer is not kept awake: see that it does not go to sleep"
    tool = shutil.which("systemd-inhibit") if sys.platform == "linux" else None
    if tool is None:
        yield asleep
        return
    command = [tool, "--what=sleep:idle", "--who=ftdrive", "--why=an arm is under way", "--mode=block", "cat"]
    # `cat` ends with our end of its stdin, so the inhibition cannot outlive us.
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        with suppress(subprocess.TimeoutExpired):  # it only ends by itself when nobody grants the wish
            process.wait(timeout=0.3)
        yield "this computer is kept awake" if process.returncode is None else asleep
    finally:
        if process.stdin is not None:
            process.stdin.close()
        try:
            process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _told(name: str, check: Check) -> Checked:
    """What `doctor` says of the same thing; a warning does not forbid to go on."""
    words = f"{check.found}: {check.fix}" if check.fix else check.found
    return Checked(name=name, passed=check.state != "failed", words=words)


def _passed(name: str, words: str) -> Checked:
    return Checked(name=name, passed=True, words=words)


def _failed(name: str, words: str) -> Checked:
    return Checked(name=name, passed=False, words=words)
