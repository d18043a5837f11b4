"""`ftdrive solve`: a calibration from data on disk, without a device."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import Any, get_args

import click
import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Known
from ftcalib import solve as solve_dataset
from ftcalib.after.new_tool import new_tool, together
from ftcalib.compare import compare, table_iii
from ftcalib.data.dataset import Orientation
from ftcalib.errors import AcceptanceError, DataError
from ftcalib.likelihood.session import Drift
from ftcalib.model import UP_IN_BASE
from ftcalib.poses.selection import EVERY_SET
from ftcalib.published.methods import SPECIAL
from ftcalib.result import Method
from ftcalib.rounding import counted
from ftcalib.routine import PoseRecord, drift_check
from ftdrive.commands.common import (
    BAG_TOPICS,
    EMULATED_SENSOR,
    FILE,
    JSON,
    NewFile,
    Number,
    check_simulate,
    index_run,
    numbers,
    rehearsed_run,
    simulate,
    stop_unless_accepted,
    write_json,
)
from ftdrive.commands.tables import TABLE
from ftdrive.errors import ConfigError, NotAccepted, exit_code
from ftdrive.recording.files import is_bag
from ftdrive.recording.foreign import moving_source
from ftdrive.runs.bundle import unpack
from ftdrive.runs.pose_hints import hints, numbers_in_dataset
from ftdrive.runs.run import Run, in_motion
from ftdrive.runs.source import (
    RecordedData,
    SolveOptions,
    read_calibration,
    read_source,
    require_same_cell,
    solve_in_motion,
)
from ftdrive.tables.table import Table, TableOptions
from ftdrive.terminal.console import beside, hanging, messages, working
from ftdrive.terminal.report import print_cases, print_comparison, print_result, print_tests
from ftdrive.terminal.text import echo, in_one_line

_METHODS = (*get_args(Method), "all")
_EPILOG = "\b\nMETHOD is one of\n" + fill(
    ", ".join(_METHODS), 76, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False
)


@click.command(epilog=_EPILOG)
@click.argument("sources", metavar="DATASET...", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option(
    "--method",
    metavar="METHOD",
    type=click.Choice(_METHODS),
    default="ml",
    show_default=True,
    help="Method, one of those below; all prints them side by side.",
)
@click.option(
    "--orientation",
    type=click.Choice(["R_base_flange", "R_flange_base"]),
    default="R_base_flange",
    show_default=True,
    help="Rotation in a table, also that of --test: flange to base coordinates, or the inverse (as in the papers).",
)
@click.option("--as-published", is_flag=True, help="Carlson's methods as they are printed, without biases.")
@click.option(
    "--drift",
    type=click.Choice(["auto", "none", "linear", "random-walk"]),
    default="auto",
    show_default=True,
    help="Model of the bias drift; rows without times count as equally spaced.",
)
@click.option("--mass-kg", metavar="KG", type=Number(0, min_open=True), help="Known mass below the sensor.")
@click.option("--level-deg", metavar="DEG", type=Number(0, 180), help="The base is level within DEG (one sigma).")
@click.option("--mounting-deg", metavar="RX,RY,RZ", help="Known rotation vector of the sensor in the flange.")
@click.option(
    "--up", metavar="X,Y,Z", help="Up direction in base axes, such as 0,0,1 on a floor; declares the mounting."
)
@click.option("--wrench", metavar="FILE", type=FILE, help="In motion: table of the wrench, if it is a file of its own.")
@click.option("--orientation-file", metavar="FILE", type=FILE, help="With --wrench: table of the poses of the flange.")
@click.option(
    "--from",
    "earlier",
    metavar="RESULT",
    type=click.Path(exists=True, path_type=Path),
    help="A new tool: take mounting, base and gain from this result of the same sensor. 4 poses or 10 s of motion do.",
)
@click.option(
    "--test",
    metavar="RUN",
    type=click.Path(exists=True, path_type=Path),
    help="With --method all: largest errors on these poses of the free tool, as in Yu's Table III.",
)
@click.option(
    "--table-iii", "cases", is_flag=True, help=f"The 11 cases of Yu's Table III, from a run with --set {EVERY_SET}."
)
@click.option("--together", "joined", is_flag=True, help="Join runs of one tool, each with a bias of its own.")
@BAG_TOPICS
@TABLE
@click.option("--point-mass", is_flag=True, help="In motion: the load is known to have no inertia of its own.")
@click.option("--output", "-o", type=NewFile(), help="Save the calibration as a new file.")
@click.option("--force", is_flag=True, help="Save a rejected result too; it stays marked as rejected.")
@simulate("Solve a short run of an emulated cell.")
@EMULATED_SENSOR
@JSON
def solve(
    sources: Sequence[Path],
    method: str,
    orientation: Orientation,
    as_published: bool,
    drift: Drift,
    mass_kg: float | None,
    level_deg: float | None,
    mounting_deg: str | None,
    up: str | None,
    wrench: Path | None,
    orientation_file: Path | None,
    earlier: Path | None,
    test: Path | None,
    cases: bool,
    joined: bool,
    wrench_topic: str | None,
    pose_topic: str | None,
    table: TableOptions | None,
    point_mass: bool,
    output: Path | None,
    force: bool,
    simulate: bool,
    sensor: str | None,
    as_json: bool,
) -> None:
    """Solve each DATASET: a run folder, the file of `ftdrive bundle`, a dataset.json, or a table of any program.

    A table has one row a pose: the orientation of the flange, the wrench, and optionally a time and sigma_fx..sigma_tz,
    the standard error of each mean. Separator, decimal sign, names and units are recognised; --columns and the options
    beside it say what the file does not. With --json, one object a line.

    A DATASET may also be a recording in motion, from which inertia and delay are estimated too: a file of `ftdrive
    record`, a table with both streams, --wrench and --orientation-file on one clock, or a bag of ROS 1 or ROS 2.
    """
    check_simulate(simulate, real={"DATASET": sources, "--wrench": wrench}, emulated={"--sensor": sensor})
    if (wrench is None) != (orientation_file is None) or (wrench is not None and sources):
        raise ConfigError("--wrench and --orientation-file are one recording: give both, and no DATASET")
    pair = None if wrench is None or orientation_file is None else (wrench, orientation_file)
    sources = sources if pair is None else pair[:1]
    if not (sources or simulate):
        raise ConfigError("no data: give a run folder, a dataset.json or a CSV file, or --simulate")
    others = (earlier, pair, test, mass_kg, level_deg, mounting_deg, up)
    if cases and (method != "ml" or drift != "auto" or joined or any(one is not None for one in others)):
        raise ConfigError(
            "--table-iii has methods and test sets of its own: leave out --method, --test and other data, --drift and "
            "known values"
        )
    if test is not None and method != "all":
        raise ConfigError("--test compares methods: add --method all")
    if as_published and method != "all" and not method.startswith("carlson-"):
        raise ConfigError("--as-published is for --method carlson-... and all: every other method has one form")
    if (earlier is not None or joined) and (method != "ml" or (earlier is not None and joined)):
        raise ConfigError("--from and --together are for --method ml, one of the two at a time")
    if joined and pair is not None:
        raise ConfigError("--together joins poses at rest: leave out --wrench and --orientation-file")
    if joined and len(sources) < 2:
        raise ConfigError("--together joins two runs or more: name them, the oldest first")
    if output is not None and ((len(sources) > 1 and not joined) or method == "all" or cases):
        raise ConfigError("--output takes one result: give one dataset and one method")
    options = SolveOptions(
        method,
        orientation,
        drift,
        known_values(mass_kg, level_deg, mounting_deg),
        up_direction(up),
        as_published=as_published,
        earlier=None if earlier is None else read_calibration(earlier),
        pair=pair,
        point_mass=point_mass,
        topics=(wrench_topic, pose_topic),
        table=table,
    )
    tests = _test_set(test, options)
    show = _show_cases if cases else partial(_show_all, options, test, tests) if method == "all" else None
    if joined:
        _solve_together(sources, options, output, force, as_json)
        return
    poses = 24 if method in (*SPECIAL, "all") else 6
    rehearsed = {"sets": EVERY_SET} if cases else {"poses": poses, "method": "ml" if method == "all" else method}
    with rehearsed_run(sensor, **rehearsed) if simulate else nullcontext() as run:
        _solve_each(sources if run is None else [run], options, show, output, force, as_json)
    if output is not None and sources and sources[0].is_dir():
        index_run(sources[0])  # the result, if it was saved in the run


def _solve_each(
    sources: Sequence[Path],
    options: SolveOptions,
    show: Callable[[Path, RecordedData, bool], None] | None,
    output: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Solve each source by itself; `show` compares methods or cases on poses at rest, instead of one result."""
    first_failure: AcceptanceError | DataError | None = None
    for source in sources:
        # One source that fails does not keep the others from being solved.
        try:
            with unpack(source) as place:
                if show is not None and (options.method != "all" or not _is_in_motion(place, options)):
                    show(source, read_source(place, options), as_json)
                    continue
                result, records = _result_of(place, options)
                if as_json:
                    found = [one.to_dict() for one in hints(result, records)]
                    write_json({"source": str(source), "hints": found, **result.to_dict()})
                else:
                    print_result(result, drift=drift_check(records) if records else None, records=records)
                _save(result, output, force, as_json)
        except (AcceptanceError, DataError) as error:
            if len(sources) == 1:
                raise
            first_failure = first_failure or error
            if as_json and not isinstance(error, NotAccepted):
                write_json({"schema_version": 1, "source": str(source), "error": str(error)})
            # An error of a file names it, without its folder; one of the solution does not.
            is_named = isinstance(error, DataError) and [one.name for one in sources].count(source.name) == 1
            echo(in_one_line(f"error: {error}" if is_named else f"error: {source}: {error}"), err=True)
    if first_failure is not None:
        raise SystemExit(exit_code(first_failure))


