"""`ftdrive doctor`: is the cell connected, quiet and permitted? Nothing moves."""

import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.text import Text

from ftcalib.poses.information import Guess
from ftdrive.cell.config import CellConfig
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.cell.emulated import Station, sensor_reached
from ftdrive.checks import computer
from ftdrive.checks.arm import (
    check_arm,
    check_clock,
    check_diagnosis,
    check_kinematics,
    check_link,
    check_payload,
    check_program,
    check_remote,
    check_safety,
    check_speed,
    check_unreachable,
)
from ftdrive.checks.check import Check, check_calibration, verdict
from ftdrive.checks.computer import SensorAddress
from ftdrive.checks.sensor import (
    check_compensated,
    check_identity,
    check_load,
    check_noise,
    check_push,
    check_rest,
    check_sensor_error,
    check_stream,
)
from ftdrive.commands.common import CELL, JSON, MODEL, CellOptions, Number, check_simulate, runs, simulate, write_json
from ftdrive.errors import NotAccepted
from ftdrive.planning.planner import guess_of_devices
from ftdrive.runs.source import read_calibration
from ftdrive.session.guards import Limits
from ftdrive.terminal.console import answer, hanging, messages, working
from ftdrive.terminal.text import echo
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError
from ftdrivers.interfaces import ArmStatus, Array, ForceTorqueSensor, RobotArm

# From the name of a check and the error of a sensor's driver.
Blame = Callable[[str, DeviceError], Check]

_CLOCK_S = 1.0
_LOOK_S = 2.0
_PUSH_S = 3.0
_PUSH_WINDOW_S = 0.2
_SIMULATED_PUSH_N, _SIMULATED_PUSH_S = 15.0, 0.6
# What a summary shows of the checks of robot, sensor and noise; of the others the first that passed.
_HEADLINES = ("robot.identity", "sensor.identity", "noise.accuracy")
_MARK = {"ok": ("✔", "green"), "warning": ("!", "yellow"), "failed": ("✘", "red"), "skipped": ("-", "")}


@click.command()
@CELL
@MODEL
@simulate()
@click.option(
    "--calibration",
    "path",
    metavar="PATH",
    type=click.Path(exists=True, path_type=Path),
    help="Check that this calibration.json or run folder is of these devices.",
)
@click.option(
    "--mass-kg", type=Number(0, min_open=True), help="Expected mass of the tool.  [default: [tool] mass_kg, else 1]"
)
@click.option("--push", is_flag=True, help="Find the sign of the sensor: you push the tool along +X of the base.")
@runs("Folder of the runs, whose disk is checked.")
@click.option("--all", "every", is_flag=True, help="Print the checks that passed or do not apply too, a line each.")
@JSON
def doctor(
    described: CellOptions,
    model: str | None,
    simulate: bool,
    path: Path | None,
    mass_kg: float | None,
    push: bool,
    runs: Path,
    every: bool,
    as_json: bool,
) -> None:
    """Check robot, sensor, noise, clocks, disk and permissions; print a fix for each finding.

    Runs every check except the controller's safety limits, which can only be queried with control. The arm is only
    read, nothing moves, no program is touched. With --sensor alone, and no robot in the configuration, checks the
    sensor and skips the robot. Exit code 7 if a check fails.
    """
    check_simulate(simulate, real={"--config": described.config, "--robot": described.robot, "--model": model})
    calibration = None if path is None else read_calibration(path)
    pushed: dict[str, Any] | None = None
    with ExitStack() as stack:
        station = stack.enter_context(Station.of(None, described.sensor, ["--time-scale", "1"])) if simulate else None
        cell = replace(described, model=model).cell(sensor_alone=True) if station is None else station.cell
        address = SensorAddress.of(sensor_reached(cell.sensor.url)[0])
        device = build_sensor(cell)

        with working("Reading the arm and its clock"):
            found, arm = _examine_robot(cell, stack)
        permissions = computer.check_permissions(address)
        blame = partial(check_sensor_error, address=address, permissions=permissions)
        guess = guess_of_devices(cell)
        guess = replace(guess, mass_kg=mass_kg or guess.mass_kg)
        with working("Reading the sensor"):
            of_sensor, alive = _examine_sensor(device, address, cell, guess, blame, stack)
        model = cell.robot.model if arm is None else arm.identify().model
        workcell = [computer.check_workcell(cell, model)] if cell.robot.host else []
        found += [*of_sensor, *workcell, computer.check_disk(runs), *permissions]
        if calibration is not None:
            connected = {"sensor": device.identify()} if alive else {}
            if arm is not None:
                connected["arm"] = arm.identify()
            found.append(check_calibration(calibration, connected, cell.sensor.mount))
        if push:
            R_flange_sensor = None if calibration is None else calibration.R_flange_sensor
            if station is not None and calibration is None:
                R_flange_sensor = np.array(station.truth["R_flange_sensor"])
            check, pushed = _examine_push(
                device if alive else None, arm, R_flange_sensor, cell.sensor.sign, station, blame
            )
            found.append(check)
    failed = [check.name for check in found if check.state == "failed"]
    if as_json:
        answer = {"schema_version": 1, "checks": [asdict(check) for check in found], "verdict": verdict(found)}
        write_json({**answer, "push": pushed} if push else answer)
    else:
        _print(found, every=every)
        again = " --simulate" if simulate else ""
        if failed:
            messages.print_next(f"ftdrive doctor{again}   (when what is marked ✘ is fixed)")
        elif not cell.robot.host:
            messages.print_next("ftdrive doctor --robot HOST --sensor URL   (the whole cell)")
        else:
            messages.print_next(f"ftdrive plan{again}   (a tour proven clear)", f"ftdrive calibrate{again}")
    if failed:
        raise NotAccepted(f"{len(failed)} of {len(found)} checks failed: {', '.join(failed)}")


