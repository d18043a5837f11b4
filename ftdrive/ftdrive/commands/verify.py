"""`ftdrive verify`: compare fresh poses with the prediction of a calibration."""

from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import click

from ftdrive.cell.emulated import Station
from ftdrive.commands.options import (
    CALIBRATION,
    CELL,
    FOLDER,
    JSON_LINES,
    POSITIVE,
    YES,
    CellOptions,
    ViewOptions,
    check_simulate,
    declined_aborts,
    runs_option,
    simulate,
    view_options,
    write_json,
)
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.runs.calibration import read_calibration, require_accepted
from ftdrive.runs.run import Mode
from ftdrive.runs.verification import Verified
from ftdrive.session.events import Question
from ftdrive.session.open_session import SessionOptions
from ftdrive.session.rehearsal import rehearse
from ftdrive.session.verifying import Answer, Verifying, save_wanted_update
from ftdrive.store import index_run
from ftdrive.terminal.console import answer, messages
from ftdrive.terminal.operators import JsonOperator, PlainOperator
from ftdrive.terminal.report import print_verification
from ftdrive.terminal.screen import open_operator
from ftdrive.view.outcome import conclude_verification, on_page
from ftdrive.view.page import Page
from ftdrive.view.session_page import question_part


@click.command()
@CALIBRATION
@CELL
@simulate(
    "Use the emulated cell of the calibration, or calibrate one first; --sensor emulated://NAME selects its sensor."
)
@click.option("--quick", is_flag=True, help="Take 2 poses instead of 6, at the speed of the plan after one slow run.")
@click.option("--poses", type=click.IntRange(2, 500), help="Number of poses.")
@click.option("--max-force", "force_N", type=POSITIVE, metavar="N", help="Largest accepted difference of the force, N.")
@click.option(
    "--max-torque", "torque_Nm", type=POSITIVE, metavar="N·m", help="Largest accepted difference of the torque, N·m."
)
@click.option("--manual", is_flag=True, help="No motion commands: you move the arm to the poses.")
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
@runs_option()
@JSON_LINES
def verify_command(
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

    The session is like that of `calibrate`: a certified plan, checks, safety questions and guards. Without --max-force
    and --max-torque, 1 of 100 verifications near the calibrated poses is a false alarm; farther away, more are.
    A failed verification names what has changed, offers the smallest sufficient update, and ends with exit code 7.
    """
    check_simulate(simulate, real={"--config": described.config, "--robot": described.robot})
    mode: Mode = "manual" if manual else "auto"
    options = SessionOptions(runs, "verify", mode=mode, fast=quick, resume=resume, real=not simulate, yes=yes)
    path, limits, options = Verifying.chosen(options, path, poses, (force_N, torque_Nm))
    with ExitStack() as stack:
        page = stack.enter_context(view.page("ftdrive verify"))
        station = None
        if simulate:
            made_by = None if path is None else read_calibration(path).provenance.get("station")
            station = stack.enter_context(Station.of(made_by, described.sensor))
            if path is None:
                with open_operator() as operator:
                    outcome = rehearse(station, runs, "simulated", operator, poses=6)
                require_accepted(outcome.result, to_be_saved=True)
                path = outcome.run.calibration_path
            options = replace(options, description=station.description)
        elif path is None:
            raise ConfigError("no calibration: give --calibration PATH, or --simulate")
        cell = described.cell() if station is None else station.cell
        with declined_aborts():
            task = Verifying.of(cell, path, options)
            if station is not None:
                station.start_mover(options.with_recorded_mode().mode, messages.print)
            with (
                open_operator(as_json=as_json, command=task.command) as operator,
                on_page(page, operator, options, task.command) as (shown, options),
            ):
                verified = task.take(shown, limits, options)
            _report_verification(
                verified, update, page, again="" if station is None else " --simulate", as_json=as_json
            )
            index_run(verified.run.folder, messages.print, cell if station is None else None)
    if not verified.passed:
        raise NotAccepted(f"the verification failed: {verified.failure}")


def _report_verification(verified: Verified, update: Answer, page: Page | None, *, again: str, as_json: bool) -> None:
    if not as_json:
        print_verification(verified)
    conclude_verification(page, verified)
    saved = save_wanted_update(verified, update, partial(_ask_on_page, page, as_json))
    following = verified.next_command(saved, again)
    conclude_verification(page, verified, following)
    if as_json:
        write_json({**verified.to_dict(), "file": str(verified.path), "saved": None if saved is None else str(saved)})
        return
    if saved is not None:
        answer.print(f" Saved {saved}: {verified.updated} updated, parent {verified.calibration.id[:6]}")
    messages.print_next(following)


def _ask_on_page(page: Page | None, as_json: bool, question: Question) -> str:
    show = (lambda _: None) if page is None else page.put
    show({"question": question_part(question)})
    try:
        return (JsonOperator() if as_json else PlainOperator(quiet=messages.quiet)).ask(question)
    finally:
        show({"question": None})