def _is_in_motion(place: Path, options: SolveOptions) -> bool:
    # A bag is read whole, so it is not read for the answer.
    return in_motion(place) or is_bag(place) or moving_source(place, options) is not None


def _result_of(place: Path, options: SolveOptions) -> tuple[CalibrationResult, Sequence[PoseRecord]]:
    """Solve a recording in motion, or poses; also return the records of a run."""
    moving = Run(place) if in_motion(place) else moving_source(place, options)
    if any(options.topics) and (options.pair is not None or not is_bag(place)):
        raise ConfigError("--wrench-topic and --pose-topic go with a bag of ROS: leave them out")
    if moving is not None:
        if options.method != "ml":
            raise ConfigError(f"--method {options.method} is for poses at rest: leave it out for a recording")
        return _solve_motion(moving, options), ()
    data = read_source(place, options)
    _print_table(data.provenance)
    earlier = options.earlier or data.earlier
    if earlier is not None:
        require_same_cell(earlier, data.provenance)
        return new_tool(earlier, data.dataset, data.provenance), data.records
    return _solve_poses(data, options), data.records


def _print_table(provenance: Mapping[str, Any]) -> None:
    """Print what was recognised in a table, so that a wrong guess is seen."""
    if words := provenance.get("table"):
        messages.print(hanging(" ", f"{provenance.get('source') or ''}: {words}".removeprefix(": "), messages))


