"""`ftdrive solve`: calibrate from data on disk, without a device."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote
from textwrap import fill
from typing import Any, get_args

import click

from ftcalib import CalibrationDataset, CalibrationResult
from ftcalib.after.new_tool import together
from ftcalib.compare import compare, table_iii
from ftcalib.errors import AcceptanceError, DataError
from ftcalib.poses.selection import EVERY_SET
from ftcalib.published.methods import SPECIAL
from ftcalib.result import Method
from ftcalib.rounding import counted
from ftcalib.routine import drift_check
from ftdrive.commands.options import (
    ALL,
    BAG_TOPICS,
    EMULATED_SENSOR,
    FILE,
    JSON,
    PATH,
    REPORTED,
    SOLVED_WITH,
    TABLE,
    Headed,
    NewFile,
    check_simulate,
    simulate,
    typed_options,
    write_json,
)
from ftdrive.errors import ConfigError, NotAccepted, exit_code
from ftdrive.recording.solve import read_place, solve_place
from ftdrive.runs.bundle import unpack
from ftdrive.runs.calibration import require_accepted
from ftdrive.runs.pose_hints import hints, numbers_in_dataset
from ftdrive.runs.source import RecordedData, SolveOptions, read_source
from ftdrive.store import index_run
from ftdrive.terminal.console import indented, message_console, messages, working
from ftdrive.terminal.report import print_cases, print_comparison, print_result, print_tests
from ftdrive.terminal.text import echo
from ftdrive.words.text import in_one_line

_METHODS = (*get_args(Method), "all")
_EPILOG = "\b\nMETHOD is one of\n" + fill(
    ", ".join(_METHODS), 76, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False
)

# Options that do not affect a result, only how it is saved and printed.
_SAVING = ("output", "force", "every", "as_json")
HEADINGS = {
    "How to solve": "--method --as-published --drift --from --together --point-mass",
    "Known values": "--mass-kg --level-deg --mounting-deg --up",
    "Tables and recordings of other programs": (
        "--columns --orientation --rate --euler --tcp --wrench-frame --sign --model --urdf --wrench --orientation-file "
        "--wrench-topic --pose-topic"
    ),
    "Comparison of methods": "--test --table-iii",
    "An emulated cell": "--simulate --sensor",
    "Output": "--output --force --all --json --help",
}


@click.command(cls=Headed, headings=HEADINGS, epilog=_EPILOG)
@click.argument("sources", metavar="DATASET...", nargs=-1, type=PATH)
@click.option(
    "--method",
    metavar="METHOD",
    type=click.Choice(_METHODS),
    default="ml",
    show_default=True,
    help="Method, one of those listed below; all compares them.",
)
@SOLVED_WITH
@click.option("--as-published", is_flag=True, help="Use Carlson's methods as published, without biases.")
@click.option("--wrench", metavar="FILE", type=FILE, help="In motion: separate table of the wrench.")
@click.option("--orientation-file", metavar="FILE", type=FILE, help="Table of the flange poses, with --wrench.")
@click.option(
    "--from",
    "earlier",
    metavar="RESULT",
    type=PATH,
    help="For a new tool: use mounting, base and gain of this result of the same sensor; 4 poses or 10 s of motion.",
)
@click.option(
    "--test",
    metavar="RUN",
    type=PATH,
    help="With --method all: show the largest errors on these poses of the free tool, as in Yu's Table III.",
)
@click.option(
    "--table-iii", "cases", is_flag=True, help=f"The 11 cases of Yu's Table III, from a run with  --set {EVERY_SET}."
)
@click.option("--together", "joined", is_flag=True, help="Combine runs of one tool, each with its own bias.")
@BAG_TOPICS
@TABLE
@click.option("--point-mass", is_flag=True, help="In motion: treat the load as a point mass.")
@click.option("--output", "-o", type=NewFile(), help="Save the calibration as a new file.")
@click.option("--force", is_flag=True, help="Also save a rejected result; it stays marked as rejected.")
@simulate("Solve a short run of an emulated cell.")
@EMULATED_SENSOR
@ALL
@JSON
def solve_command(
    sources: Sequence[Path],
    test: Path | None,
    cases: bool,
    joined: bool,
    output: Path | None,
    force: bool,
    simulate: bool,
    sensor: str | None,
    every: bool,
    as_json: bool,
    **chosen: Any,
) -> None:
    """Solve each DATASET: a run folder, the file of `ftdrive bundle`, a dataset.json, or a table of any program.

    A table has one row per pose: flange orientation, wrench, and optionally time and sigma_fx..sigma_tz, the standard
    error of each mean. Separator, decimal mark, names and units are recognised. Use --columns and the options below it
    for what the file does not contain. With --json, each line is one object.

    A DATASET may also be a recording in motion, which gives inertia and delay too: a file of `ftdrive record`, a table
    with wrench and pose, --wrench and --orientation-file on one clock, or a ROS 1 or ROS 2 bag.
    """
    check_simulate(simulate, real={"DATASET": sources, "--wrench": chosen["wrench"]}, emulated={"--sensor": sensor})
    given = {**chosen, "test": test, "cases": cases, "joined": joined, "output": output}
    options = SolveOptions.of_solve(sources, simulate=simulate, **given)
    sources = sources if options.pair is None else options.pair[:1]
    if joined:
        _solve_together(sources, options, output, force, every, as_json)
        return
    show: Callable[[SolveOptions, bool, Path, Path], None] = partial(_show_result, output, force, every)
    if cases:
        show = _show_cases
    elif options.method == "all":
        show = partial(_show_all, test, None if test is None else _poses_of(test, options))
    with _rehearsed_folder(sensor, options.method, cases=cases) if simulate else nullcontext() as run:
        _solve_each(sources if run is None else [run], options, show, as_json)
    if output is not None and sources and sources[0].is_dir():
        index_run(sources[0], messages.print)  # adds the result if it was saved in the run


def _poses_of(test: Path, options: SolveOptions) -> CalibrationDataset:
    with unpack(test) as place:
        return read_source(place, SolveOptions(orientation=options.orientation)).dataset


def _rehearsed_folder(sensor: str | None, method: str, *, cases: bool) -> AbstractContextManager[Path]:
    from ftdrive.session.rehearsal import rehearsed_run  # slow: imports the drivers and the screen
    from ftdrive.terminal.screen import open_operator

    poses = {"poses": 24 if method in (*SPECIAL, "all") else 6, "method": "ml" if method == "all" else method}
    return rehearsed_run(open_operator(), sensor, **({"sets": EVERY_SET} if cases else poses))


def _solve_each(
    sources: Sequence[Path],
    options: SolveOptions,
    show: Callable[[SolveOptions, bool, Path, Path], None],
    as_json: bool,
) -> None:
    first_failure: AcceptanceError | DataError | None = None
    for source in sources:
        # catch the error, so that the other sources are still solved
        try:
            with unpack(source) as place:
                show(options, as_json, source, place)
        except (AcceptanceError, DataError) as error:
            if len(sources) == 1:
                raise
            first_failure = first_failure or error
            if as_json and not isinstance(error, NotAccepted):
                write_json({"schema_version": 1, "source": str(source), "error": str(error)})
            # Add the source unless the error names it: an error about a file has its name, one about a solution none.
            is_named = isinstance(error, DataError) and [one.name for one in sources].count(source.name) == 1
            echo(in_one_line(f"error: {error}" if is_named else f"error: {source}: {error}"), err=True)
    if first_failure is not None:
        raise SystemExit(exit_code(first_failure))


def _show_result(
    output: Path | None, force: bool, every: bool, options: SolveOptions, as_json: bool, source: Path, place: Path
) -> None:
    data = read_place(place, options)
    if isinstance(data, RecordedData):
        _print_table(data.provenance)
    result, records = _solve_shown(data, options), data.records if isinstance(data, RecordedData) else ()
    if not isinstance(data, RecordedData):
        _print_table(result.provenance)
    if as_json:
        found = [one.to_dict() for one in hints(result, records)] if records else []
        write_json({"source": str(source), "hints": found, **result.to_dict()})
    else:
        print_result(result, drift=drift_check(records) if records else None, records=records, every=every)
        if not click.get_current_context().params["simulate"]:  # a simulated run is deleted
            messages.print_next(*_next_commands(result, source, output))
    _save(result, output, force, as_json)


def _next_commands(result: CalibrationResult, source: Path, output: Path | None) -> list[str]:
    why, context = "   (how good it is, and why)", click.get_current_context()
    if output is not None and (result.verdict != "rejected" or context.params["force"]):
        return [f"ftdrive report {quote(str(output))}{why}", f"ftdrive live --calibration {quote(str(output))}"]
    every, reported = (
        typed_options(context, [name for name in context.params if name not in _SAVING]),
        typed_options(context, REPORTED),
    )
    commands = []
    if every == reported and (source.is_dir() or result.motion is None):
        commands.append(f"ftdrive report {' '.join([quote(str(source)), *reported])}{why}")
    if result.verdict != "rejected" and not (source.is_dir() and commands):
        commands.append(f"ftdrive solve {' '.join([quote(str(source)), *every])} -o calibration.json   (to use it)")
    return commands


def _solve_shown(data: Any, options: SolveOptions) -> CalibrationResult:
    with working(f"Solving {counted(len(data.dataset), 'pose')}" if isinstance(data, RecordedData) else "Solving"):
        return solve_place(data, options)


def _print_table(provenance: Mapping[str, Any]) -> None:
    if words := provenance.get("table"):
        messages.print(indented(" ", f"{provenance.get('source') or ''}: {words}".removeprefix(": "), messages))


def _solve_together(
    sources: Sequence[Path], options: SolveOptions, output: Path | None, force: bool, every: bool, as_json: bool
) -> None:
    results = []
    for source in sources:
        with unpack(source) as place:
            data = read_place(place, options)
            if not isinstance(data, RecordedData):
                raise ConfigError(f"--together needs poses at rest, but {source} is in motion: leave out {source}")
            # without the earlier result of a run with a new tool, which would otherwise be counted once per run
            results.append(_solve_shown(replace(data, earlier=None), options))
    result = together(results)
    if as_json:
        write_json({"sources": [str(source) for source in sources], **result.to_dict()})
    else:
        print_result(result, every=every)
    _save(result, output, force, as_json)


def _save(result: CalibrationResult, output: Path | None, force: bool, as_json: bool) -> None:
    if not force:
        require_accepted(result, to_be_saved=output is not None)
    if output is not None:
        result.save(output)
        message_console(as_json).print(f" Saved {output}")


def _show_all(
    test: Path | None,
    tests: CalibrationDataset | None,
    options: SolveOptions,
    as_json: bool,
    source: Path,
    place: Path,
) -> None:
    data = read_place(place, options)
    assert isinstance(data, RecordedData)  # noqa: S101 - no recording in motion has this method
    with working("Solving with all methods"):
        compared = compare(
            data.dataset,
            drift=options.drift,
            known=data.known,
            g_m_s2=data.g_m_s2,
            setup=data.setup,
            as_published=options.as_published,
            test=tests,
            truth=data.truth,
        )
    if as_json:
        given = {"as_published": options.as_published, **({} if test is None else {"test_set": str(test)})}
        methods = [one.to_dict() for one in compared]
        write_json({"schema_version": 1, "source": str(source), **given, "methods": methods})
        return
    print_comparison(compared)
    if tests is not None:
        reference = "the truth of the emulated cell" if data.truth is not None else "ml"
        heading = f"Largest errors on the {len(tests)} poses of {test}; mg and centre against {reference}:"
        print_tests(("method",), [((one.method,), one) for one in compared], heading)


def _show_cases(options: SolveOptions, as_json: bool, source: Path, place: Path) -> None:
    data = read_source(place, options)
    if not data.records:
        raise ConfigError(
            f"--table-iii needs a run folder, and {source} is a file: record a run with `ftdrive calibrate --set "
            f"{EVERY_SET}`"
        )
    with working("Solving the cases of Table III"):
        cases = table_iii(data.dataset, numbers_in_dataset(data.records), data.truth, g_m_s2=data.g_m_s2)
    if as_json:
        rows = [{"case": number, "data": sets, "test_set": on, **one.to_dict()} for number, sets, on, one in cases]
        write_json({"schema_version": 1, "source": str(source), "cases": rows})
    else:
        print_cases(cases, known=data.truth is not None)
