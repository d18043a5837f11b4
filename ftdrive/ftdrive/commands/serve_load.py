"""`ftdrive serve-load`: provide the weight and the contact wrench to the program on the controller."""

from contextlib import ExitStack
from functools import partial

import click

from ftdrive.cell.devices import program_registers
from ftdrive.commands.options import SOURCE, TRACK, SourceOptions, frame_options
from ftdrive.errors import ConfigError
from ftdrive.servers.program import INTEGERS, ProgramService, doubles_of
from ftdrive.stream.samples import Tracking, WrenchFrame
from ftdrive.terminal.console import messages
from ftdrivers.ur.rtde import FIRST_REGISTER, LAST_REGISTER


@click.command()
@SOURCE
@frame_options("base", "tcp")
@TRACK
@click.option("--first", type=int, default=FIRST_REGISTER, show_default=True, help="First register of each kind.")
def serve_load(source: SourceOptions, frame: WrenchFrame, track: Tracking, first: int) -> None:
    """Provide the contact wrench to the program on the controller, and weigh or zero on request.

    Any program may run. It writes requests to two output registers and reads input registers, with the functions of
    `ftdrive export urscript`. Nothing else is sent, and the arm is never moved. With --track, the program also gets the
    tracked bias. Press Ctrl-C to stop.
    """
    doubles = len(doubles_of(track))
    last = LAST_REGISTER + 1 - max(len(INTEGERS), doubles)
    if not FIRST_REGISTER <= first <= last:
        raise ConfigError(
            f"--first is {first}: give {FIRST_REGISTER} to {last}, because fieldbuses and PLCs use the registers below "
            f"{FIRST_REGISTER}, and {LAST_REGISTER} is the last one"
        )
    with ExitStack() as stack:
        stream = source.open(stack, frame, track)
        if stream.cell.sensor.height_mm is None:
            raise ConfigError("the centre of mass of a part needs [sensor] height_mm: set it, see `ftdrive init`")
        connect = partial(program_registers, stream.cell, first, len(INTEGERS), doubles)
        service = ProgramService(stream, connect, messages.print, source.open_log(stream, stack, messages.print))
        messages.print(
            f"Serving weight and wrench ({stream.frame}) in the registers from {first}; {stream.info.calibration_name}."
        )
        registers = "" if first == FIRST_REGISTER else f" --first {first}"
        messages.print(
            f"Write the functions for the program on the controller with `ftdrive export urscript{registers} -o FILE`."
        )
        service.run()
