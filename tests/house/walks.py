"""Draw four walks through the code for docs/contributing/walks.md: `uv run python tests/house/walks.py`.

`WALKS` is all there is to change. A row has a module, a function, class or method in it, and what happens there. Rows
stand in the order of the calls: a row above, which has not returned yet, must call the row. `~` marks a row that none
above calls, because a queue lies between. `tests/house/test_walks.py` checks this.
"""

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/contributing/walks.md"
PICTURES = ROOT / "docs/pictures"
FOLDERS = {"ftdrive": "ftdrive", "ftcalib": "calib", "ftdrivers": "drivers"}
COLOURS = {"ftdrive": "#2563a8", "ftcalib": "#9a5b13", "ftdrivers": "#2f7d4f"}

WALKS = {
    "From a cell to the first move": """
        ftdrive.commands.calibrate         calibrate                  reads the options
        ftdrive.commands.common            CellOptions.cell           merges options, environment, files
        ftdrive.cell.config                cell_of                    makes one configuration of them
        ftdrive.session.session            calibrate                  chooses the task by the mode
        ftdrive.session.session            take_poses                 holds the devices open
        ftdrive.cell.devices               build_sensor               makes the driver of a URL
        ftdrive.cell.devices               build_arm                  makes the driver of the arm
        ftdrivers.ur.arm                   UrArm.open                 connects, still without control
        ftdrive.session.session            _require_devices           compares serial numbers
        ftdrive.session.along_plan         take_along_plan            goes through the stages of a session
        ftdrive.planning.planner         certifier_for              describes arm, tool and surroundings
        ftdrive.session.session            Calibrating.plan           plans for the method
        ftdrive.planning.planner         plan_for                   chooses the kind of plan
        ftdrive.planning.planner           plan_tour                  finds poses, proves each move
        ftdrive.planning.approach          plan_approach              proves the way to the first pose
        ftdrive.session.preflight          check                      refuses a cell that is not ready
        ftcalib.data.dwell_mean            averaging_time             chooses the time at each pose
        ftdrive.session.watchdog           Watcher                    starts the thread of the guards
        ftdrive.session.along_plan         _SafetyQuestions.ask       asks what no device reports
        ftdrive.session.tour           GuardedCell                leads from a stop back to motion
        ftdrive.session.tour               Tour.run                   goes from stop to stop
        ftdrive.session.tour               Tour._move                 first move, after a typed word
        ftdrivers.ur.arm                   UrArm.move_to              watches the move to its end
        ftdrivers.ur.script_control        ScriptControl.call         writes the command into registers
    """,
    "From a sample to the screen": """
        ftdrivers.streaming.sensor         StreamingSensor._run       is the thread of the driver
        ftdrivers.ati.can                  AtiCanSensor._read_block   polls once; other sensors stream
        ftdrivers.ati.codec                decode_gauges              makes counts of bytes
        ftdrivers.ati.codec                Calibration.wrench         makes N and N·m of counts
        ftdrivers.streaming.sensor         StreamingSensor._publish   drops late and repeated rows
        ftdrivers.streaming.plausibility   Liveness.judge             finds a frozen sensor
        ftdrivers.follow                   Unread.put                 keeps every row for each follower
        ~ftdrive.terminal.live_feed        Feed._run                  is the thread that reads the stream
        ftdrive.live.stream                BlockReader.read           reads on after an interruption
        ftdrive.live.stream                CompensatedStream.read     waits for rows whose pose is known
        ftdrivers.follow                   Follow.read                takes the rows that wait
        ftdrive.live.pairing               Pairing.add_samples        puts them on the common clock
        ftdrive.live.pairing               Pairing.take               gives each row its pose
        ftdrive.live.stream                ProcessedStream._process_read  is shared with replays
        ftdrive.live.processing            Processor.process          runs the stages in chunks
        ftdrive.live.stages                FreeTool.predict           has bias and weight of a free tool
        ftdrive.live.contact               ContactTest.judge          tests the residual for contact
        ftdrive.live.stages                Filter                     filters, if a stage asks for it
        ftdrive.live.samples               FrameTransform             turns to the chosen axes and point
        ftdrive.live.samples               Block                      has what a consumer may need
        ftdrive.terminal.live_feed         Feed.take                  hands the block to screen and recorder
        ~ftdrive.terminal.canvas           Canvas.run                 sends the lines that changed
        ftdrive.terminal.live_screen       LiveScreen.draw            draws ten times a second
        ftdrive.terminal.live_view         Summary.view               means, peaks and history so far
        ftdrive.terminal.live_screen       frame                      places the panels
        ftdrive.terminal.live_panels       table                      writes numbers with their digits
    """,
    "From poses to a calibration": """
        ftdrive.commands.solve                    solve                    reads the options
        ftdrive.runs.source                       read_source              reads a run folder or a file
        ftdrive.runs.source                      _dataset_of              takes the poses of a run
        ftcalib.routine                           dataset_from             makes arrays of records
        ftdrive.tables.table                      Table.dataset            reads poses of another program
        ftcalib.solver                            solve                    chooses, fits, judges
        ftcalib.judge.observability               require_orientations     refuses poses that are alike
        ftcalib.data.dataset                      pooled_covariance        gives each pose its weight
        ftcalib.likelihood.fit                    fit                      maximises the likelihood
        ftcalib.likelihood.session                Session                  holds what all steps share
        ftcalib.likelihood.explanation            explain                  looks for what explains the noise
        ftcalib.likelihood.descent                Descent.minima           descends from every minimum
        ftcalib.likelihood.rotation_minima        minima                   finds those of the force cost
        ftcalib.likelihood.explanation            select                   adds components, drops others
        ftcalib.likelihood.variance_components    maximise                 estimates their variances
        ftcalib.likelihood.fit                    _fit_of                  adds covariance and response
        ftcalib.likelihood.explanation            rivals                   finds other explanations
        ftcalib.judge.verdict                     judge                    makes findings and verdict
        ftcalib.judge.faults                      faults                   names mistakes in the data
        ftcalib.judge.described_cell              tool                     compares with the described tool
        ftcalib.result                            CalibrationResult        keeps all with its provenance
        ftdrive.terminal.report                   print_result             prints estimates and verdict
    """,
    "From a recording to a calibration": """
        ftdrive.commands.solve                    solve                    reads the options
        ftdrive.recording.in_motion               solve_recording          chooses the reader
        ftdrive.recording.in_motion               _read_in_motion          goes through the file once
        ftdrive.recording.files                   RecordingReader          reads piece by piece
        ftcalib.motion.samples                    Means.add                keeps means of 10 ms
        ftcalib.motion.solve                      solve_motion             chooses, fits, judges
        ftcalib.motion.samples                    rows_of                  makes rows of both streams
        ftcalib.motion.estimate                   rough_delay              finds the delay to start from
        ftcalib.motion.estimate                   fit                      fits load, delay and inertia
        ftcalib.motion.model                      RowNoise.of              takes the noise from residuals
        ftcalib.motion.model                      wrench_of                predicts a load in motion
        ftcalib.judge.verdict                     judge                    judges rows as poses
        ftcalib.findings                          ordered                  ranks the findings
        ftcalib.result                            CalibrationResult        keeps all with its provenance
        ftdrive.terminal.report                   print_result             prints estimates and verdict
    """,
}


