"""`ftdrive doctor`: check whether the cell is connected, quiet and permitted. Nothing moves."""

import sys
from contextlib import ExitStack, closing
from dataclasses import asdict, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.text import Text

from ftdrive.cell.devices import build_sensor
from ftdrive.cell.emulated import Station, sensor_reached
from ftdrive.checks import computer
from ftdrive.checks.arm import examine_arm
from ftdrive.checks.check import Check, check_calibration, verdict
from ftdrive.checks.computer import SensorAddress
from ftdrive.checks.sensor import PUSH_S, check_sensor_error, examine_push, examine_sensor
from ftdrive.commands.options import (
    CELL,
    JSON,
    MODEL,
    CellOptions,
    Number,
    check_simulate,
    runs_option,
    simulate,
    write_json,
)
from ftdrive.errors import NotAccepted
from ftdrive.planning.planner import guess_of_devices
from ftdrive.runs.calibration import read_calibration
from ftdrive.session.guards import Limits
from ftdrive.terminal.console import answer, indented, messages, working
from ftdrive.terminal.text import echo

# The summary shows these checks for robot, sensor and noise; for other subjects, it shows the first that passed.
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
    help="Check that this calibration.json or run folder belongs to these devices.",
)
@click.option(
    "--mass-kg", type=Number(0, min_open=True), help="Expected mass of the tool.  [default: [tool] mass_kg, else 1]"
)
@click.option("--push", is_flag=True, help="Determine the sign of the sensor: you push the tool along +X of the base.")
@runs_option("Folder of the runs; the free space of its disk is checked.")
@click.option("--all", "every", is_flag=True, help="Also print each check that passed or does not apply.")
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

    All checks of a session are made except the controller's safety limits, which can only be read with control of the
    arm. The arm is only read: nothing moves, and no program is stopped. With --sensor and no configured robot, only the
    sensor is checked. The exit code is 7 if a check fails.
    """
    check_simulate(simulate, real={"--config": described.config, "--robot": described.robot, "--model": model})
    calibration = None if path is None else read_calibration(path)
    pushed: dict[str, Any] | None = None
    with ExitStack() as stack:
        station = stack.enter_context(Station.of(None, described.sensor, ["--time-scale", "1"])) if simulate else None
        cell = replace(described, model=model).cell(sensor_alone=True) if station is None else station.cell
        address = SensorAddress.of(sensor_reached(cell.sensor.url)[0])
        device = stack.enter_context(closing(build_sensor(cell)))
        limits = Limits.of(cell.clock)
        with working("Reading the arm and its clock"):
            found, arm = examine_arm(cell, stack, usual_s=limits.link_usual_s, gap_s=limits.link_gap_s)
        permissions = computer.check_permissions(address)
        blame = partial(check_sensor_error, address=address, permissions=permissions)
        guess = guess_of_devices(cell)
        guess = replace(guess, mass_kg=mass_kg or guess.mass_kg)
        with working("Reading the sensor"):
            of_sensor, alive = examine_sensor(device, address, cell, guess, blame)
        connected = {"sensor": device.identify()} if alive else {}
        connected |= {} if arm is None else {"arm": arm.identify()}
        if cell.robot.host:
            model = cell.robot.model if arm is None else connected["arm"].model
            of_sensor.append(computer.check_workcell(cell, model))
        found += [*of_sensor, computer.check_disk(runs), *permissions]
        if calibration is not None:
            found.append(check_calibration(calibration, connected, cell.sensor.mount))
        if push:
            R_flange_sensor = None if calibration is None else calibration.R_flange_sensor
            if station is not None and calibration is None:
                R_flange_sensor = np.array(station.truth["R_flange_sensor"])
            measuring = device if alive else None
            check, pushed = examine_push(measuring, arm, R_flange_sensor, cell.sensor.sign, station, _is_pushing, blame)
            found.append(check)
    failed = [check.name for check in found if check.state == "failed"]
    if as_json:
        answer = {"schema_version": 1, "checks": [asdict(check) for check in found], "verdict": verdict(found)}
        write_json({**answer, "push": pushed} if push else answer)
    else:
        _print_checks(found, every=every)
        again = " --simulate" if simulate else ""
        if failed:
            messages.print_next(f"ftdrive doctor{again}   (after you have fixed the lines with ✘)")
        elif not cell.robot.host:
            messages.print_next("ftdrive doctor --robot HOST --sensor URL   (the whole cell)")
        else:
            messages.print_next(f"ftdrive plan{again}   (a tour proven clear)", f"ftdrive calibrate{again}")
    if failed:
        raise NotAccepted(f"{len(failed)} of {len(found)} checks failed: {', '.join(failed)}")


def _is_pushing() -> bool:
    echo(f"Push the tool along +X of the base, about 20 N; press Enter and hold for {PUSH_S:.0f} s", err=True)
    return bool(sys.stdin.readline())


def _print_checks(found: list[Check], *, every: bool) -> None:
    for subject, group in groupby(found, lambda check: check.name.partition(".")[0]):
        checks = list(group)
        for i, check in enumerate(checks if every else _attention_only(checks)):
            head = Text.assemble(f" {'' if i else subject:<12}", _MARK[check.state], " ")
            answer.print(indented(head, check.found, answer))
            if check.fix is not None and check.state in {"warning", "failed"}:
                answer.print(indented(f"{'':15}fix: ", check.fix, answer))
    words = {"ok": "All checks passed", "warning": "Usable; see the lines with !", "failed": "Not ready"}
    passed, skipped = (sum(check.state == state for check in found) for state in ("ok", "skipped"))
    count = "" if every else f" ({passed} passed, {skipped} skipped; --all shows each)"
    answer.print(f" {words[verdict(found)]}{count}.")


def _attention_only(checks: list[Check]) -> list[Check]:
    """Return one check that identifies the subject and counts the passed ones, then those that need attention."""
    passed = [check for check in checks if check.state == "ok"]
    first = [check for check in passed if check.name in _HEADLINES][:1] or passed[:1] or checks[:1]
    if first[0].state == "ok" and len(passed) > 2:
        more = f" ({len(passed) - 1} more checks passed)"
        first = [replace(first[0], found=first[0].found + more)]
    return first + [check for check in checks if check.state in {"warning", "failed"} and check not in first]
