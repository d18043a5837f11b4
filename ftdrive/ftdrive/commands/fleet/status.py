"""`ftdrive fleet status`: what is due, what drifts, and what several cells show together."""

import gc
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ftdrive.commands.common import JSON, STORE, NewFile, open_store, require_extra, write_json

if TYPE_CHECKING:
    from ftdrive.fleet.state import CellState, Fleet

_TITLES = ("cell", "tool", "verdict", "age", "verified", "drift, σ", "due", "weighed")


@click.command()
@STORE
@click.option("--html", "page_path", metavar="FILE", type=NewFile(), help="New file: a page with plots of the drift.")
@JSON
def status(url: str | None, page_path: Path | None, as_json: bool) -> None:
    """List all cells: what is due, and what drifts.

    The columns are the age of the calibration, that of the last verification, the drift of the bias in sigmas of a
    verification, when the next one is due, and the last weighing if there is one. A cell has one line for each tool in
    use. Below the list is what needs attention, with what to do. The exit code is 0 also then.

    `ftdrive fleet add` adds cells, `ftdrive fleet index` adds runs from other computers.
    """
    from ftcalib.files import write_new
    from ftdrive.fleet.observed import Observed
    from ftdrive.fleet.status import fleet_of
    from ftdrive.terminal.console import answer, beside, hanging, messages

    if page_path is not None:
        require_extra("fleet", "--html", "jinja2")
    gc.freeze()  # or the imports are searched for garbage again and again: a tenth of the time
    found, now = open_store(url), datetime.now(UTC)
    observed = Observed.read(found, now)
    fleet = fleet_of(observed, found)
    if page_path is not None:
        from ftdrive.fleet.page import page

        write_new(page_path, page(fleet, observed, found.name))
        beside(as_json).print(f" Saved {page_path}")
    if as_json:
        write_json(_as_json(fleet, found.name, now))
    elif not fleet.cells:
        messages.print("No cells. `ftdrive fleet add cells.toml` adds them.")
    elif page_path is None:
        from ftdrive.fleet.words import attention, summary
        from ftdrive.terminal.table import print_table

        shown = len(_TITLES) if any(one.weighings for one in fleet.cells) else -1
        rows = [_row(one, now)[:shown] for one in fleet.cells]
        print_table(_TITLES[:shown], rows, folding={"cell", "tool"})
        answer.print(summary(fleet, now), style="bold")
        for words in attention(fleet, now):
            answer.print(hanging(" ! ", words, answer), style="yellow")


def _row(one: "CellState", now: datetime) -> tuple[str, ...]:
    from ftdrive.fleet.words import due_in_words, verified_in_words, weighed_in_words
    from ftdrive.runs.verification_record import age_in_words

    drift = "-"
    if one.drift is not None:
        drift = f"{one.drift.level_sigmas:.1f}{' DRIFTS' if one.drift.found else ''}"
    return (
        one.cell,
        one.tool_in_words,
        one.verdict or "none",
        "-" if one.calibrated is None else age_in_words(now - one.calibrated),
        verified_in_words(one, now),
        drift,
        due_in_words(one.due, now),
        weighed_in_words(one, now),
    )


def _as_json(fleet: "Fleet", name: str, now: datetime) -> dict[str, Any]:
    return {
        "schema_version": 1,
        "store": name,
        "now": now.isoformat(),
        "cells": [one.to_dict(now) for one in fleet.cells],
        "findings": [asdict(one) for one in fleet.findings],
    }
