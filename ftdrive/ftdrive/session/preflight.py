"""Preflight checks of a session, in their order. A failed check forbids motion."""

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

from ftcalib.data.dwell_mean import LEAST_SAMPLES, noise_level
from ftcalib.judge import described_cell
from ftcalib.model import Array
from ftdrive.cell.config import CellConfig
from ftdrive.checks import arm as of_arm
from ftdrive.checks import computer
from ftdrive.checks.arm import RATED_KG, check_arm, check_remote, check_safety, check_speed
from ftdrive.checks.check import Check, merge_checks
from ftdrive.checks.sensor import check_level, check_rate, check_rest, check_tool_weight
from ftdrive.errors import NotAccepted, PlanRefused
from ftdrive.planning.approach import Approach
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.plan import Plan
from ftdrive.planning.search.nodes import WRIST_6_RAD
from ftdrive.session.events import Checked
from ftdrive.session.guards import Limits, ModelGuard, Tripped
from ftdrive.session.open_session import OpenCell, Task
from ftdrivers.clock import Clock
from ftdrivers.interfaces import FtSamples, RobotArm

LISTEN_S: Final = 2.0
# Step between the points of a move that are checked against the safety limits; a check takes about 10 ms. Between two
# points the flange deviates from the straight line through them by at most 1 mm.
_EDGE_RAD: Final = float(np.radians(5))
# A plan is made for rounded joint angles, and the joint angles of a resting arm have noise of about 2e-5 rad.
_ROUNDED_RAD: Final = float(np.radians(1))


@dataclass(frozen=True, slots=True, eq=False)
class Before:
    """Everything that is known before the first motion of a session: the input to the preflight checks."""

    cell: OpenCell
    config: CellConfig
    certifier: Certifier
    plan: Plan
    approach: Approach
    """Approach from the present posture to the first remaining pose."""
    runs: Path
    known: bool
    """Whether this arm has completed the plan before, which means that its controller has accepted every move."""
    quiet: FtSamples
    """Samples of the resting sensor over `LISTEN_S`."""
    resumed: bool
    """Whether part of the plan was driven before, because the run is resumed or goes on after a stop."""
    task: Task

    def quiet_std(self, average_s: float) -> Array:
        """Return the standard deviation (6,) of the resting sensor's samples within averages of this length."""
        share = min(1.0, average_s / LISTEN_S)
        return noise_level(self.quiet.wrench, max(LEAST_SAMPLES, int(len(self.quiet) * share)))

    @property
    def sensor_range(self) -> Array | None:
        """Measuring range (6,) of the sensor, N and N·m; None if its driver does not know the range."""
        fact = self.cell.sensor.identify().facts.get("range")
        return None if fact is None else np.asarray(fact.value, dtype=np.float64)

    @property
    def sensor_zero(self) -> Array:
        """Reading (6,) from which the range is counted: that at rest if the sensor's zero is arbitrary, otherwise 0."""
        is_arbitrary = self.cell.sensor.identify().has_arbitrary_zero
        return np.asarray(self.quiet.wrench.mean(axis=0) if is_arbitrary else np.zeros(6))


@dataclass(frozen=True, slots=True)
class SessionCheck:
    """A preflight check."""

    name: str
    """Name of the check in the event that shows its result."""
    judge: Callable[[Before], Check]

    def __call__(self, before: Before) -> Checked:
        """Run the check and return its result as an event; a check that only warns counts as passed."""
        check = self.judge(before)
        words = f"{check.found}: {check.fix}" if check.fix else check.found
        return Checked(name=self.name, passed=check.state != "failed", words=words)


def _check_model(before: Before) -> Check:
    """Check that this is the configured arm, and that its flange pose agrees with the forward kinematics."""
    check = check_arm(before.cell.arm.identify(), before.config.robot)
    if check.state == "failed":
        return check
    try:
        ModelGuard(before.cell.limits, before.certifier).judge(before.cell.arm.state())
    except Tripped as trip:
        return Check("robot.model", "failed", str(trip))
    arm = before.certifier.arm
    if arm.is_nominal:
        found = f"{check.found}: the flange agrees with a nominal {arm.name}; the kinematics of this arm are not known"
        return Check("robot.model", "warning", found, "the margins of the plan are wider")
    return replace(check, found=f"{check.found}: the flange pose agrees with the arm's own kinematics")


