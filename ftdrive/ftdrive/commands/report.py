"""`ftdrive report`: write one file on whether a calibration is good, and why."""

import gc
import json
import shlex
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args

import click

from ftcalib.files import unused_path, write_new
from ftcalib.result import Method
from ftdrive.commands.options import (
    EMULATED_SENSOR,
    JSON,
    REPORTED,
    SOLVED_WITH,
    TABLE,
    NewFile,
    check_simulate,
    require_extra,
    simulate,
    typed_options,
    write_json,
)
from ftdrive.errors import ConfigError
from ftdrive.report.facts import facts_of
from ftdrive.report.page import render_page
from ftdrive.report.subject import MAY_BE_MISSING, read_subject, trust_facts
from ftdrive.runs import is_run
from ftdrive.runs.bundle import unpack
from ftdrive.runs.source import SolveOptions, known_values, up_direction
from ftdrive.store import store_url
from ftdrive.tables.table import TableOptions
from ftdrive.terminal.console import indented, message_console, messages, working
from ftdrive.terminal.text import echo

_FORMATS = ("html", "json")


@click.command()
@SOLVED_WITH
@click.option(
    "--method",
    metavar="METHOD",
    type=click.Choice(get_args(Method)),
    default="ml",
    show_default=True,
    help="Method of `ftdrive solve`; the report compares the others with it.",
)
@click.argument("source", required=False, type=click.Path(exists=True, path_type=Path))
@click.option(
    "-o",
    "--output",
    type=NewFile(),
    help="New file. [default: report.html in the run or next to SOURCE, or report-2; stdout for json]",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(_FORMATS),
    help="HTML page (needs ftdrive[report]) or facts as JSON.  [default: from the suffix of --output, else html]",
)
@click.option(
    "--parent",
    metavar="RESULT",
    type=click.Path(exists=True, path_type=Path),
    help="Compare with this calibration.json or run folder. Default: the parent of the result.",
)
@TABLE
@simulate("Report a short run of an emulated cell.")
@EMULATED_SENSOR
@JSON
def report(
    source: Path | None,
    output: Path | None,
    form: str | None,
    parent: Path | None,
    method: Method,
    table: TableOptions | None,
    simulate: bool,
    sensor: str | None,
    as_json: bool,
    **shared: Any,
) -> None:
    """Report on SOURCE: a calibration.json, a run folder, or a dataset.json or table as for `ftdrive solve`.

    The report contains verdict, findings, next step, uncertainty, cross-validation, residuals, drift, noise, coverage,
    settings and provenance. An unsolved source is solved with the options of `ftdrive solve`. Rejected results are
    reported too, with exit code 0.
    """
    check_simulate(simulate, real={"SOURCE": source}, emulated={"--sensor": sensor})
    if source is None and not simulate:
        raise ConfigError("nothing to report: give a calibration.json, a run folder or a table, or --simulate")
    if (form := form or (output.suffix[1:] if output is not None else "html")) not in _FORMATS:
        raise ConfigError(f"{output} does not have the suffix of a report: name it .html or .json, or give --format")
    if form == "html":
        require_extra("report", "a report in HTML (not --format json)", "jinja2", "matplotlib")
    orientation, drift, *known, up = (shared[name] for name in REPORTED[1:7])
    given = SolveOptions(method, orientation, drift, known_values(*known), up_direction(up), table=table)
    options = replace(given, words=typed_options(click.get_current_context(), REPORTED))
    gc.freeze()  # exempts imported modules from garbage collection, which would scan them again and again
    with unpack(source) if source is not None else _report_folder(sensor) as found:
        with working("Solving"):
            subject = read_subject(found, options, parent)
        trusted = trust_facts(subject.result, found, store_url, datetime.now(UTC))
        if trusted["store_error"]:
            messages.print(indented(" ! ", MAY_BE_MISSING.format(trusted["store_error"])))
        if source is not None and found != source:  # `source` is a bundle, unpacked to `found`
            command = subject.reproduce.replace(str(found), shlex.quote(str(source)))
            subject = replace(subject, source=source, reproduce=command)
        with working("Comparing methods and drawing"):
            facts = facts_of(subject, trusted)
            text = render_page(facts) if form == "html" else json.dumps(facts, allow_nan=False) + "\n"
    if output is not None:
        write_new(output, text)
    elif form == "html":
        output = _save_report(text, Path() if source is None else source if is_run(source) else source.parent)
    if output is not None:
        say = message_console(as_json)
        say.print(indented(f" {facts['verdict'].upper()}  ", f"compensation error {facts['error']['words']}", say))
        say.print(f" Saved {output}")
    if as_json:
        write_json({**facts, "file": output and str(output)})
    elif output is None:
        echo(text, nl=False, fold=False)


def _save_report(text: str, folder: Path) -> Path:
    while True:
        with suppress(FileExistsError):
            write_new(path := unused_path(folder / "report.html"), text)
            return path


def _report_folder(sensor: str | None) -> AbstractContextManager[Path]:
    from ftdrive.session.rehearsal import rehearsed_run  # slow: imports the drivers and the screen
    from ftdrive.terminal.screen import open_operator

    return rehearsed_run(open_operator(), sensor)
