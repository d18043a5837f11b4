"""`ftdrive weigh`: weigh the load in the gripper beyond its calibrated tool."""

from collections.abc import Iterable
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path

import click

from ftdrive.commands.options import (
    JSON,
    POSITIVE,
    SOURCE,
    NewFile,
    SourceOptions,
    ViewOptions,
    view_options,
    write_json,
)
from ftdrive.errors import ConfigError
from ftdrive.recording import Recorder
from ftdrive.stream.processing import SENSOR_FRAME
from ftdrive.stream.stream import RECOVER_S, Sink, pump
from ftdrive.stream.weighing import PATIENCE_S, Weighing, format_scale, load_values
from ftdrive.terminal.console import has_screen, messages
from ftdrive.terminal.text import echo
from ftdrive.terminal.weigh_screen import WeighScreen
from ftdrive.view.live_page import WeighPage
from ftdrive.view.page import drawing


@click.command()
@SOURCE
@click.option(
    "--zero", is_flag=True, help="Tare the empty gripper first, which removes the drift since the calibration."
)
@click.option("--poses", type=click.IntRange(1, 24), default=1, show_default=True, help="Number of poses to combine.")
@click.option("--moving", is_flag=True, help="Weigh the load while the arm carries it; start with an empty gripper.")
@click.option("--count", "part_kg", type=POSITIVE, metavar="KG", help="Count parts of this mass.")
@click.option("--once", is_flag=True, help="Print one weight and exit; with --zero, wait for a part.")
@click.option("-o", "--output", type=NewFile(), help="Record samples and weighings: .mcap, .csv or .parquet.")
@click.option("--allow-control", is_flag=True, help="Let the page of --view tare the empty gripper.")
@view_options
@JSON
def weigh_command(
    source: SourceOptions,
    zero: bool,
    poses: int,
    moving: bool,
    part_kg: float | None,
    once: bool,
    output: Path | None,
    allow_control: bool,
    view: ViewOptions,
    as_json: bool,
) -> None:
    """Weigh the load in the gripper, without the calibrated tool, in half a second at rest.

    One pose gives the mass, and the centre of mass except along gravity, each with one sigma, and the smallest mass
    that differs from zero. Contacts, cables and moving parts are reported and not weighed. With --moving, the load is
    weighed while the arm carries it, with its complete centre of mass. The arm is only read. Press Ctrl-C to stop.
    """
    if moving and (zero or poses > 1):
        raise ConfigError("--moving tracks the bias and needs only one pose: leave out --zero and --poses")
    view.require(once=once, allow_control=allow_control)
    with ExitStack() as stack:
        stream = source.open(stack, SENSOR_FRAME, "show" if moving else "off")
        keep = source.open_log(stream, stack, messages.print)
        weighing = Weighing(stream, joins=poses > 1, part_kg=part_kg, moving=moving, keep=keep)
        sinks: list[Sink] = [weighing]
        if output is not None:
            sinks.append(Recorder([output], stream.info, stream.cell.to_dict()))
        turns = stack.enter_context(closing(pump(stream, sinks, patience_s=0.0 if once else RECOVER_S)))
        if zero:
            messages.print(" Zero: the gripper must be empty.")
            weighing.request_zero()
            while weighing.is_zeroing:
                next(turns)
            if weighing.refusal is not None:
                raise weighing.refusal
            weighing.note = ""
        on_screen = not (once or as_json) and has_screen()
        if (page := stack.enter_context(view.page("ftdrive weigh"))) is not None:
            shown = WeighPage(page, weighing, controls=allow_control)
            # on the full screen, errors of the page go to its line for notes, because it would hide printed messages
            say = partial(setattr, weighing, "note") if on_screen else messages.print
            stack.enter_context(drawing(page, shown.draw, say))
        if on_screen:
            WeighScreen(weighing, turns, "" if page is None else page.url).run()
        else:
            _print_weights(
                weighing, turns, once=once, waits=zero or moving, poses=0 if moving else poses, as_json=as_json
            )


def _print_weights(
    weighing: Weighing, turns: Iterable[object], *, once: bool, waits: bool, poses: int, as_json: bool
) -> None:
    """Print each new weight, or reason for none, as a line; with `once`, return after the first weight."""
    clock, info = weighing.stream.clock, weighing.stream.info
    head = {"schema_version": 1, "calibration_id": info.calibration.id, "marks": list(info.marks)}
    begin_s = clock.now_s()
    for _ in turns:
        shown = weighing.shown
        if once and not waits and clock.now_s() - begin_s > PATIENCE_S:
            raise weighing.given_up(shown)
        weight = shown.weight
        if not weighing.is_new or (once and (shown.refusal is not None or weight is None or weight.poses < poses)):
            continue
        if once and waits and weight is not None and not weight.is_something:
            continue
        if as_json:
            values = {} if weight is None else load_values(weight, info)
            write_json({**head, **values, "count": shown.count, "refused": shown.refusal})
        else:
            echo(format_scale(shown))
        if once:
            return
