"""`ftdrive calibrate`: a guided calibration."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Final

import click
from click.core import ParameterSource

from ftcalib.rounding import to_place_of
from ftdrive.commands.common import (
    CELL,
    CONTROL,
    FILE,
    FOLDER,
    METHOD,
    SETS,
    YES,
    CellOptions,
    NewFile,
    Number,
    ViewOptions,
    declined_aborts,
    index_run,
    on_page,
    require_viz,
    runs,
    simulate,
    start_mover,
    stop_unless_accepted,
    view_options,
    write_json,
)

if TYPE_CHECKING:
    from ftcalib import CalibrationResult
    from ftdrive.cell.config import CellConfig
    from ftdrive.cell.emulated import Station
    from ftdrive.runs.load import Load
    from ftdrive.runs.run import Mode, Run
    from ftdrive.runs.source import Outcome
    from ftdrive.view.page import Page

# Estimates that the page shows at the end.
_SHOWN: Final = {"mass_kg", "p_sensor_com_m", "R_flange_sensor"}


@click.command()
@CELL
@click.option(
    "--tool",
    multiple=True,
    metavar="FROM:TO:DIAMETER[:X:Y]",
    help="A cylinder of tool and sensor, mm from the flange face; replaces those of [tool]. Repeatable.",
)
@CONTROL
@simulate()
@click.option("--quick", is_flag=True, help="12 poses instead of 24.")
@click.option("--minimal", is_flag=True, help="6 poses instead of 24.")
@SETS
@METHOD
@click.option(
    "--from",
    "earlier",
    metavar="RESULT",
    type=click.Path(exists=True, path_type=Path),
    help="A new tool: take mounting, base and gain from this result of the same sensor; 4 longer poses, or --sweep.",
)
@click.option(
    "--load",
    metavar="MASS",
    help="A weighed load on the tool, kg, such as 2.0 or 2.0±0.002, for `ftdrive loads solve`; with --at or --gripped.",
)
@click.option(
    "--at",
    metavar="NAME=X,Y,Z",
    help="The load hangs on a string from this point, mm from the flange face in flange axes: 12 tilts about it.",
)
@click.option("--gripped", is_flag=True, help="The load is in the gripper, at an unknown place: 6 poses.")
@click.option("--sweep", is_flag=True, help="Calibrate in one smooth motion of the wrist, with inertia and delay.")
@click.option(
    "--passive", is_flag=True, help="No motion commands: read beside any program or freedrive until it is good."
)
@click.option(
    "--seconds",
    type=Number(10, 3600),
    help="Duration of --sweep at full speed (20, at most 120), or the longest of --passive (600).",
)
@click.option("--step", is_flag=True, help="Wait for Enter before each move.")
@click.option(
    "--fast", is_flag=True, help="Full speed of the plan (60 °/s, 250 mm/s at most), after one complete slow run."
)
@click.option("--manual", is_flag=True, help="No motion commands: you move the arm, ftdrive shows where to.")
@click.option("--listen", is_flag=True, help="No motion commands: a program on the pendant moves the arm.")
@click.option("--dry-run", is_flag=True, help="Plan and check without control of the arm; nothing moves.")
@click.option("--output", type=NewFile(), help="Save the plan as a new JSON file.")
@click.option("--png", type=NewFile(), help="Save stick figures (needs ftdrive[viz]).")
@view_options
@click.option("--plan", type=FILE, help="Use this plan.")
@click.option(
    "--resume",
    type=FOLDER,
    help="Continue an interrupted run in its mode, with its options and the present configuration files.",
)
@click.option("--redo", type=int, multiple=True, metavar="N", help="With --resume: repeat pose N. Repeatable.")
@YES
@runs()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per line: events, questions, the result.")
def calibrate(
    described: CellOptions,
    tool: tuple[str, ...],
    control: str | None,
    simulate: bool,
    quick: bool,
    minimal: bool,
    earlier: Path | None,
    load: str | None,
    at: str | None,
    gripped: bool,
    sweep: bool,
    passive: bool,
    seconds: float | None,
    step: bool,
    manual: bool,
    listen: bool,
    resume: Path | None,
    method: str,
    runs: Path,
    view: ViewOptions,
    as_json: bool,
    **as_session: Any,
) -> None:
    """Move the arm through 24 orientations, average the sensor at each, and solve.

    Every move is proven clear and shown before it happens. The first run of a plan is slow and starts after a typed
    word. If there is room, only the three wrist joints move. Ctrl-C stops the arm; the poses are kept, and --resume
    continues.
    """
    from ftdrive.cell.emulated import REAL_PACE, Station
    from ftdrive.runs.load import Load
    from ftdrive.runs.run import Run
    from ftdrive.session.options import SessionOptions, method_of_poses
    from ftdrive.session.session import calibrate as guide
    from ftdrive.terminal.console import beside
    from ftdrive.terminal.screen import open_operator

    _refuse_contradictions(click.get_current_context())
    known_load = None if load is None else Load.of(load, at, gripped=gripped)
    require_viz(as_session["png"])
    chosen: dict[Mode, bool] = {"sweep": sweep, "passive": passive, "step": step, "manual": manual, "listen": listen}
    mode: Mode = next((name for name, given in chosen.items() if given), "auto")
    with ExitStack() as stack:
        page = stack.enter_context(view.page("ftdrive calibrate"))
        description: dict[str, Any] = {}
        made_by = None if resume is None else Run(resume).header_to_resume().get("station")
        # A resumed run keeps its cell.
        simulate = simulate or bool(made_by and not (described.config or described.robot or tool))
        if simulate:
            # A load swings as slowly as it does on a real arm.
            pace = REAL_PACE if sweep or passive or (known_load and not known_load.gripped) else ()
            station = stack.enter_context(Station.of(made_by, described.sensor, pace, control_path=control))
            cell = station.cell
            description = station.description
        else:
            config = described.config and described.config.absolute()
            described = replace(described, config=config, tool=tool, control=control)
            description = {"said": described.to_dict()}
            cell = described.cell() if resume is None else _cell_to_resume(resume, described)
        if earlier is not None:
            from ftdrive.runs.source import read_calibration

            description["earlier"] = read_calibration(earlier).to_dict()
        poses = 12 if quick else 6 if minimal or gripped else 4 if earlier is not None else 24
        options = SessionOptions(
            runs,
            poses=poses,
            method=method_of_poses(method),
            mode=mode,
            seconds=seconds or (600.0 if passive else 20.0),
            resume=resume,
            real=not simulate,
            description=description,
            load=known_load,
            **as_session,
        )
        if simulate:
            _put_on(station, known_load if resume is None else Load.of_header(Run(resume).header()))
            start_mover(station, options)
        with (
            declined_aborts(),
            open_operator(as_json=as_json) as operator,
            on_page(page, operator, options) as (shown, options),
        ):
            outcome = guide(cell, shown, options)
        if outcome is None:
            beside(as_json).print(words := "Dry run: nothing has moved.")
            if page is not None:
                from ftdrive.view.session_page import conclude

                conclude(page, words)
            return
        index_run(outcome.run.folder, None if simulate else cell)
        _report(outcome, page, simulate=simulate, as_json=as_json)
    stop_unless_accepted(outcome.result, to_be_saved=True)


def _report(outcome: "Outcome", page: "Page | None", *, simulate: bool, as_json: bool) -> None:
    from ftdrive.terminal.console import messages
    from ftdrive.terminal.report import print_result

    saved = None if outcome.result.verdict == "rejected" else outcome.run.calibration_path
    commands = _next_commands(outcome.run, is_saved=saved is not None, simulate=simulate)
    if as_json:
        write_json(_as_json(outcome))
    else:
        print_result(outcome.result, drift=outcome.drift, records=outcome.run.records(), saved=saved)
        messages.print_next(*commands)
    if page is not None:
        _conclude(page, outcome.result, commands)


def _conclude(page: "Page", result: "CalibrationResult", commands: Sequence[str]) -> None:
    import numpy as np

    from ftcalib.estimates import FIXED_BELOW, quantities_of, values_of
    from ftdrive.terminal.report import error_in_words
    from ftdrive.view.parts import BAD, GOOD, WARN, number
    from ftdrive.view.session_page import conclude

    document, figures = result.to_dict(), []
    for label, factor, unit, key in quantities_of(document):
        values, sigmas = (factor * values_of(source[key], key) for source in (document, document["sigma"]))
        sigma = float(sigmas.max())
        fixed = sigma <= factor * FIXED_BELOW * float(np.sqrt(np.diag(result.covariance).max()))
        if key in _SHOWN and not fixed:
            rounded = ", ".join(to_place_of(value, sigma) for value in values)
            figures.append(number(label, rounded, unit, sigma=f"± {to_place_of(sigma, sigma)} (1 sigma)"))
    words = f"compensation error {error_in_words(result)}"
    findings = [one.words for one in result.findings if one.severity != "note"]
    tone = {"good": GOOD, "usable": WARN, "rejected": BAD}[result.verdict]
    conclude(page, result.verdict.upper(), words, *findings, tone=tone, figures=figures, following=commands)


def _put_on(station: "Station", load: "Load | None") -> None:
    """Give the emulated cell the load, and its controller the total as payload."""
    import numpy as np

    from ftdrive.cell.emulated import TOOL_MM
    from ftdrive.planning.geometry.arm_model import STRING_M

    if load is None:
        return
    truth = station.truth
    mass_kg = truth["mass_kg"] + load.mass_kg
    station.control(do="set-payload", payload_kg=mass_kg + truth["sensor_mass_kg"])
    if load.p_flange_mm is not None:
        place = list(load.p_flange_mm)
        station.control(do="hang", mass_kg=load.mass_kg, at_mm=place, string_mm=1e3 * STRING_M)
    else:
        # In the middle between the fingers, about: its place is unknown to the solution.
        p_load_m = np.array([0.0, 0.0, TOOL_MM[1] / 1e3 - truth["p_flange_sensor_m"][2]])
        com_m = (truth["mass_kg"] * np.array(truth["p_sensor_com_m"]) + load.mass_kg * p_load_m) / mass_kg
        station.control(do="payload-shift", mass_kg=mass_kg, p_sensor_com_m=com_m.tolist())


def _next_commands(run: "Run", *, is_saved: bool, simulate: bool) -> list[str]:
    folder = quote(str(run.folder))
    commands = [f"ftdrive report {folder}   (how good it is, and why)"]
    if "load" in run.header():
        return [*commands, f"ftdrive loads solve RUN-OF-THE-TOOL {folder}"]
    with_it = f"--calibration {folder}{' --simulate' if simulate else ''}"
    return [*commands, f"ftdrive live {with_it}", f"ftdrive verify {with_it}"] if is_saved else commands


def _refuse_contradictions(context: click.Context) -> None:
    from ftdrive.session.options import refuse_contradictions

    named = {"earlier": "from", "sets": "set"}
    given = {f"--{named.get(name, name).replace('_', '-')}": value for name, value in context.params.items() if value}
    if context.get_parameter_source("method") is ParameterSource.DEFAULT:
        del given["--method"]
    refuse_contradictions(given)


def _cell_to_resume(folder: Path, described: CellOptions) -> "CellConfig":
    """Return the cell of a resumed run: options given now replace those of the run.

    Files and environment describe tool and surroundings as they are now; the session refuses to continue if they differ
    from those of the plan. If no file describes them any more, the run's own record is used.
    """
    from ftdrive.cell.config import Setting, cell_of, recorded_cell
    from ftdrive.runs.run import Run
    from ftdrive.terminal.console import messages

    header = Run(folder).header()
    described = described.or_those(header.get("said", {}))
    found, before = described.settings(), recorded_cell(header["config"])
    undescribed = {"default", "not set", "--tool"}
    origins = {one.origin for key, one in found.items() if key.startswith(("tool.", "workcell."))} - undescribed
    if origins:
        messages.print(f"Tool and surroundings are read from {', '.join(sorted(origins))}.")
        for key, value in (("robot.host", before.robot.host), ("sensor.url", before.sensor.url)):
            if found[key].value is None:
                found[key] = Setting(value, str(folder))
        return cell_of(found)
    messages.print("No file describes tool and surroundings: the settings of the run are used.")
    cylinders_mm = found["tool.cylinders_mm"].value or before.tool.cylinders_mm
    host, control = described.robot or before.robot.host, described.control or before.robot.control
    return replace(
        before,
        robot=replace(before.robot, host=host, control=control),
        sensor=replace(before.sensor, url=described.sensor or before.sensor.url),
        tool=replace(before.tool, cylinders_mm=cylinders_mm),
    )


def _as_json(outcome: "Outcome") -> dict[str, Any]:
    from ftdrive.runs.pose_hints import hints

    return {
        "run": str(outcome.run.folder),
        "drift_check": None if outcome.drift is None else outcome.drift.to_dict(),
        "hints": [one.to_dict() for one in hints(outcome.result, outcome.run.records())],
        **outcome.result.to_dict(),
    }