def check_total_payload(before: Before) -> Check:
    """Check the payload set in the controller; with a load it must be the total mass, which the arm can carry."""
    status, tool, sensor_kg = before.cell.arm.status(), before.config.tool, before.config.sensor.mass_kg
    check, load = of_arm.check_payload(status, tool, sensor_kg), before.task.load
    if load is None:
        return check
    least_kg = (tool.mass_kg or load.mass_kg) + (sensor_kg or 0.0)
    rated_kg = RATED_KG.get(before.certifier.arm.name)
    if rated_kg is not None and least_kg > rated_kg:
        found = f"sensor, tool and load weigh at least {least_kg:.2f} kg, but the arm carries {rated_kg:g} kg"
        return Check(check.name, "failed", found, "take a lighter load")
    too_little = status.payload_kg is not None and status.payload_kg < least_kg - described_cell.PAYLOAD_KG
    if check.state == "failed" or too_little:
        total = f"{least_kg:.2f} kg" if tool.mass_kg else f"the mass of sensor, tool and load, above {least_kg:.2f} kg"
        fix = f"set the payload to {total}, and its centre of mass, on the pendant before the load is hung"
        return Check(check.name, "failed", f"{check.found}, for {load}", fix)
    return check


def check_session_link(before: Before) -> Check:
    """Check the response time of the arm; a longer time is allowed if a program must request the TCP."""
    arm, limits = before.cell.arm, before.cell.limits
    asked_s = limits.link_asked_s if arm.status().tcp_offset is None else 0.0
    usual_s = limits.link_usual_s + asked_s
    return of_arm.check_link(arm, before.cell.clock, usual_s=usual_s, gap_s=limits.link_gap_s)


def _check_sensor(before: Before) -> Check:
    """Check the rate of the samples, and that all six axes show noise."""
    wrench = before.quiet.wrench
    rate = check_rate(len(wrench) / LISTEN_S, before.cell.sensor.health().nominal_rate_Hz)
    return merge_checks("sensor", [rate, check_level(wrench)])


def _check_load(before: Before) -> Check:
    """Check that the tool weight and the reading at rest are within the range of the sensor."""
    limits, config = before.sensor_range, before.config
    is_arbitrary = before.cell.sensor.identify().has_arbitrary_zero
    rest = check_rest(before.quiet.wrench, limits, config, zero_is_arbitrary=is_arbitrary)
    return merge_checks("load", [check_tool_weight(limits, config), rest])


def _check_workcell(before: Before) -> Check:
    """Check that the tool and its surroundings are described and measured; a warning of `doctor` is a failure here."""
    check = computer.check_workcell(before.config, before.certifier.arm.name)
    return check if check.state == "ok" else replace(check, state="failed")


def _check_plan(before: Before) -> Check:
    """Check that every move of the plan is proven clear for this arm, tool and scene."""
    try:
        before.plan.require(before.certifier)
    except PlanRefused as error:
        return Check("plan", "failed", str(error))
    clear = 1e3 * min(step.clearance_m for step in before.plan.steps)
    motion = "sweep" if before.plan.sweep else f"{len(before.plan.steps)} moves"
    found = f"{motion} proven clear, smallest clearance {clear:.0f} mm; joint motion only"
    return Check("plan", "ok", found)


def _check_approach(before: Before) -> Check:
    approach = before.approach
    if not approach.certified:
        return Check("approach", "failed", "the approach to the first pose is not proven clear", "jog the arm near it")
    if not len(approach.q_rad):
        return Check("approach", "ok", "the arm is at the first pose")
    nearest_mm = 1e3 * approach.clearance_m
    return Check("approach", "ok", f"moves: {len(approach.q_rad)}, proven clear, clearance {nearest_mm:.0f} mm")


def check_cable(before: Before) -> Check:
    """Check that wrist 3 stays within its window about the current angle, at which the cable is not wound up."""
    stands = before.cell.arm.state().q_rad[5]
    turns = [step.q_rad[5] for step in before.plan.steps]  # an approach turns wrist 3 no further than these angles
    low, high = min(turns), max(turns)
    now, least, most = np.degrees([stands, low, high])
    found = f"wrist 3 is at {now:.0f}° and turns between {least:.0f}° and {most:.0f}°"
    inside = low - _ROUNDED_RAD <= stands <= high + _ROUNDED_RAD
    has_been_there = (before.known or before.resumed) and inside
    if has_been_there or max(high - stands, stands - low) <= WRIST_6_RAD + _ROUNDED_RAD:
        return Check("cable", "ok", found)
    window = np.degrees(WRIST_6_RAD)
    fix = f"jog it to between {most - window:.0f}° and {least + window:.0f}°, or make a new plan at the present angle"
    return Check("cable", "failed", f"{found}, more than {window:.0f}° to one side: the cable may wind up", fix)


