"""`ftdrive verify`: fresh poses against the prediction of a calibration."""

from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Literal

import click

from ftcalib.rounding import to_place_of
from ftdrive.commands.common import (
    CALIBRATION,
    CELL,
    FOLDER,
    YES,
    CellOptions,
    Number,
    ViewOptions,
    check_simulate,
    declined_aborts,
    index_run,
    on_page,
    rehearse,
    runs,
    simulate,
    start_mover,
    stop_unless_accepted,
    view_options,
    write_json,
)
from ftdrive.errors import ConfigError, Declined, NotAccepted
from ftdrive.runs.verification import AcceptanceLimits, Verified, save_update, verify_run

if TYPE_CHECKING:
    from ftdrive.cell.config import CellConfig
    from ftdrive.cell.emulated import Station
    from ftdrive.runs.run import Mode
    from ftdrive.session.options import SessionOptions
    from ftdrive.view.page import Page

Answer = Literal["ask", "no", "yes"]


@click.command()
@CALIBRATION
@CELL
@simulate(
    "Use the emulated cell of the calibration, or calibrate one first; --sensor emulated://NAME chooses its sensor."
)
@click.option("--quick", is_flag=True, help="2 poses instead of 6, at the plan's speeds after one complete slow run.")
@click.option("--poses", type=click.IntRange(2, 500), help="Number of poses.")
@click.option(
    "--max-force",
    "force_N",
    type=Number(0, min_open=True),
    metavar="N",
    help="Largest accepted difference of the force, N.",
)
@click.option(
    "--max-torque",
    "torque_Nm",
    type=Number(0, min_open=True),
    metavar="N·m",
    help="Largest accepted difference of the torque, N·m.",
)
@click.option("--manual", is_flag=True, help="No motion commands: you move the arm.")
@click.option(
    "--update",
    type=click.Choice(["ask", "no", "yes"]),
    default="ask",
    show_default=True,
    help="Whether to save the smallest sufficient update as a new calibration if something has changed.",
)
@click.option("--resume", type=FOLDER, help="Continue an interrupted verification in its mode.")
@view_options
@YES
@runs()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per line: events, questions, the result.")
def verify(
    path: Path | None,
    described: CellOptions,
    simulate: bool,
    quick: bool,
    poses: int | None,
    force_N: float | None,
    torque_Nm: float | None,
    manual: bool,
    update: Answer,
    resume: Path | None,
    yes: bool,
    runs: Path,
    view: ViewOptions,
    as_json: bool,
) -> None:
    """Compare fresh poses, far from those of the calibration, with its prediction.

    The session is that of `calibrate`: a certified plan, checks, safety questions, guards. Without --max-force and
    --max-torque, 1 of 100 verifications near the poses of the fit is a false alarm, more far from them. A
    verification that fails names what has changed, offers the smallest sufficient update, and ends with exit code 7.
    """
    from ftdrive.session.options import SessionOptions

    check_simulate(simulate, real={"--config": described.config, "--robot": described.robot})
    mode: Mode = "manual" if manual else "auto"
    options = SessionOptions(runs, "verify", mode=mode, fast=quick, resume=resume, real=not simulate, yes=yes)
    path, limits, options = _with_poses(options, path, poses, AcceptanceLimits(force_N, torque_Nm))
    with ExitStack() as stack:
        page = stack.enter_context(view.page("ftdrive verify"))
        station = None
        if simulate:
            station, path = _emulated(stack, path, described.sensor, runs)
        elif path is None:
            raise ConfigError("no calibration: give --calibration PATH, or --simulate")
        cell = described.cell() if station is None else station.cell
        with declined_aborts():
            verified = verify_cell(cell, path, limits, options, station, page, update=update, as_json=as_json)
    if not verified.passed:
        raise NotAccepted(f"the verification failed: {failure_in_words(verified)}")


def verify_cell(
    cell: "CellConfig",
    path: Path,
    limits: AcceptanceLimits,
    options: "SessionOptions",
    station: "Station | None" = None,
    page: "Page | None" = None,
    *,
    update: Answer = "ask",
    as_json: bool = False,
) -> Verified:
    """Guide the operator through the poses, compare them with a calibration, report, and add the run to the store.

    `path` is the calibration file or its run folder, `station` the emulated cell that `cell` describes, `page` shows
    the session. A verification is quick if `options` are fast. Raises as `ftdrive.session.session.take_poses`.
    """
    from ftdrive.runs.run import Run
    from ftdrive.runs.source import read_calibration
    from ftdrive.session.session import take_poses
    from ftdrive.session.verifying import Verifying
    from ftdrive.terminal.screen import open_operator

    calibration = read_calibration(path)
    path = Run(path).calibration_path if path.is_dir() else path
    # The run keeps what is verified and how, so that --resume continues alike.
    kept = {"path": str(path.absolute()), "poses": options.poses, "quick": options.fast, "limits": asdict(limits)}
    description: dict[str, Any] = {"verification": {**kept, "id": calibration.id}}
    # 12 s of noise would take longer than the poses.
    if options.fast:
        cell = replace(cell, sampling=replace(cell.sampling, noise_record_s=0.0))
    if station is not None:
        description |= station.description
        start_mover(station, options)
    task = Verifying(cell, calibration, path, options.poses, options.runs)
    options = replace(options, description=description)
    with (
        open_operator(as_json=as_json, command=task.command) as operator,
        on_page(page, operator, options, task.command) as (shown, options),
    ):
        run = take_poses(task, shown, options)
        if run is None:
            raise RuntimeError("a verification is never a dry run")
        verified = verify_run(run, calibration, path, limits)
    _report(verified, update, page, simulated=station is not None, as_json=as_json)
    index_run(run.folder, cell if station is None else None)
    return verified


