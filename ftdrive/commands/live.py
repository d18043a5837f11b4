"""`ftdrive live`: raw and compensated wrench, ten times a second."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import click
import numpy as np
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from calib import CalibrationResult
from calib.data.dwell_mean import LEAST_SAMPLES, PoseMean, mean_and_covariance
from drivers.interfaces import Array, DeviceInfo
from ftdrive.cell.config import CellConfig
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.cell.emulated import Station, sensor_name
from ftdrive.checks.devices import AXES, belonging
from ftdrive.commands.common import (
    CELL,
    FOLDER,
    JSON,
    check_simulate,
    read_cell,
    simulate,
    stop_unless_accepted,
    write_json,
)
from ftdrive.commands.emulated_run import rehearse
from ftdrive.errors import ConfigError
from ftdrive.runs.run import Run
from ftdrive.terminal.console import talk
from ftdrive.terminal.keyboard import Keyboard

Axes = Literal["sensor", "flange", "base"]

_PERIOD_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """The mean of `_PERIOD_S`."""

    mean: PoseMean
    R_base_flange: Array
    rate_Hz: float
    lost: int


@click.command()
@click.option(
    "--calibration",
    "path",
    metavar="PATH",
    type=click.Path(exists=True, path_type=Path),
    help="A calibration.json or its run folder. With --simulate the default is a new one.",
)
@CELL
@simulate("Use the emulated cell of the calibration, or one with --sensor emulated://NAME.")
@click.option("--replay", type=FOLDER, help="Show the samples of a recorded run.")
@click.option(
    "--axes", type=click.Choice(["sensor", "flange", "base"]), default="sensor", show_default=True, help="Axes to show."
)
@click.option("--once", is_flag=True, help="Print one reading, then end.")
@JSON
def live(
    path: Path | None,
    config: Path | None,
    robot: str | None,
    sensor: str | None,
    simulate: bool,
    replay: Path | None,
    axes: Axes,
    once: bool,
    as_json: bool,
) -> None:
    """Show the raw and the compensated wrench, refreshed ten times a second.

    The compensated wrench is the contact wrench: measured minus bias and gravity. Both are about the sensor origin,
    along the chosen axes. The arm is only read, never moved. With --json, one object per line.
    """
    check_simulate(simulate, real={"--config": config, "--robot": robot, "--replay": replay})
    calibration = None if path is None else _load(path)
    with ExitStack() as stack:
        if simulate:
            calibration, cell = _emulated(calibration, sensor, stack)
        if calibration is None:
            raise ConfigError("no calibration: give --calibration PATH, or --simulate")
        if replay is not None:
            looks = _recorded_looks(Run(replay))
        else:
            if not simulate:
                cell = read_cell(config, robot, sensor)
            looks = stack.enter_context(_live_looks(cell, calibration))
        beyond = _beyond_noise(calibration)
        if once or as_json:
            for look in looks:
                reading = _reading(look, calibration, beyond, axes)
                if as_json:
                    write_json(reading)
                else:
                    click.echo(_line(reading))
                if once:
                    break
        else:
            made = "temporary calibration" if path is None else str(path)
            stack.enter_context(Keyboard(0) if Keyboard.usable(0) else nullcontext())  # Enter would break the screen
            with Live(console=talk, refresh_per_second=10) as screen:
                shown = Group()
                for look in looks:
                    shown = _screen(_reading(look, calibration, beyond, axes), made)
                    screen.update(Group(shown, "Ctrl-C ends"))
                screen.update(Group(shown, "The recording has ended."))


def _load(path: Path) -> CalibrationResult:
    return CalibrationResult.load(Run(path).calibration_path if path.is_dir() else path)


def _emulated(
    calibration: CalibrationResult | None, sensor: str | None, stack: ExitStack
) -> tuple[CalibrationResult, CellConfig]:
    """Start the cell of a calibration, or calibrate a new one with six poses."""
    if calibration is not None:
        made_by = calibration.provenance.get("station") or {}
        name = sensor_name(sensor) if sensor else made_by.get("sensor", "can")
        return calibration, stack.enter_context(Station(name, made_by.get("options", ()))).cell
    station = stack.enter_context(Station(sensor_name(sensor)))
    with TemporaryDirectory(prefix="ftdrive-") as runs:
        result = rehearse(station, Path(runs), "simulated", poses=6, kept=False).result
    stop_unless_accepted(result)
    return result, station.cell


@contextmanager
def _live_looks(cell: CellConfig, calibration: CalibrationResult) -> Iterator[Iterator[Look]]:
    with build_sensor(cell) as sensor, closing(build_arm(cell)) as arm:
        arm.open()
        _refuse_other_devices(calibration, {"arm": arm.identify(), "sensor": sensor.identify()})

        def looks() -> Iterator[Look]:
            recent = np.empty((0, 6))
            while True:
                wrench = sensor.collect(_PERIOD_S).wrench
                # One period of a slow sensor has too few samples to estimate its noise.
                recent = np.concatenate([recent, wrench])[-max(len(wrench), LEAST_SAMPLES) :]
                R_base_flange = arm.state().R_base_flange
                health = sensor.health()
                if len(recent) >= LEAST_SAMPLES:
                    yield Look(mean_and_covariance(recent), R_base_flange, health.rate_Hz, health.lost)

        yield looks()


def _recorded_looks(run: Run) -> Iterator[Look]:
    for record in run.records():
        samples = record.samples
        n = len(samples.wrench)
        rate_Hz = (n - 1) / (float(samples.t_host_ns[-1] - samples.t_host_ns[0]) * 1e-9)
        lost = int(np.ptp(samples.seq)) + 1 - n
        size = max(LEAST_SAMPLES, round(rate_Hz * _PERIOD_S))
        for start in range(0, n - size + 1, size):
            mean = mean_and_covariance(samples.wrench[start : start + size])
            yield Look(mean, record.before.R_base_flange, rate_Hz, lost)
            time.sleep(size / rate_Hz)  # at the speed of the recording


def _refuse_other_devices(calibration: CalibrationResult, found: dict[str, DeviceInfo]) -> None:
    belongs = belonging(calibration, found)
    if belongs.others:
        raise ConfigError(f"{belongs.others[0]}: calibrate this cell")
    for words in belongs.unknown:
        talk.print(f" {words}")


def _beyond_noise(calibration: CalibrationResult) -> Array:
    """Return the variance (6,) beyond the predicted one, as in the report, spread over all axes."""
    total = calibration.likely_error() ** 2 - np.square(calibration.predicted_error())
    return np.repeat(total / 3, 3)


def _reading(look: Look, calibration: CalibrationResult, beyond: Array, axes: Axes) -> dict[str, Any]:
    raw = look.mean.mean
    contact = calibration.compensate(raw, look.R_base_flange)
    covariance = look.mean.covariance + calibration.wrench_covariance(look.R_base_flange) + np.diag(beyond)
    R_axes_sensor = {
        "sensor": np.eye(3),
        "flange": calibration.R_flange_sensor,
        "base": look.R_base_flange @ calibration.R_flange_sensor,
    }[axes]
    turn = np.kron(np.eye(2), R_axes_sensor)
    raw, contact, covariance = turn @ raw, turn @ contact, turn @ covariance @ turn.T
    sigma = np.sqrt(np.diag(covariance))
    return {
        "schema_version": 1,
        "axes": axes,
        "about": "sensor origin",
        "raw": {"force_N": raw[:3].tolist(), "torque_Nm": raw[3:].tolist()},
        "compensated": {"force_N": contact[:3].tolist(), "torque_Nm": contact[3:].tolist()},
        "sigma": {"force_N": sigma[:3].tolist(), "torque_Nm": sigma[3:].tolist()},
        "rate_Hz": look.rate_Hz,
        "lost": look.lost,
        "calibration": calibration.provenance.get("created_utc"),
        "verdict": calibration.verdict,
    }


def _line(reading: dict[str, Any]) -> str:
    contact = reading["compensated"]
    force, torque = (
        " ".join(f"{value:9.{n}f}" for value in contact[key]) for key, n in (("force_N", 3), ("torque_Nm", 5))
    )
    return f"F {force} N   T {torque} N·m   ({reading['axes']} axes, about the {reading['about']})"


def _screen(reading: dict[str, Any], made: str) -> Group:
    table = Table(box=None)
    for title, width in (("", 2), ("raw", 9), ("contact", 13), ("± 1 sigma", 9), ("", 20)):
        table.add_column(title, justify="right", min_width=width, no_wrap=True)  # else they move with every sign
    columns = [np.r_[reading[key]["force_N"], reading[key]["torque_Nm"]] for key in ("raw", "compensated", "sigma")]
    for i, name in enumerate(AXES):
        raw, contact, sigma = (column[i] for column in columns)
        unit, full, digits = ("N", 20.0, 3) if i < 3 else ("N·m", 2.0, 5)
        filled = min(20, round(20 * abs(contact) / full))
        bar = Text.assemble(("█" * filled, "red" if contact < 0 else "green"), "·" * (20 - filled))
        table.add_row(name, f"{raw:.{digits}f}", f"{contact:.{digits}f} {unit}", f"{sigma:.{digits}f}", bar)
    return Group(
        Text.assemble(
            (f"{reading['axes']} axes, about the {reading['about']}", "bold"),
            "   contact: raw minus bias and gravity",
        ),
        f"{made}, {reading['verdict']}   mean of {_PERIOD_S} s   {reading['rate_Hz']:.0f} Hz, lost {reading['lost']}",
        table,
    )