def _solve_motion(moving: Run | Path | tuple[Table, Table], options: SolveOptions) -> CalibrationResult:
    how: dict[str, Any] = {"earlier": options.earlier, "known": options.known, "point_mass": options.point_mass}
    with working("Solving"):
        if isinstance(moving, Run):
            return solve_in_motion(moving, **how)
        from ftdrive.recording.in_motion import solve_recording  # with the filters of a stream

        result = solve_recording(moving, up_in_base=options.up_in_base, **how)
    _print_table(result.provenance)
    return result


def _solve_together(
    sources: Sequence[Path], options: SolveOptions, output: Path | None, force: bool, as_json: bool
) -> None:
    results = []
    for source in sources:
        with unpack(source) as place:
            if _is_in_motion(place, options):
                raise ConfigError(f"--together joins poses at rest, and {source} is in motion")
            # Without the earlier result of a new tool, because a result from another one would count that twice.
            results.append(_solve_poses(read_source(place, options), options))
    result = together(results)
    if as_json:
        write_json({"sources": [str(source) for source in sources], **result.to_dict()})
    else:
        print_result(result)
    _save(result, output, force, as_json)


def _save(result: CalibrationResult, output: Path | None, force: bool, as_json: bool) -> None:
    if not force:
        stop_unless_accepted(result, to_be_saved=output is not None)
    if output is not None:
        result.save(output)
        beside(as_json).print(f" Saved {output}")