def failure_in_words(verified: Verified) -> str:
    """Return why a verification failed."""
    return "; ".join(verified.exceeded if verified.limits.given else (verified.verification.reason,))


def _with_poses(
    options: "SessionOptions", path: Path | None, poses: int | None, limits: AcceptanceLimits
) -> tuple[Path | None, AcceptanceLimits, "SessionOptions"]:
    """Return what is verified and how: as given, or as the run that is resumed was begun."""
    from ftdrive.runs.run import Run
    from ftdrive.session.verifying import POSES, QUICK_POSES

    quick, resume = options.fast, options.resume
    if quick and poses is not None:
        raise ConfigError("--quick and --poses exclude one another: leave one of them out")
    if resume is None:
        return path, limits, replace(options, poses=poses or (QUICK_POSES if quick else POSES))
    given = {"--calibration": path, "--quick": quick, "--poses": poses, "--max-force or --max-torque": limits.given}
    if wrong := [option for option, value in given.items() if value]:
        raise ConfigError(f"--resume continues with the options of its run: leave out {' and '.join(wrong)}")
    run = Run(resume)
    if run.command != "verify":
        raise ConfigError(f"{resume} is not a verification: continue it with {run.resume_command}")
    begun = run.header()["verification"]
    options = replace(options, poses=begun["poses"], fast=begun["quick"])
    return Path(begun["path"]), AcceptanceLimits(**begun["limits"]), options


def _report(verified: Verified, update: Answer, page: "Page | None", *, simulated: bool, as_json: bool) -> None:
    """Print the outcome and what to do next, and show both on the page; save the update if it is wanted."""
    from ftdrive.terminal.console import answer, messages
    from ftdrive.terminal.report import print_verification

    if not as_json:
        print_verification(verified)
    if page is not None:
        _conclude(page, verified)
    saved = save_update(verified) if _wants_update(verified, update, page, as_json=as_json) else None
    again = " --simulate" if simulated else ""
    if saved is not None:
        following = f"ftdrive live --calibration {quote(str(saved))}{again}"
    elif verified.passed:
        following = "ftdrive history   (age and trends of all calibrations)"
    else:
        following = f"ftdrive calibrate{again}   (the calibration does not hold any more)"
    if page is not None:
        _conclude(page, verified, following)
    if as_json:
        write_json({**verified.to_dict(), "file": str(verified.path), "saved": None if saved is None else str(saved)})
        return
    if saved is not None:
        answer.print(f" Saved {saved}: {_updated(verified)} updated, parent {verified.calibration.id[:6]}")
    messages.print_next(following)


def _conclude(page: "Page", verified: Verified, *following: str) -> None:
    import numpy as np

    from ftdrive.terminal.report import verdict_in_words
    from ftdrive.view.parts import BAD, GOOD, number
    from ftdrive.view.session_page import conclude

    found, figures = verified.verification, []
    for name, unit, axes in (("force", "N", slice(3)), ("torque", "N·m", slice(3, 6))):
        sizes = np.linalg.norm(found.residual[:, axes], axis=1)
        sigma = float(np.linalg.norm(found.predicted_sigma[sizes.argmax(), axes]))
        value = to_place_of(sizes.max(), sigma)
        figures.append(
            number(f"largest difference, {name}", value, unit, sigma=f"± {to_place_of(sigma, sigma)} (1 sigma)")
        )
    head, tone = ("PASS", GOOD) if verified.passed else ("FAILED", BAD)
    words = verdict_in_words(verified), "" if found.passed else found.reason
    conclude(page, head, *words, tone=tone, figures=figures, following=following)


def _emulated(stack: ExitStack, path: Path | None, sensor: str | None, runs: Path) -> tuple["Station", Path]:
    """Start the cell of a calibration, or calibrate a new one; return it with the path of its calibration."""
    from ftdrive.cell.emulated import Station
    from ftdrive.runs.source import read_calibration

    made_by = None if path is None else read_calibration(path).provenance.get("station")
    station = stack.enter_context(Station.of(made_by, sensor))
    if path is None:
        outcome = rehearse(station, runs, "simulated", poses=6)
        stop_unless_accepted(outcome.result, to_be_saved=True)
        path = outcome.run.calibration_path
    return station, path


def _wants_update(verified: Verified, update: Answer, page: "Page | None" = None, *, as_json: bool) -> bool:
    from ftdrive.session.events import Question
    from ftdrive.terminal.console import messages
    from ftdrive.terminal.operators import JsonOperator, PlainOperator
    from ftdrive.view.session_page import asked

    if verified.passed or verified.update is None or update == "no":
        return False
    if update == "yes":
        return True
    operator = JsonOperator() if as_json else PlainOperator(quiet=messages.quiet)
    question = Question(f"An update of {_updated(verified)} is sufficient. Save it as a new calibration?")
    if page is not None:
        page.put({"question": asked(question)})
    try:
        return operator.ask(question) == "yes"
    except Declined:
        return False
    finally:
        if page is not None:
            page.put({"question": None})


def _updated(verified: Verified) -> str:
    return "all values" if verified.update_name == "all" else f"the {verified.update_name}"
