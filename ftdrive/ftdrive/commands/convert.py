"""`ftdrive convert`: a recording in another file format."""

from pathlib import Path

import click

from ftdrive.commands.common import JSON, NewFile, write_json


@click.command()
@click.argument("source", metavar="IN", type=click.Path(exists=True, path_type=Path))
@click.argument("target", metavar="OUT", type=NewFile())
@JSON
def convert(source: Path, target: Path, as_json: bool) -> None:
    """Convert a recording between .mcap, .csv and .parquet, without loss.

    IN may also be the .partial of a recording that was interrupted; OUT is complete then.
    """
    from ftdrive.recording import read_recording, write_recording
    from ftdrive.recording.files import format_of
    from ftdrive.terminal.console import beside, messages

    format_of(target)
    recording = read_recording(source)
    write_recording(target, recording)
    if recording.cut:
        messages.print(f" {source} is incomplete ({recording.cut}): {recording.duration_s:.1f} s of it are readable.")
    beside(as_json).print(f" Saved {target}")
    if as_json:
        samples = {"samples": len(recording.rows), "duration_s": recording.duration_s, "gaps": recording.gaps}
        write_json({"schema_version": 1, "file": str(target), **samples, "complete": not recording.cut})
