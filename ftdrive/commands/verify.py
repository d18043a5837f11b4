"""`ftdrive verify`: fresh poses against the prediction of a calibration."""

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from ftdrive.commands.common import CELL, FOLDER, Number, check_simulate, runs, simulate, write_json

if TYPE_CHECKING:
    from ftdrive.cell.config import CellConfig
    from ftdrive.runs.verified import Verified

_QUESTION = "Save it as a new calibration"


@click.command()
@click.option(
    "--calibration",
    "path",
    metavar="PATH",
    type=click.Path(exists=True, path_type=Path),
    help="A calibration.json or its run folder. With --simulate the default is a new one.",
)
@CELL
@simulate(
    "Use the emulated cell of the calibration, or calibrate one first; --sensor emulated://NAME chooses its sensor."
)
@click.option("--quick", is_flag=True, help="2 poses instead of 6, at the plan's speeds after one complete slow run.")
@click.option("--poses", type=click.IntRange(2, 24), help="Number of poses.")
@click.option("--max-force", "force_N", type=Number(0, min_open=True), metavar="N", help="Largest difference, N.")
@click.option(
    "--max-torque", "torque_Nm", type=Number(0, min_open=True), metavar="N·m", help="Largest difference, N·m."
)
@click.option("--manual", is_flag=True, help="No motion commands: you move the arm.")
@click.option(
    "--update",
    type=click.Choice(["ask", "no", "yes"]),
    default="ask",
    show_default=True,
    help="If something has changed: whether to save the smallest sufficient update as a new calibration.",
)
@click.option("--resume", type=FOLDER, help="Continue an interrupted verification in its mode.")
@click.option(
    "--yes",
    is_flag=True,
    help="Answer the safety questions automatically; never a first run, nor a move of the whole arm.",
)
@runs()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per line: events, questions, the result.")
def verify(
    path: Path | None,
    config: Path | None,
    robot: str | None,
    sensor: str | None,
    simulate: bool,
    quick: bool,
    poses: int | None,
    force_N: float | None,
    torque_Nm: float | None,
    manual: bool,
    update: Literal["ask", "no", "yes"],
    resume: Path | None,
    yes: bool,
    runs: Path,
    as_json: bool,
) -> None:
    """Compare fresh poses, far from those of the calibration, with its prediction.

    The session is that of `calibrate`: a certified plan, checks, safety questions, guards. Without --max-force and
    --max-torque, 1 % of unchanged cells fail. If it fails, it names what has changed, offers the smallest sufficient
    update, and ends with exit code 7.
    """
    from ftdrive.errors import ConfigError, Declined, NotAccepted
    from ftdrive.live.stream import load_calibration
    from ftdrive.runs.run import Run
    from ftdrive.runs.verified import AcceptanceLimits, save_update, verify_run
    from ftdrive.session.session import Options, take_poses
    from ftdrive.session.verification import POSES, QUICK_POSES, Verifying
    from ftdrive.terminal.console import talk
    from ftdrive.terminal.screen import open_operator
    from ftdrive.terminal.verification_text import print_verification

    check_simulate(simulate, real={"--config": config, "--robot": robot})
    if quick and poses is not None:
        raise ConfigError("--quick and --poses exclude one another: leave one of them out")
    limits = AcceptanceLimits(force_N, torque_Nm)
    if resume is not None:
        if given := [name for name, value in _of_a_new_one(path, quick, poses, limits).items() if value]:
            raise ConfigError(f"--resume continues with the options of its run: leave out {' and '.join(given)}")
        begun = _begun(resume)
        path, poses, quick = Path(begun["path"]), begun["poses"], begun["quick"]
        limits = AcceptanceLimits(**begun["limits"])
    wanted = poses or (QUICK_POSES if quick else POSES)
    with ExitStack() as stack:
        cell, path, description = _cell(stack, path, config, robot, sensor, runs, simulate=simulate)
        calibration = load_calibration(path)
        if path.is_dir():
            path = Run(path).calibration_path
        description["verification"] = {
            "id": calibration.id,
            "path": str(path.absolute()),
            "poses": wanted,
            "quick": quick,
            "limits": asdict(limits),
        }
        options = Options(
            runs,
            "verify",
            poses=wanted,
            mode="manual" if manual else "auto",
            fast=quick,
            resume=resume,
            real=not simulate,
            yes=yes,
            description=description,
        )
        task = Verifying(calibration, path, wanted, runs)
        try:
            with open_operator(as_json=as_json, command="verify") as operator:
                run = take_poses(cell, operator, options, task)
        except Declined as error:
            talk.print(str(error))
            raise click.Abort from error
    if run is None:
        raise RuntimeError("a verification is never a dry run")
    verified = verify_run(run, calibration, path, limits)
    if not as_json:
        print_verification(verified)
    saved = save_update(verified) if _wants_update(verified, update, as_json=as_json) else None
    if as_json:
        write_json({**verified.to_dict(), "file": str(verified.path), "saved": None if saved is None else str(saved)})
    elif saved is not None:
        talk.print(f" Saved {saved}: {verified.update_name} updated, parent {calibration.id[:6]}")
    if not verified.passed:
        raise NotAccepted(_failure(verified))