def _solve_poses(data: RecordedData, options: SolveOptions) -> CalibrationResult:
    chosen: Any = options.method
    how: dict[str, Any] = {"drift": options.drift, "as_published": options.as_published, **data.circumstances}
    with working(f"Solving {counted(len(data.dataset), 'pose')}"):
        try:
            return solve_dataset(data.dataset, chosen, **how, provenance=data.provenance)
        except ValueError as error:
            raise ConfigError(str(error)) from error


def _test_set(test: Path | None, options: SolveOptions) -> CalibrationDataset | None:
    if test is None:
        return None
    with unpack(test) as place:
        return read_source(place, SolveOptions(orientation=options.orientation)).dataset


def _show_all(
    options: SolveOptions,
    test: Path | None,
    tests: CalibrationDataset | None,
    source: Path,
    data: RecordedData,
    as_json: bool,
) -> None:
    truth = data.truth
    how: dict[str, Any] = {"drift": options.drift, "as_published": options.as_published, **data.circumstances}
    with working("Solving with all methods"):
        compared = compare(data.dataset, **how, test=tests, truth=truth)
    if as_json:
        given = {"as_published": options.as_published, **({} if test is None else {"test_set": str(test)})}
        methods = [one.to_dict() for one in compared]
        write_json({"schema_version": 1, "source": str(source), **given, "methods": methods})
        return
    print_comparison(compared)
    if tests is not None:
        reference = "the truth of the emulated cell" if truth is not None else "ml"
        heading = f"Largest errors on the {len(tests)} poses of {test}; mg and centre against {reference}:"
        print_tests(("method",), [((one.method,), one) for one in compared], heading)


def _show_cases(source: Path, data: RecordedData, as_json: bool) -> None:
    if not data.records:
        raise ConfigError(f"--table-iii needs the folder of a run, and {source} is a file: calibrate --set {EVERY_SET}")
    with working("Solving the cases of Table III"):
        numbers = numbers_in_dataset(data.records)
        cases = table_iii(data.dataset, numbers, data.truth, g_m_s2=data.g_m_s2)
    if as_json:
        rows = [{"case": number, "data": sets, "test_set": on, **one.to_dict()} for number, sets, on, one in cases]
        write_json({"schema_version": 1, "source": str(source), "cases": rows})
    else:
        print_cases(cases, known=data.truth is not None)


def known_values(mass_kg: float | None, level_deg: float | None, mounting_deg: str | None) -> Known | None:
    """Return the known values of the options in degrees; None without any. Raises `ConfigError`."""
    if mass_kg is None and level_deg is None and mounting_deg is None:
        return None
    R_flange_sensor = None
    if mounting_deg is not None:
        rotation_vector = numbers("--mounting-deg", mounting_deg, ",", (3,))
        R_flange_sensor = Rotation.from_rotvec(rotation_vector, degrees=True).as_matrix()
    try:
        return Known(
            R_flange_sensor=R_flange_sensor,
            gravity_direction_base=None if level_deg is None else -UP_IN_BASE,
            direction_tolerance_rad=0.0 if level_deg is None else float(np.radians(level_deg)),
            mass_kg=mass_kg,
        )
    except ValueError as error:
        raise ConfigError(str(error)) from error


def up_direction(up: str | None) -> list[float] | None:
    """Return the direction (3,) of `--up`; None without it. Raises `ConfigError`."""
    if up is None:
        return None
    direction = numbers("--up", up, ",", (3,))
    if not any(direction):
        raise ConfigError(f"--up is {up}, which is no direction: give 0,0,1 for a robot on a floor")
    return direction
