"""`ftdrive calibrate`: a guided calibration."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any, Final

import click
from click.core import ParameterSource

from ftcalib.published.methods import SPECIAL
from ftdrive.cell.emulated import REAL_PACE, Station
from ftdrive.commands.options import (
    ALL,
    CELL,
    CONTROL,
    FILE,
    FOLDER,
    JSON_LINES,
    METHOD,
    PATH,
    PLAN_FILES,
    SETS,
    YES,
    CellOptions,
    Headed,
    Number,
    ViewOptions,
    declined_aborts,
    runs_option,
    simulate,
    view_options,
    write_json,
)
from ftdrive.errors import ConfigError
from ftdrive.runs.calibration import read_calibration, require_accepted
from ftdrive.runs.load import Load
from ftdrive.runs.pose_hints import hints
from ftdrive.runs.run import Mode, Run
from ftdrive.runs.source import Outcome
from ftdrive.session.open_session import SessionOptions
from ftdrive.session.rehearsal import put_on
from ftdrive.session.session import method_of_poses, run_calibration
from ftdrive.store import index_run
from ftdrive.terminal.console import message_console, messages
from ftdrive.terminal.report import print_result
from ftdrive.terminal.screen import open_operator
from ftdrive.view.outcome import conclude_calibration, on_page
from ftdrive.view.page import Page
from ftdrive.view.session_page import conclude

_LONGEST_SWEEP_S: Final = 120
_MODES: Final[Sequence[Mode]] = ("step", "manual", "listen", "sweep", "passive")
_POSES: Final = ("--quick", "--minimal", "--set")
_EXCLUDE_ONE_ANOTHER: Final = (
    tuple(f"--{mode}" for mode in _MODES),
    (*_POSES, "--plan", "--resume", "--sweep", "--passive"),
    ("--from", "--set"),
    *(("--method", other) for other in ("--from", "--resume", "--sweep", "--passive")),
    *(("--load", other) for other in (*_POSES, "--method", "--from", "--sweep", "--passive", "--resume")),
    ("--at", "--gripped"),
    ("--fast", "--sweep", "--passive"),
    ("--from", "--resume", "--passive"),
    *((f"--{hand}", plan) for hand in ("manual", "listen", "passive") for plan in (*_POSES, "--output", "--png")),
    *(("--simulate", described) for described in ("--config", "--robot", "--tool")),
)

HEADINGS = {
    "The cell": "--config --robot --sensor --tool --control --simulate",
    "What to take": "--quick --minimal --set --plan --method --from",
    "How the arm moves": "--sweep --passive --manual --listen --step --fast --seconds --dry-run --yes",
    "Known loads": "--load --at --gripped",
    "After an interruption": "--resume --redo",
    "Output": "--runs --output --png --view --view-address --all --json --help",
}


@click.command(cls=Headed, headings=HEADINGS)
@CELL
@click.option(
    "--tool",
    multiple=True,
    metavar="FROM:TO:DIAMETER[:X:Y]",
    help="Cylinder around tool and sensor, mm from the flange face; replaces those in [tool]. Repeatable.",
)
@CONTROL
@simulate()
@click.option("--quick", is_flag=True, help="Take 12 poses instead of 24.")
@click.option("--minimal", is_flag=True, help="Take 6 poses instead of 24.")
@SETS
@METHOD
@click.option(
    "--from",
    "earlier",
    metavar="RESULT",
    type=PATH,
    help="For a new tool: use mounting, base and gain of this result of the same sensor; 4 longer poses, or --sweep.",
)
@click.option(
    "--load",
    metavar="MASS",
    help="Mass of a weighed load on the tool, kg, such as 2.0±0.002, for `loads solve`; with --at or --gripped.",
)
@click.option(
    "--at",
    metavar="NAME=X,Y,Z",
    help="Point where the load hangs on a string, mm from the flange face in flange axes; 12 poses tilted about it.",
)
@click.option("--gripped", is_flag=True, help="The gripper holds the load at an unknown position; 6 poses.")
@click.option("--sweep", is_flag=True, help="Calibrate in one smooth motion of the wrist, with inertia and delay.")
@click.option(
    "--passive", is_flag=True, help="No motion commands: record while another program or freedrive moves the arm."
)
@click.option(
    "--seconds",
    type=Number(10, 3600),
    help="Duration of --sweep at full speed (20, at most 120), or longest duration of --passive (600).",
)
@click.option("--step", is_flag=True, help="Wait for Enter before each move.")
@click.option(
    "--fast", is_flag=True, help="Move at the speed of the plan (at most 60 °/s, 250 mm/s) after one slow run."
)
@click.option("--manual", is_flag=True, help="No motion commands: you move the arm to the poses that ftdrive shows.")
@click.option("--listen", is_flag=True, help="No motion commands: a program on the pendant moves the arm.")
@click.option("--dry-run", is_flag=True, help="Plan and check only, without control of the arm; nothing moves.")
@PLAN_FILES
@view_options
@click.option("--plan", type=FILE, help="Use this plan.")
@click.option(
    "--resume",
    type=FOLDER,
    help="Continue an interrupted run in its mode, with its options and the current configuration files.",
)
@click.option("--redo", type=int, multiple=True, metavar="N", help="With --resume: repeat pose N. Repeatable.")
@YES
@runs_option()
@ALL
@JSON_LINES
def calibrate_command(
    described: CellOptions,
    tool: tuple[str, ...],
    control: str | None,
    simulate: bool,
    view: ViewOptions,
    every: bool,
    as_json: bool,
    **chosen: Any,
) -> None:
    """Move the arm through 24 orientations, average the sensor at each, and solve.

    Every move is proven clear of collisions and shown before it starts. The first run of a plan is slow and starts
    after you type a word. If possible, only the three wrist joints move. Ctrl-C stops the arm and keeps the poses;
    --resume continues.
    """
    refuse_contradictions(_given_options(click.get_current_context()))
    options, load = _options_of(**chosen)
    with ExitStack() as stack:
        page = stack.enter_context(view.page("ftdrive calibrate"))
        header = {} if options.resume is None else Run(options.resume).header_to_resume()
        made_by = header.get("station")
        # A run of an emulated cell is resumed in an emulated one, unless an option describes a real cell.
        simulate = simulate or bool(made_by and not (described.config or described.robot or tool))
        if simulate:
            # A hanging load needs real time to stop swinging, so the emulated arm is not sped up.
            swings = load is not None and not load.gripped
            pace = REAL_PACE if options.mode in ("sweep", "passive") or swings else ()
            station = stack.enter_context(Station.of(made_by, described.sensor, pace, control_path=control))
            cell, origin = station.cell, station.description
        else:
            config = described.config and described.config.absolute()
            described = replace(described, config=config, tool=tool, control=control)
            origin = {"said": described.to_dict()}
            resumed = options.resume
            cell = described.cell_to_resume(resumed, header, messages.print) if resumed else described.cell()
        options = replace(options, real=not simulate, description={**origin, **options.description})
        if simulate:
            if on_tool := Load.of_header(header) if options.resume else load:
                put_on(station, on_tool)
            station.start_mover(options.with_recorded_mode().mode, messages.print)
        with (
            declined_aborts(),
            open_operator(as_json=as_json) as operator,
            on_page(page, operator, options) as (shown, options),
        ):
            outcome = run_calibration(cell, shown, options, load)
        if outcome is None:
            message_console(as_json).print(words := "Dry run: nothing has moved.")
            if page is not None:
                conclude(page, words)
            return
        index_run(outcome.run.folder, messages.print, None if simulate else cell)
        _report_calibration(outcome, page, simulate=simulate, every=every, as_json=as_json)
    require_accepted(outcome.result, to_be_saved=True)


def _report_calibration(outcome: Outcome, page: Page | None, *, simulate: bool, every: bool, as_json: bool) -> None:
    result, run, folder = outcome.result, outcome.run, quote(str(outcome.run.folder))
    is_saved = result.verdict != "rejected"
    commands = [f"ftdrive report {folder}   (how good it is, and why)"]
    if "load" in run.header():
        commands.append(f"ftdrive loads solve RUN-OF-THE-TOOL {folder}")
    elif is_saved:
        with_it = f"--calibration {folder}{' --simulate' if simulate else ''}"
        commands += [f"ftdrive live {with_it}", f"ftdrive verify {with_it}"]
    if as_json:
        drift = None if outcome.drift is None else outcome.drift.to_dict()
        found = [one.to_dict() for one in hints(result, run.records())]
        write_json({"run": str(run.folder), "drift_check": drift, "hints": found, **result.to_dict()})
    else:
        saved = run.calibration_path if is_saved else None
        print_result(result, drift=outcome.drift, records=run.records(), saved=saved, every=every)
        messages.print_next(*commands)
    conclude_calibration(page, result, commands)


def _options_of(
    *,
    quick: bool,
    minimal: bool,
    method: str,
    earlier: Path | None,
    load: str | None,
    at: str | None,
    gripped: bool,
    seconds: float | None,
    **others: Any,
) -> tuple[SessionOptions, Load | None]:
    flags = {mode: others.pop(mode) for mode in _MODES}
    mode: Mode = next((mode for mode, is_given in flags.items() if is_given), "auto")
    poses = 6 if minimal or gripped else 24 if earlier is None else 4
    options = SessionOptions(
        poses=12 if quick else poses,
        method=method_of_poses(method),
        mode=mode,
        seconds=seconds or (600.0 if flags["passive"] else 20.0),
        description={} if earlier is None else {"earlier": read_calibration(earlier).to_dict()},
        **others,
    )
    return options, None if load is None else Load.of(load, at, gripped=gripped)


def _given_options(context: click.Context) -> dict[str, Any]:
    names = {one.name: max(one.opts, key=len) for one in context.command.params}
    given = {names[name]: value for name, value in context.params.items() if value}
    if context.get_parameter_source("method") is ParameterSource.DEFAULT:
        del given["--method"]
    return given


def refuse_contradictions(given: Mapping[str, Any]) -> None:
    """Raise `ConfigError` if options of `calibrate` contradict each other; `given` maps those given to values."""
    if "--load" not in given and (place := [option for option in ("--at", "--gripped") if option in given]):
        raise ConfigError(f"{place[0]} needs --load MASS: give the mass of the load in kg")
    for group in _EXCLUDE_ONE_ANOTHER:
        both = [option for option in group if option in given]
        if len(both) > 1:
            raise ConfigError(f"{both[0]} and {both[1]} are mutually exclusive: leave one of them out")
    if "--manual" in given and (method := given.get("--method")) in SPECIAL:
        words = f"--manual may end before all 24 orientations are taken, which {method} needs"
        raise ConfigError(f"{words}: leave it out, or choose --method lrom")
    seconds = given.get("--seconds")
    if seconds is not None and (seconds > _LONGEST_SWEEP_S if "--sweep" in given else "--passive" not in given):
        raise ConfigError(f"--seconds {seconds:g}: give up to {_LONGEST_SWEEP_S} with --sweep, or use --passive")
