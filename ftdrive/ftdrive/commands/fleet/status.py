"""`ftdrive fleet status` and `serve`: the state of all cells, once or continuously."""

import gc
from contextlib import closing
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import click

from ftcalib.files import write_new
from ftdrive.commands.options import JSON, STORE, NewFile, require_extra, write_json
from ftdrive.fleet.cells import Observed
from ftdrive.fleet.metrics import MetricsServer
from ftdrive.fleet.state import CellState, attention, serve_status, summary, times_in_words
from ftdrive.fleet.status import fleet_of, fleet_state
from ftdrive.servers.http_gate import host_and_port, is_loopback, with_port
from ftdrive.store import open_store
from ftdrive.store.store import Store
from ftdrive.terminal.console import answer, indented, message_console, messages, print_address
from ftdrive.terminal.text import print_table
from ftdrivers.clock import REAL

_TITLES = ("cell", "tool", "verdict", "age", "verified", "drift, σ", "due", "weighed")


@click.command()
@STORE
@click.option("--html", "page_path", metavar="FILE", type=NewFile(), help="New file: a page with plots of the drift.")
@JSON
def status(url: str | None, page_path: Path | None, as_json: bool) -> None:
    """List all cells: what is due, and what drifts.

    The columns are the age of the calibration and of the last verification, the drift of the bias in sigmas of a
    verification, the due date of the next verification, and the last weighing if there is one. A cell has one line per
    tool in use. Below the list are the problems with their fixes. The exit code is 0 even with problems.

    `ftdrive fleet add` adds cells, `ftdrive fleet index` adds runs from other computers.
    """
    if page_path is not None:
        require_extra("fleet", "--html", "jinja2")
    gc.freeze()  # exempts imported modules from garbage collection, which would take a tenth of the time
    found, now = open_store(url), datetime.now(UTC)
    observed = Observed.read(found, now)
    fleet = fleet_of(observed, found)
    if page_path is not None:
        from ftdrive.fleet.page import fleet_page  # needs the extra `fleet`

        write_new(page_path, fleet_page(fleet, observed, found.name))
        message_console(as_json).print(f" Saved {page_path}")
    if as_json:
        states = {"cells": [one.to_dict(now) for one in fleet.cells], "findings": [*map(asdict, fleet.findings)]}
        write_json({"schema_version": 1, "store": found.name, "now": now.isoformat(), **states})
    elif not fleet.cells:
        messages.print("No cells. `ftdrive fleet add cells.toml` adds them.")
    elif page_path is None:
        shown = len(_TITLES) if any(one.weighings for one in fleet.cells) else -1
        rows = [_status_row(one, now)[:shown] for one in fleet.cells]
        print_table(_TITLES[:shown], rows, folding={"cell", "tool"})
        answer.print(summary(fleet, now), style="bold")
        for words in attention(fleet, now):
            answer.print(indented(" ! ", words, answer), style="yellow")


def _status_row(one: CellState, now: datetime) -> tuple[str, ...]:
    drift = "-"
    if one.drift is not None:
        drift = f"{one.drift.level_sigmas:.1f}{' DRIFTS' if one.drift.found else ''}"
    age, verified, due, weighed = times_in_words(one, now).values()
    return (one.cell, one.tool_in_words, one.verdict or "none", age, verified, drift, due, weighed)


# Default port, outside 9100 to 9999, which are all assigned to other Prometheus exporters.
PORT = 10018
MONITORING = Path(__file__).parents[2] / "fleet" / "monitoring"


@click.command("serve")
@click.option(
    "--metrics",
    "address",
    metavar="HOST:PORT",
    default=f"127.0.0.1:{PORT}",
    show_default=True,
    help="Address of /metrics; port 0 selects a free one. A host other than loopback is unprotected.",
)
@STORE
def fleet_serve(address: str, url: str | None) -> None:
    """Serve the state of all cells to Prometheus, and as a page.

    The store is read every 60 s. If reading fails, the last state stays, with its age. Alert rules and a dashboard for
    Grafana come with ftdrive: their folder is printed. Nothing moves. Press Ctrl-C to stop.
    """
    host, port = host_and_port("--metrics", address, f"127.0.0.1:{PORT}", lowest=0)
    found = open_store(url)
    with closing(MetricsServer(host, port, partial(_status_page, found))) as metrics:
        print_address(f"Serving {found.name} at ", f"http://{with_port(host, metrics.port)}/metrics")
        print_address("The page of the fleet is at ", f"http://{with_port(host, metrics.port)}/")
        if not is_loopback(host):
            messages.print(
                f"Unprotected: any computer that reaches port {metrics.port} can read the state of all cells."
            )
        messages.print(f"Alert rules and a dashboard are in {MONITORING}")
        messages.print("Press Ctrl-C to stop.")
        serve_status(partial(fleet_state, found), metrics.update, REAL, say=messages.print)


def _status_page(store: Store) -> str:
    from ftdrive.fleet.page import fleet_page  # needs the extra `fleet`

    observed = Observed.read(store, datetime.now(UTC))
    return fleet_page(fleet_of(observed, store), observed, store.name)