def _examine_robot(cell: CellConfig, stack: ExitStack) -> tuple[list[Check], RobotArm | None]:
    if not cell.robot.host:
        found = "the sensor is checked alone, because [robot] host and --robot are not set"
        return [Check("robot.reachable", "skipped", found)], None
    host, arm = cell.robot.host, build_arm(cell)
    stack.callback(arm.close)
    try:
        arm.open()
        info, status = arm.identify(), arm.status()
    except DeviceError as error:
        return [check_unreachable(error, host)], None
    return [
        Check("robot.reachable", "ok", f"{host} answers"),
        check_arm(info, cell.robot),
        check_kinematics(info),
        check_remote(arm),
        *map(check_diagnosis, arm.diagnose()),
        check_safety(status),
        check_program(status),
        check_speed(status),
        check_payload(status, cell.tool, cell.sensor.mass_kg),
        *_check_poses(arm, status, cell.clock),
        _check_clock(arm, cell.clock),
    ], arm


def _check_poses(arm: RobotArm, status: ArmStatus, clock: Clock) -> list[Check]:
    name = "robot.flange"
    if status.tcp_offset is None:
        found = "the controller does not report its TCP offset: only a calibration, which takes control, can read poses"
        return [Check(name, "skipped", found)]
    try:
        p_mm = 1e3 * arm.state().p_base_flange_m
    except DeviceError as error:
        return [Check(name, "failed", error.found, error.fix or "check the robot and the network")]
    where = ", ".join(f"{value:.0f}" for value in p_mm)
    limits = Limits.of(clock)
    return [
        Check(name, "ok", f"TCP offset read; flange at ({where}) mm in base"),
        check_link(arm, clock, usual_s=limits.link_usual_s, gap_s=limits.link_gap_s),
    ]


def _check_clock(arm: RobotArm, clock: Clock) -> Check:
    host_ns: list[int] = []
    device_s: list[float] = []
    try:
        with clock.keeping_up():
            while not host_ns or host_ns[-1] - host_ns[0] < _CLOCK_S * 1e9:
                clock.sleep(0.02)
                status = arm.status()
                host_ns.append(status.t_host_ns)
                device_s.append(status.t_device_s)
    except DeviceError as error:
        return Check("clock.pace", "failed", error.found, error.fix or "check the robot and the network")
    return check_clock(host_ns, device_s)