def _check_safety_limits(before: Before) -> Check:
    """Check that the controller accepts every pose, and before the first run of a plan also points between them."""
    nodes = np.array([step.q_rad for step in before.plan.steps])
    path = np.vstack([nodes, nodes[:1]])
    step_rad = np.inf if before.known else _EDGE_RAD
    for q_rad in (path, before.approach.q_rad):
        if len(q_rad) and (words := forbidden(before.cell.arm, q_rad, step_rad)):
            return Check("limits", "failed", words)
    return Check(
        "limits", "ok", "the controller accepts every pose" + ("" if before.known else " and the moves between")
    )


def forbidden(arm: RobotArm, q_rad: Array, step_rad: float = _EDGE_RAD) -> str:
    """Return why the controller's safety limits forbid moves through joint vectors (n, 6); "" if they allow them."""
    for q in _points_along(q_rad, step_rad):
        if not arm.within_safety_limits(q.tolist()):
            return (
                f"the controller's safety limits forbid the joint angles {np.degrees(q).round().astype(int).tolist()} "
                "degrees: bring joints 1 to 3 to another posture, or check the safety settings"
            )
    return ""


def require_no_program(arm: RobotArm, clock: Clock, limits: Limits) -> None:
    """Raise `NotAccepted` if a program keeps running on the controller; a session never stops another's program."""
    deadline_s = clock.now_s() + limits.program_ends_s
    while (program := arm.status().program) != "stopped":
        if clock.now_s() > deadline_s:
            raise NotAccepted(
                f"another program is active on the controller ({arm.reported_program() or program}): stop it on the "
                "pendant, then start again; ftdrive has changed nothing"
            )
        clock.sleep(0.02)


_APPROACH: Final = SessionCheck("approach", _check_approach)

# Checks before a session takes control of the arm.
CHECKS: Final[Sequence[SessionCheck]] = (
    SessionCheck("safety", lambda before: check_safety(before.cell.arm.status())),
    SessionCheck("remote", lambda before: check_remote(before.cell.arm)),
    SessionCheck("model", _check_model),
    SessionCheck("payload", check_total_payload),
    SessionCheck("slider", lambda before: check_speed(before.cell.arm.status())),
    SessionCheck("link", check_session_link),
    SessionCheck("sensor", _check_sensor),
    SessionCheck("load", _check_load),
    SessionCheck("workcell", _check_workcell),
    SessionCheck("plan", _check_plan),
    _APPROACH,
    SessionCheck("cable", check_cable),
    SessionCheck("disk", lambda before: computer.check_disk(before.runs)),
)

# Checks that need ftdrive's program on the controller; they follow when all others have passed.
IN_CONTROL: Final[Sequence[SessionCheck]] = (SessionCheck("limits", _check_safety_limits),)

# Checks before a stopped session goes on. Its new approach is checked later, when the goal is known.
AGAIN: Final[Sequence[SessionCheck]] = (*(row for row in CHECKS if row is not _APPROACH), *IN_CONTROL)


def _points_along(q_rad: Array, step_rad: float) -> Array:
    """Return points (m, 6) along straight moves through joint vectors (n, 6), at most `step_rad` apart."""
    parts = []
    for start, end in pairwise(q_rad):
        count = max(1, int(np.ceil(np.abs(end - start).max() / step_rad)))
        parts.append(start + np.arange(count)[:, None] / count * (end - start))
    return np.vstack([*parts, q_rad[-1:]])


def run_checks(before: Before, rows: Sequence[SessionCheck]) -> None:
    """Run preflight checks and show their results; raises `NotAccepted` if one failed."""
    found = []
    for row in rows:
        found.append(row(before))
        before.cell.journal.show(found[-1])
    if failed := [f"{result.name}: {result.words}" for result in found if not result.passed]:
        raise NotAccepted("nothing moves: " + "; ".join(failed))


@contextmanager
def awake() -> Iterator[str]:
    """Keep the computer awake during the block if systemd supports it; yield a note that says whether it does."""
    asleep = "this computer may go to sleep: disable sleep during the session"
    tool = shutil.which("systemd-inhibit") if sys.platform == "linux" else None
    if tool is None:
        yield asleep
        return
    command = [tool, "--what=sleep:idle", "--who=ftdrive", "--why=an arm moves", "--mode=block", "cat"]
    # `cat` ends when this process closes its stdin, so the inhibition cannot outlive this process.
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        # The process ends early only if systemd denies the request.
        with suppress(subprocess.TimeoutExpired):
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