@dataclass(frozen=True, slots=True)
class Step:
    """A row of a walk; `depth` is that of its call, and `after_a_gap` that nothing above calls it."""

    module: str
    name: str
    words: str
    depth: int
    after_a_gap: bool


def steps_of(rows: str) -> list[Step]:
    """Return the steps of a walk. Raises `LookupError` if one does not exist, or if no row above calls it."""
    steps: list[Step] = []
    open_calls: list[tuple[str, str]] = []
    for row in rows.strip().splitlines():
        module, name, words = re.split(r"\s{2,}", row.strip())
        after_a_gap = module.startswith("~")
        module = module.removeprefix("~")
        require(module, name)
        if after_a_gap:
            open_calls = []
        while open_calls and not _ways_to_call(module, name) & called_by(*open_calls[-1]):
            open_calls.pop()
        if steps and not (open_calls or after_a_gap):
            raise LookupError(f"{module}.{name}: no row above calls it; correct the walk in {__file__}")
        steps.append(Step(module, name, words, len(open_calls), after_a_gap))
        open_calls.append((module, name))
    return steps


def require(module: str, name: str) -> None:
    """Raise `LookupError` unless the module has this function, class or method."""
    if name not in dict(_definitions(module)):
        raise LookupError(f"{module} has no {name}: correct the walk in {__file__}")


def called_by(module: str, name: str) -> set[str]:
    """Return how a definition, with its `__init__`, and what it uses of the same module call others.

    `.name` is a method, `name` and `module.name` a function or a class.
    """
    definitions, imported_as = dict(_definitions(module)), _imported_as(module)
    found: set[str] = set()
    seen = {name, f"{name.partition('.')[0]}.__init__"} & definitions.keys()
    todo = sorted(seen)
    while todo:
        names = _names(definitions[todo.pop()])
        found |= names
        own = {one for one in definitions if _ways_to_call(module, one) & names} - seen
        todo += sorted(own)
        seen |= own
    return found | {imported_as[one] for one in found & imported_as.keys()}


