"""`ftdrive convert`: convert a recording to another file format."""

from pathlib import Path

import click

from ftdrive.commands.options import JSON, PATH, NewFile, write_json
from ftdrive.errors import BadRecording, ConfigError
from ftdrive.recording.files import RecordingReader, format_of
from ftdrive.recording.foreign import is_recording
from ftdrive.recording.recorder import convert_recording
from ftdrive.terminal.console import message_console, messages, working


@click.command()
@click.argument("source", metavar="IN", required=False, type=PATH)
@click.argument("target", metavar="OUT", required=False, type=NewFile())
@click.option("-o", "--output", type=NewFile(), help="New file, instead of OUT.")
@JSON
def convert(source: Path | None, target: Path | None, output: Path | None, as_json: bool) -> None:
    """Convert a recording between .mcap, .csv and .parquet, without loss.

    IN may also be the .partial file of an interrupted recording; OUT is then a complete file.
    """
    if source is None or (target is None) is (output is None):
        raise ConfigError(f"give one recording and one new file. Type\nftdrive convert {source or 'IN'} -o NEW.csv")
    target = target or output or Path()
    format_of(target)
    if not is_recording(source):
        raise BadRecording("another program wrote this file: read it with `ftdrive compensate`", source)
    with working("Converting") as show:
        reader = RecordingReader(source)
        found, failure = convert_recording(reader, target, show)
    cut = reader.cut if failure is None else str(failure) or "interrupted"
    if cut:
        messages.print(f" {source} is incomplete ({cut}): {found['duration_s']:.1f} s are saved.")
    short = "" if failure is None else f": the first {found['samples']} samples"
    message_console(as_json).print(f" Saved {target}{short}")
    if as_json:
        write_json({"schema_version": 1, "file": str(target), **found, "complete": not cut})
    if failure is not None:
        raise failure
