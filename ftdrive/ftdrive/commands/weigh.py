"""`ftdrive weigh`: what the gripper holds beyond its calibrated tool."""

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ftdrive.commands.common import JSON, SOURCE, NewFile, Number, Source, ViewOptions, view_options, write_json
from ftdrive.errors import ConfigError
from ftdrive.terminal.text import echo

if TYPE_CHECKING:
    from ftdrive.live.samples import StreamInfo
    from ftdrive.live.weighing import ScaleState, Weighing


@click.command()
@SOURCE
@click.option(
    "--zero", is_flag=True, help="First tare the empty gripper: then drift since the calibration is no error."
)
@click.option("--poses", type=click.IntRange(1, 24), default=1, show_default=True, help="Rests of one load to join.")
@click.option("--moving", is_flag=True, help="Weigh what the arm carries, in motion too; begin with an empty gripper.")
@click.option("--count", "part_kg", type=Number(0, min_open=True), metavar="KG", help="Mass of one part: count parts.")
@click.option("--once", is_flag=True, help="Print one weight, then end; with --zero wait for a part.")
@click.option("-o", "--output", type=NewFile(), help="Record samples and weighings: .mcap, .csv or .parquet.")
@click.option("--allow-control", is_flag=True, help="With --view: the page may tare the empty gripper.")
@view_options
@JSON
def weigh(
    source: Source,
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
    """Weigh what the gripper holds beyond its calibrated tool, in half a second at rest.

    One pose gives the mass, and the centre of mass but for its place along gravity. The answer has one sigma of each,
    and the smallest mass that differs from zero. Contact, cables and moving parts are named and not weighed. With
    --moving, the load is weighed while the arm carries it, and has its whole centre of mass. The arm is only read,
    never moved. Ctrl-C ends.
    """
    from ftdrive.commands.live_source import check_view, open_log, open_source
    from ftdrive.live.processing import SENSOR_FRAME
    from ftdrive.live.weighing import Weighing
    from ftdrive.recording import Recorder
    from ftdrive.terminal.console import has_screen, messages

    if moving and (zero or poses > 1):
        raise ConfigError("--moving follows the bias and has the whole centre of mass: leave out --zero and --poses")
    check_view(view, once=once, allow_control=allow_control)
    view.require()
    with ExitStack() as stack:
        stream = open_source(source, SENSOR_FRAME, stack, "show" if moving else "off")
        recorder = None
        if output is not None:
            recorder = Recorder([output], stream.info, stream.cell.to_dict())
            stack.callback(recorder.close)
        log = open_log(source, stream, stack, messages.print)
        weighing = Weighing(stream, recorder, joins=poses > 1, part_kg=part_kg, moving=moving, log=log)
        if zero:
            messages.print(" Zero: the gripper must be empty.")
            weighing.zero()
        on_screen = not (once or as_json) and has_screen()
        if (page := stack.enter_context(view.page("ftdrive weigh"))) is not None:
            from ftdrive.view.page import drawing
            from ftdrive.view.weigh_page import WeighPage

            shown = WeighPage(page, weighing, controls=allow_control)
            # the full screen hides what is printed, and has a line for notes
            say = partial(setattr, weighing, "note") if on_screen else messages.print
            stack.enter_context(drawing(page, shown.draw, say))
        if on_screen:
            from ftdrive.terminal.weigh_screen import WeighScreen

            WeighScreen(weighing, "" if page is None else page.url).run()
        else:
            _print(weighing, once=once, waits=zero or moving, poses=0 if moving else poses, as_json=as_json)


def _answer_of(shown: "ScaleState", info: "StreamInfo") -> dict[str, Any]:
    from ftdrive.live.weighing import load_values

    values: dict[str, Any] = {"schema_version": 1, "calibration_id": info.calibration.id, "marks": list(info.marks)}
    values |= {} if shown.weight is None else load_values(shown.weight, info)
    return values | {"count": shown.count, "refused": shown.refusal}


def _print(weighing: "Weighing", *, once: bool, waits: bool, poses: int, as_json: bool) -> None:
    """Print each new weight or fault as a line; with `once` end with the first weight."""
    from ftdrive.live.weighing import PATIENCE_S, line_of

    clock = weighing.stream.clock
    begin_s = clock.now_s()
    for shown, is_new in weighing.states(raises=once):
        if once and not waits and clock.now_s() - begin_s > PATIENCE_S:
            raise weighing.given_up(shown)
        weight = shown.weight
        if not is_new or (once and (shown.refusal is not None or weight is None or weight.poses < poses)):
            continue
        if once and waits and weight is not None and not weight.is_something:
            continue
        if as_json:
            write_json(_answer_of(shown, weighing.stream.info))
        else:
            echo(line_of(shown))
        if once:
            return
