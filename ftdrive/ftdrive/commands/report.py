"""`ftdrive report`: one file that says whether a calibration is good, and why."""

import gc
import shlex
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import get_args

import click
from click.core import ParameterSource

from ftcalib.data.dataset import Orientation
from ftcalib.files import require_new, write_new
from ftcalib.likelihood.session import Drift
from ftcalib.result import Method
from ftdrive.commands.common import (
    EMULATED_SENSOR,
    JSON,
    NewFile,
    check_simulate,
    rehearsed_run,
    require_extra,
    simulate,
    store_url,
    write_json,
)
from ftdrive.commands.solve import known_values, up_direction
from ftdrive.commands.solve import solve as solve_command
from ftdrive.commands.tables import TABLE, TABLE_NAMES
from ftdrive.errors import ConfigError
from ftdrive.report.facts import facts_of
from ftdrive.report.report import Format
from ftdrive.report.report import report as written
from ftdrive.report.subject import read_subject, trust
from ftdrive.runs.bundle import unpack
from ftdrive.runs.run import is_run, unused_path
from ftdrive.runs.source import SolveOptions
from ftdrive.tables.table import TableOptions
from ftdrive.terminal.console import beside, hanging, messages, working
from ftdrive.terminal.text import echo

_SHARED = ("orientation", "drift", "mass_kg", "level_deg", "mounting_deg", "up")
DEFAULT = Path("report.html")


@click.command(params=[one for one in solve_command.params if one.name in _SHARED])
@click.option(
    "--method",
    metavar="METHOD",
    type=click.Choice(get_args(Method)),
    default="ml",
    show_default=True,
    help="Method, as of `ftdrive solve`; the report compares the others with it.",
)
@click.argument("source", required=False, type=click.Path(exists=True, path_type=Path))
@click.option(
    "-o",
    "--output",
    type=NewFile(),
    help=f"New file. [default: {DEFAULT} in the run or beside SOURCE, or {DEFAULT.stem}-2; stdout for json]",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(get_args(Format)),
    help="A page (needs ftdrive[report]), or the facts as JSON.  [default: by the ending of --output, else html]",
)
@click.option(
    "--parent",
    metavar="RESULT",
    type=click.Path(exists=True, path_type=Path),
    help="Compare with this calibration.json or run folder. Default: the parent that the result names.",
)
@TABLE
@simulate("Report a short run of an emulated cell.")
@EMULATED_SENSOR
@JSON
def report(
    source: Path | None,
    output: Path | None,
    form: Format | None,
    parent: Path | None,
    method: Method,
    orientation: Orientation,
    drift: Drift,
    mass_kg: float | None,
    level_deg: float | None,
    mounting_deg: str | None,
    up: str | None,
    table: TableOptions | None,
    simulate: bool,
    sensor: str | None,
    as_json: bool,
) -> None:
    """Report SOURCE: a calibration.json, a run folder, a dataset.json or a table, as `ftdrive solve` takes them.

    The report has verdict, findings, next step, uncertainty, cross-validation, residuals, drift, noise, coverage,
    settings and provenance. An unsolved source is solved with the options of `ftdrive solve`. Rejected results are
    reported too, with exit code 0.
    """
    check_simulate(simulate, real={"SOURCE": source}, emulated={"--sensor": sensor})
    if source is None and not simulate:
        raise ConfigError("nothing to report: give a calibration.json, a run folder or a table, or --simulate")
    chosen = output
    form = form or _format_of(output)
    if output is None and form == "html":
        output = unused_path(_folder_of(source) / DEFAULT)
        try:
            require_new(output)
        except OSError as error:
            raise ConfigError(f"{error} with --output") from error
    if form == "html":
        require_extra("report", "a report in HTML (not --format json)", "jinja2", "matplotlib")
    given = known_values(mass_kg, level_deg, mounting_deg), up_direction(up)
    options = SolveOptions(method, orientation, drift, *given, table=table, words=_typed(click.get_current_context()))
    gc.freeze()  # or the imports are searched for garbage again and again, as in `fleet status`
    with unpack(source) if source is not None else rehearsed_run(sensor) as found:
        with working("Solving"):
            subject = read_subject(found, options, parent)
        known = trust(subject.result, found, store_url, datetime.now(UTC))
        subject = replace(subject, trust=known)
        if known["store_error"]:
            messages.print(hanging(" ! ", f"a later verification may be missing, because {known['store_error']}"))
        if source is not None and found != source:  # unpacked
            reproduce = subject.reproduce.replace(str(found), shlex.quote(str(source)))
            subject = replace(subject, source=source, reproduce=reproduce)
        with working("Comparing methods and drawing"):
            facts = facts_of(subject)
            text = written(facts, form)
    if output is not None:
        try:
            write_new(output, text)
        # Another report took the name meanwhile.
        except FileExistsError:
            if chosen is not None:
                raise
            write_new(output := unused_path(_folder_of(source) / DEFAULT), text)
        say = beside(as_json)
        say.print(hanging(f" {facts['verdict'].upper()}  ", f"compensation error {facts['error']['words']}", say))
        say.print(f" Saved {output}")
    if as_json:
        write_json({**facts, "file": None if output is None else str(output)})
    elif output is None:
        echo(text, nl=False, fold=False)


def _format_of(output: Path | None) -> Format:
    """Return the format that the ending of a file names; raises `ConfigError` if none does."""
    if output is None or output.suffix == ".html":
        return "html"
    if output.suffix != ".json":
        raise ConfigError(f"{output} has no ending of a report: name it .html or .json, or give --format")
    return "json"


def _folder_of(source: Path | None) -> Path:
    if source is None:
        return Path()
    return source if is_run(source) else source.parent


def _typed(context: click.Context) -> tuple[str, ...]:
    """Return the options of solve that were given, as words for a shell."""
    return tuple(
        word
        for one in context.command.params
        if one.name in ("method", *_SHARED, *TABLE_NAMES)
        and context.get_parameter_source(one.name) is not ParameterSource.DEFAULT
        for word in (one.opts[0], shlex.quote(str(context.params[one.name])))
    )