def _examine_sensor(
    device: ForceTorqueSensor, address: SensorAddress, cell: CellConfig, guess: Guess, blame: Blame, stack: ExitStack
) -> tuple[list[Check], bool]:
    found: list[Check] = []
    name = "sensor.identity"
    try:
        stack.enter_context(device)
        info = device.identify()
        found += check_identity(info)
        name = "sensor.stream"
        found += [check_diagnosis(one, "sensor") for one in device.diagnose()]
        samples = device.collect(_LOOK_S)
        health = device.health()
    except DeviceError as error:
        return [*found, blame(name, error)], False
    fact = info.facts.get("range")
    limits = None if fact is None else np.asarray(fact.value, dtype=np.float64)
    return [
        *found,
        check_load(limits, cell),
        check_rest(samples.wrench, limits, cell, zero_is_arbitrary=info.has_arbitrary_zero),
        *([check_compensated(samples.wrench, cell)] if address.scheme == "ros2" else []),
        *check_stream(samples, health, address, _LOOK_S),
        *check_noise(samples.wrench, _LOOK_S, cell.sampling.average_s, guess),
    ], True


def _examine_push(
    device: ForceTorqueSensor | None,
    arm: RobotArm | None,
    R_flange_sensor: Array | None,
    sign: int,
    station: Station | None,
    blame: Blame,
) -> tuple[Check, dict[str, Any] | None]:
    if device is None:
        return Check("push.sign", "skipped", "the sensor does not measure"), None
    try:
        R_base_flange = None if arm is None else arm.state().R_base_flange
    except DeviceError:
        R_base_flange = None  # robot.flange reports it
    try:
        before = device.collect(1.0).wrench[:, :3].mean(axis=0)
        with ExitStack() as stack:
            if station is None:
                words = f"Push the tool along +X of the base, about 20 N; press Enter and hold for {_PUSH_S:.0f} s"
                echo(words, err=True)
                if not sys.stdin.readline():
                    return Check("push.sign", "skipped", "no push: the standard input is closed"), None
            elif R_base_flange is not None and R_flange_sensor is not None:
                force = (R_base_flange @ R_flange_sensor).T @ [_SIMULATED_PUSH_N, 0.0, 0.0]
                station.control(do="push", wrench=[*force.tolist(), 0.0, 0.0, 0.0])
                stack.callback(station.control, do="push", wrench=[0.0] * 6)
            windows = round((_PUSH_S if station is None else _SIMULATED_PUSH_S) / _PUSH_WINDOW_S)
            pieces = (device.collect(_PUSH_WINDOW_S).wrench[:, :3] for _ in range(windows))
            changes = [force_N.mean(axis=0) - before for force_N in pieces]
    except DeviceError as error:
        return blame("push.sign", error), None
    largest = max(changes, key=lambda change: float(np.linalg.norm(change)))
    return check_push(largest, R_base_flange, R_flange_sensor, sign)


def _print(found: list[Check], *, every: bool) -> None:
    for subject, group in groupby(found, lambda check: check.name.partition(".")[0]):
        checks = list(group)
        for i, check in enumerate(checks if every else _in_brief(checks)):
            head = Text.assemble(f" {'' if i else subject:<12}", _MARK[check.state], " ")
            answer.print(hanging(head, check.found, answer))
            if check.fix is not None and check.state in {"warning", "failed"}:
                answer.print(hanging(f"{'':15}fix: ", check.fix, answer))
    words = {"ok": "All checks passed", "warning": "Usable; see the lines with !", "failed": "Not ready"}
    passed, skipped = (sum(check.state == state for check in found) for state in ("ok", "skipped"))
    count = "" if every else f" ({passed} passed, {skipped} skipped; --all shows each)"
    answer.print(f" {words[verdict(found)]}{count}.")


def _in_brief(checks: list[Check]) -> list[Check]:
    """Return what needs attention, behind the one check that names the subject, with the number of the others."""
    passed = [check for check in checks if check.state == "ok"]
    first = [check for check in passed if check.name in _HEADLINES][:1] or passed[:1] or checks[:1]
    if first[0].state == "ok" and len(passed) > 2:
        more = f" ({len(passed) - 1} more checks passed)"
        first = [replace(first[0], found=first[0].found + more)]
    return first + [check for check in checks if check.state in {"warning", "failed"} and check not in first]
