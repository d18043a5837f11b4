"""`ftdrive bundle`: write a run into one file for a bug report, without addresses and names."""

from contextlib import nullcontext
from pathlib import Path

import click

from ftcalib.files import require_new
from ftdrive.commands.options import EMULATED_SENSOR, FILE, FOLDER, JSON, NewFile, check_simulate, simulate, write_json
from ftdrive.errors import ConfigError
from ftdrive.mistakes import kind_of
from ftdrive.runs.bundle import write_bundle
from ftdrive.session.rehearsal import rehearsed_run
from ftdrive.terminal.console import indented, message_console
from ftdrive.terminal.screen import open_operator


@click.command()
@click.argument("run", metavar="RUN", required=False, type=FOLDER)
@click.option("-o", "--output", type=NewFile(), help="New file.  [default: RUN's name and .zip, in this folder]")
@click.option(
    "--transcript",
    "transcripts",
    multiple=True,
    type=FILE,
    help="Add this transcript of the sensor's wire. Repeatable.",
)
@simulate("Bundle a short run of an emulated cell.")
@EMULATED_SENSOR
@JSON
def bundle(
    run: Path | None,
    output: Path | None,
    transcripts: tuple[Path, ...],
    simulate: bool,
    sensor: str | None,
    as_json: bool,
) -> None:
    """Write RUN into one zip file, which `ftdrive replay` and `ftdrive solve` read like the run.

    The file contains configuration, versions, events, samples, results and checks of this computer. IP and MAC
    addresses, host and user names and home directories are redacted; serial numbers stay. Check the file before you
    publish it.
    """
    check_simulate(simulate, real={"RUN": run}, emulated={"--sensor": sensor})
    if run is None and not simulate:
        raise ConfigError("no run: give its folder, or --simulate")
    for file in transcripts:
        if kind_of(file) != "transcript":
            raise ConfigError(f"--transcript: {file} was not written by `ftdrive transcript record`")
    with nullcontext(run) if run is not None else rehearsed_run(open_operator(), sensor) as folder:
        path = output or Path(f"{folder.resolve().name}.zip")
        try:
            require_new(path)
        except OSError as error:
            raise ConfigError(f"{error} with --output") from error
        redacted, left_out = write_bundle(folder, path, transcripts)
    if as_json:
        write_json({"schema_version": 1, "file": str(path), "redacted": redacted, "left_out": left_out})
    say = message_console(as_json)
    counted = ", ".join(f"{count} {kind}" for kind, count in redacted.items()) or "nothing found"
    say.print(indented(" redacted: ", counted, say))
    if left_out:
        words = f"{', '.join(left_out)} (neither text nor a pose, or above 200 MB)"
        say.print(indented(" left out: ", words, say))
    say.print(f" Saved {path}")
