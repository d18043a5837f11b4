"""`ftdrive fleet verify`: verify one cell after the other, with an operator at each."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import click

from ftdrive.cell.config import CellConfig
from ftdrive.commands.options import STORE, CellOptions
from ftdrive.errors import ConfigError, Declined, NotAccepted, exit_code, in_a_sentence
from ftdrive.fleet.cells import refuse_variables
from ftdrive.fleet.state import Fleet
from ftdrive.fleet.status import fleet_state
from ftdrive.runs.verification import NO_LIMITS, Verified
from ftdrive.session.events import Question
from ftdrive.session.open_session import SessionOptions
from ftdrive.session.verifying import POSES, Verifying, save_wanted_update
from ftdrive.store import index_run, store_url
from ftdrive.store.records import StoredCell
from ftdrive.store.store import Store
from ftdrive.terminal.console import answer, messages
from ftdrive.terminal.operators import PlainOperator
from ftdrive.terminal.report import print_verification
from ftdrive.terminal.screen import open_operator
from ftdrive.terminal.text import echo


@click.command("verify")
@click.argument("names", metavar="[CELL]...", nargs=-1)
@click.option("--due", is_flag=True, help="Verify only the cells whose verification is due.")
@STORE
def fleet_verify(names: Sequence[str], due: bool, url: str | None) -> None:
    """Verify cells one after the other, with an operator at each.

    At each cell, the command first asks whether an operator is present with the emergency stop within reach. Only yes
    starts the session of `ftdrive verify`, with its plan, checks, questions and confirmation. Any other answer skips
    the cell. No option answers this question, and a terminal is required.
    """
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ConfigError("fleet verify asks at every cell and needs a terminal: run it in a terminal at the cells")
    refuse_variables()
    if names and due:
        raise ConfigError("CELL and --due are mutually exclusive: leave one of them out")
    url = url or store_url()
    store, now = Store(url), datetime.now(UTC)
    fleet = fleet_state(store, now)
    chosen = [one for one in _select_cells(store.cells(), names) if not due or fleet.is_due(one, now)]
    if not chosen:
        echo("No cell is due.", err=True)
    failed, errors, lines = list[str](), list[Exception](), list[str]()
    try:
        for one in chosen:
            try:
                outcome, words = _verify(one, store, url, fleet)
            except KeyboardInterrupt:
                lines.append(
                    f"{one.name}: interrupted; continue with ftdrive verify --resume RUN --config {one.config}"
                )
                raise
            except Declined as error:
                outcome, words = "ended", str(error)
            except Exception as error:
                outcome, words = "not verified", _fixable_message(error)
                errors.append(error)
            if outcome == "FAILED":
                failed.append(one.name)
            lines.append(f"{one.name}: {outcome}{f', {words}' if words else ''}")
    finally:
        for line in lines:
            echo(line)
    if failed:
        raise NotAccepted(f"the verification failed in {', '.join(failed)}: the lines above give the reasons")
    if errors:
        raise click.exceptions.Exit(exit_code(errors[0]) or 1)  # its message has already been printed


def _select_cells(cells: Sequence[StoredCell], names: Sequence[str]) -> list[StoredCell]:
    if not cells:
        raise ConfigError("the store has no cells: add them with `ftdrive fleet add cells.toml`")
    known = {one.name: one for one in cells}
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(f"there is no cell '{unknown[0]}': the cells are {', '.join(known)}")
    return [known[name] for name in dict.fromkeys(names)] if names else list(cells)


def _verify(one: StoredCell, store: Store, url: str | None, fleet: Fleet) -> tuple[str, str]:
    cell = _read_cell(one)
    known = fleet.id_of(one.name, cell.tool.name) or ""
    paths = [Path(result.path) for result in store.find(known) if result.id == known] if known else []
    if not paths:
        tool = cell.tool.name
        raise ConfigError(f"no accepted calibration of the tool '{tool}' is in the store: calibrate this cell")
    path = paths[0]
    if not _is_attended(one, cell):
        return "skipped", ""
    options = SessionOptions(path.parent.parent, "verify", poses=POSES)
    verified = _session(replace(cell, store=replace(cell.store, url=url)), path, options)
    return ("passed", "") if verified.passed else ("FAILED", verified.failure)


def _session(cell: CellConfig, path: Path, options: SessionOptions) -> Verified:
    task = Verifying.of(cell, path, options)
    with open_operator(command=task.command) as operator:
        verified = task.take(operator, NO_LIMITS, options)
    print_verification(verified)
    saved = save_wanted_update(verified, "ask", PlainOperator(quiet=messages.quiet).ask)
    if saved is not None:
        answer.print(f" Saved {saved}: {verified.updated} updated, parent {verified.calibration.id[:6]}")
    messages.print_next(verified.next_command(saved))
    index_run(verified.run.folder, messages.print, cell)
    return verified


def _read_cell(one: StoredCell) -> CellConfig:
    """Read the configuration file of a cell. Raises `ConfigError` if its robot is not the one in the store."""
    cell = CellOptions(Path(one.config)).cell()
    if one.robot_host not in {None, cell.robot.host}:
        raise ConfigError(
            f"its robot is {cell.robot.host}, the store has {one.robot_host}: update the store with `ftdrive fleet add`"
        )
    return cell


def _is_attended(one: StoredCell, cell: CellConfig) -> bool:
    text = (
        f"Cell {one.name}, robot {cell.robot.host}, tool {cell.tool.name}: is an operator at this cell, with the "
        "emergency stop within reach? Only yes starts its verification, Enter skips it"
    )
    try:
        return PlainOperator().ask(Question(text, ("yes", "no", ""))) == "yes"
    except Declined:
        return False


def _fixable_message(error: Exception) -> str:
    """Return the message of an error that a user can fix; raise an error that is a defect of ftdrive."""
    if exit_code(error) is None:
        raise error
    return in_a_sentence(error)
