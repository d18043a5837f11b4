"""`ftdrive push`: send payload and gravity of a calibration to the controller."""

import json
import shlex
from contextlib import ExitStack, closing
from dataclasses import asdict
from pathlib import Path

import click

from ftcalib import CalibrationResult
from ftdrive.cell.config import CellConfig
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.cell.emulated import Station
from ftdrive.commands.options import (
    CELL,
    JSON,
    PATH,
    CellOptions,
    check_simulate,
    declined_aborts,
    simulate,
    write_json,
)
from ftdrive.errors import ConfigError, SupervisorGone
from ftdrive.runs.calibration import read_calibration
from ftdrive.session.events import Question
from ftdrive.session.rehearsal import rehearsed_run
from ftdrive.session.settings_push import EFFECTS, WORDS, Receipt, propose, restore, send
from ftdrive.terminal.console import answer, message_console
from ftdrive.terminal.screen import open_operator
from ftdrive.terminal.text import echo
from ftdrive.words.session import proposal_in_lines, settings_in_words


@click.command()
@click.argument("source", metavar="[RESULT|RUN]", required=False, type=PATH)
@CELL
@click.option("--payload", is_flag=True, help="Push mass and centre of mass; the default without --gravity.")
@click.option("--gravity", is_flag=True, help="Push the direction of gravity in the base.")
@click.option("--restore", "receipt", metavar="RECEIPT|RUN", type=PATH, help="Restore the values before a push.")
@click.option("--dry-run", is_flag=True, help="Only compare; send nothing.")
@simulate("Push to an emulated cell, calibrated first if no result is given.")
@JSON
def push(
    source: Path | None,
    described: CellOptions,
    payload: bool,
    gravity: bool,
    receipt: Path | None,
    dry_run: bool,
    simulate: bool,
    as_json: bool,
) -> None:
    """Set payload or gravity in the controller to the calibrated values after you type a word, and read them back.

    The payload is everything below the flange: the calibrated tool, sensor and adapter. The old values are stored in a
    receipt, push.json in the run, for --restore. The arm must be free and at rest, in remote control, without a running
    program. A program made on the pendant sets the values of its installation again when it starts.
    """
    check_simulate(simulate, real={"--config": described.config, "--robot": described.robot})
    if receipt is not None and (source or payload or gravity):
        raise ConfigError("--restore uses only the receipt: leave RESULT, --payload and --gravity out")
    if not (source or receipt or simulate):
        raise ConfigError("nothing to push: give a calibration.json or a run folder, --restore or --simulate")
    with ExitStack() as stack:
        operator = stack.enter_context(open_operator(as_json=as_json, live=False))
        path = source or receipt or stack.enter_context(rehearsed_run(open_operator(), described.sensor))
        folder = path if path.is_dir() else path.parent
        of = read_calibration(path) if receipt is None else Receipt.load(path)
        cell = _emulated_cell(of, described.sensor, stack) if simulate else described.cell()
        arm = stack.enter_context(closing(build_arm(cell)))
        arm.open()
        if isinstance(of, Receipt):
            proposal = restore(cell, arm, of)
        else:
            device = stack.enter_context(build_sensor(cell))
            proposal = propose(cell, arm, device, of, payload=payload or not gravity, gravity=gravity, name=str(path))
        sends = bool(proposal.settings) and not dry_run
        if as_json:
            values = {"old": asdict(proposal.old), "new": asdict(proposal.new)}
            write_json({"schema_version": 1, "event": "proposal", **proposal.reason, **values})
        elif not sends:
            answer.print("\n".join(proposal_in_lines(proposal)))
        else:
            echo("\n".join(proposal_in_lines(proposal)), err=True)
        if not sends:
            message_console(as_json).print(
                "Dry run: nothing was sent." if dry_run else "The controller already agrees: nothing was sent."
            )
            return

        def ask(name: str) -> None:
            operator.ask(Question(EFFECTS[name], (WORDS[name],)))

        def require_supervisor() -> None:
            if why := operator.absence():
                raise SupervisorGone(why, "no more values are sent; start the push again")

        with declined_aborts():
            saved, read_back = send(arm, proposal, folder, ask, require_supervisor)
        if as_json:
            write_json({"schema_version": 1, **json.loads(saved.read_text(encoding="utf-8")), "file": str(saved)})
            return
    answer.print(f" ✔ Read back: {settings_in_words(read_back)}")
    answer.print(" Programs made on the pendant set the values of their installation: enter them there too.")
    if saved.exists():  # the run of an emulated cell is deleted
        answer.print(f" Receipt {saved}; undo: ftdrive push --restore {shlex.quote(str(saved))}")


def _emulated_cell(of: CalibrationResult | Receipt, sensor: str | None, stack: ExitStack) -> CellConfig:
    made_by = of.provenance.get("station") if isinstance(of, CalibrationResult) else None
    return stack.enter_context(Station.of(made_by, sensor)).cell