@cache
def _tree(module: str) -> ast.Module:
    package = module.partition(".")[0]
    path = ROOT / FOLDERS[package] / module.replace(".", "/")
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if not file.is_file():
        raise LookupError(f"there is no module {module}: correct the walk in {__file__}")
    return ast.parse(file.read_text(encoding="utf-8"))


def _imported_as(module: str) -> dict[str, str]:
    names = [one for one in ast.walk(_tree(module)) if isinstance(one, ast.alias)]
    return {one.asname: one.name for one in names if one.asname}


def _definitions(module: str) -> Iterator[tuple[str, ast.AST]]:
    for node in _tree(module).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, node
        if isinstance(node, ast.ClassDef):
            yield from ((f"{node.name}.{one.name}", one) for one in node.body if isinstance(one, ast.FunctionDef))


def _names(node: ast.AST) -> set[str]:
    found = set()
    for one in ast.walk(node):
        if isinstance(one, ast.Name):
            found.add(one.id)
        elif isinstance(one, ast.alias):
            found.add(one.name)
        elif isinstance(one, ast.Attribute):
            found.add(f".{one.attr}")
            if isinstance(one.value, ast.Name):
                found.add(f"{one.value.id}.{one.attr}")
    return found


def _ways_to_call(module: str, name: str) -> set[str]:
    owner, _, last = name.rpartition(".")
    return {f".{last}"} if owner else {name, f"{module.rpartition('.')[2]}.{name}"}


def picture(title: str, steps: list[Step]) -> str:
    """Return the call tree of a walk as SVG."""
    row, indent, left, top = 24, 18, 34, 34
    height = top + row * len(steps) + 10
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 800 {height}" role="img" font-size="12.5">',
        f"<title>{escape(title)}</title>",
        '<rect width="100%" height="100%" fill="#ffffff"/>',
        '<g font-family="ui-monospace, Consolas, monospace">',
    ]
    x = left
    for package, colour in COLOURS.items():
        lines.append(f'<rect x="{x}" y="10" width="12" height="12" rx="2" fill="{colour}"/>')
        lines.append(f'<text x="{x + 18}" y="20" fill="#444444">{package}</text>')
        x += 110
    last_at: list[int] = []
    for number, step in enumerate(steps):
        y, x = top + row * number + row // 2, left + indent * step.depth
        last_at[step.depth :] = [y]
        if step.depth:
            line = f"M{x - indent + 5},{last_at[step.depth - 1] + 8} V{y} H{x - 2}"
            lines.append(f'<path d="{line}" fill="none" stroke="#b4b4b4"/>')
        if step.after_a_gap:
            line = f'x1="{left}" y1="{y - row // 2}" x2="780" y2="{y - row // 2}"'
            lines.append(f'<line {line} stroke="#b4b4b4" stroke-dasharray="4 4"/>')
        colour = COLOURS[step.module.partition(".")[0]]
        lines.append(f'<text x="{left - 10}" y="{y + 4}" text-anchor="end" fill="#888888">{number + 1}</text>')
        lines.append(
            f'<text x="{x + 2}" y="{y + 4}" fill="{colour}"><tspan font-weight="bold">{escape(step.name)}</tspan>'
            f'<tspan fill="#888888" font-size="11">  {step.module.partition(".")[2]}</tspan></text>'
        )
        lines.append(f'<text x="500" y="{y + 4}" fill="#333333" font-family="sans-serif">{escape(step.words)}</text>')
    return "\n".join([*lines, "</g>", "</svg>", ""])


def files() -> dict[Path, str]:
    """Return the page and its pictures, as they should be on disk."""
    made: dict[Path, str] = {}
    page = [_HEAD]
    for title, rows in WALKS.items():
        steps = steps_of(rows)
        name = f"walk-{title.lower().replace(' ', '-')}.svg"
        made[PICTURES / name] = picture(title, steps)
        modules = len({step.module for step in steps})
        page.append(f"## {title}\n\n{len(steps)} steps in {modules} modules.\n\n![{title}](../pictures/{name})\n")
    made[PAGE] = "\n".join([*page, _END])
    return made


_HEAD = """# Four walks through the code

Each picture follows one thing through the program. The line of a row begins at the row that calls it. A dashed line is
a queue between two threads. Not every call is shown, but every shown call exists.

[Architecture](../explanation/architecture.md) has the packages and what each may import.
"""

_END = """`tests/house/test_walks.py` compares the rows with the code. After a change of the table in
`tests/house/walks.py`, run `uv run python tests/house/walks.py`.
"""

if __name__ == "__main__":
    for path, text in files().items():
        path.write_text(text, encoding="utf-8")
    sys.exit(0)