def _of_a_new_one(path: Path | None, quick: bool, poses: int | None, limits: Any) -> dict[str, Any]:
    return {
        "--calibration": path,
        "--quick": quick,
        "--poses": poses,
        "--max-force": limits.force_N,
        "--max-torque": limits.torque_Nm,
    }


def _begun(folder: Path) -> dict[str, Any]:
    """Return what a verification was started with."""
    from ftdrive.errors import ConfigError
    from ftdrive.runs.run import Run

    run = Run(folder)
    header = run.header()
    if header.get("command") != "verify":
        raise ConfigError(f"{folder} is not a verification: continue it with {run.resume_command}")
    return dict(header["verification"])


def _cell(
    stack: ExitStack,
    path: Path | None,
    config: Path | None,
    robot: str | None,
    sensor: str | None,
    runs: Path,
    *,
    simulate: bool,
) -> tuple["CellConfig", Path, dict[str, Any]]:
    """Return the cell, the calibration's path and the description of an emulated cell, which is calibrated first."""
    from ftdrive.cell.emulated import Station, sensor_name
    from ftdrive.commands.common import read_cell, stop_unless_accepted
    from ftdrive.commands.emulated_run import described, rehearse
    from ftdrive.errors import ConfigError
    from ftdrive.live.stream import load_calibration

    if not simulate:
        if path is None:
            raise ConfigError("no calibration: give --calibration PATH, or --simulate")
        return read_cell(config, robot, sensor), path, {}
    made_by = {} if path is None else load_calibration(path).provenance.get("station") or {}
    name = sensor_name(sensor) if sensor else made_by.get("sensor", sensor_name(None))
    station = stack.enter_context(Station(name, made_by.get("options", ())))
    if path is None:
        outcome = rehearse(station, runs, "simulated", poses=12)
        stop_unless_accepted(outcome.result, to_be_saved=True)
        path = outcome.run.calibration_path
    return station.cell, path, described(station)


def _wants_update(verified: "Verified", update: Literal["ask", "no", "yes"], *, as_json: bool) -> bool:
    """Whether to save the update; nobody who answers means no."""
    from ftdrive.errors import Declined
    from ftdrive.session.operator import Question
    from ftdrive.terminal.console import talk
    from ftdrive.terminal.operators import JsonOperator, PlainOperator

    if verified.passed or verified.update is None or update == "no":
        return False
    if update == "yes":
        return True
    operator = JsonOperator() if as_json else PlainOperator(quiet=talk.quiet)
    text = f"An update of the {verified.update_name} is sufficient. {_QUESTION}?"
    try:
        return operator.ask(Question(text)) == "yes"
    except Declined:
        return False


def _failure(verified: "Verified") -> str:
    words = "; ".join(verified.exceeded) if verified.limits.given else verified.verification.reason
    return f"the verification failed: {words}"
