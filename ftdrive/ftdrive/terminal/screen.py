"""The live screen of a session: state, progress, estimates, coverage, keys."""

import os
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from threading import RLock
from typing import Literal, Self, TextIO

import numpy as np
from numpy.typing import ArrayLike
from rich.cells import cell_len
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text
from scipy.spatial.transform import Rotation

from ftcalib.rounding import decimals, to_place_of, with_sigma
from ftcalib.routine import DriftCheck
from ftdrive.errors import Declined, SupervisorGone
from ftdrive.session.events import (
    Asked,
    Compared,
    Estimated,
    Event,
    GuardTripped,
    Key,
    Noted,
    Operator,
    PoseTaken,
    Question,
    RunOpened,
    State,
    StateChanged,
    rms_sigma,
)
from ftdrive.session.live_fit import GREEN
from ftdrive.terminal.console import hanging, messages
from ftdrive.terminal.keyboard import Keyboard
from ftdrive.terminal.operators import JsonOperator, PlainOperator, match, not_an_answer, prompt, read_line
from ftdrive.terminal.report import drift_in_words
from ftdrive.terminal.session_text import SessionText, TextLine, in_words, sigmas_of
from ftdrive.terminal.supervisor import Supervisor
from ftdrive.terminal.text import as_typed
from ftdrivers.interfaces import Array

REFRESH_HZ = 4
KEYS = {Key.KEEP: "finish", Key.REDO: "redo", Key.SKIP: "skip", Key.PAUSE: "pause", Key.STOP: "quit"}

# Label and unit, factor from SI, name, and rank in `frame`: higher ranks are omitted first.
ESTIMATES = (
    ("mass kg", 1.0, "mass_kg", 1),
    ("centre mm", 1e3, "p_sensor_com_m", 2),
    ("F bias N", 1.0, "force_bias_N", 2),
    ("T bias N·m", 1.0, "torque_bias_Nm", 3),
    ("mounting deg", 180 / np.pi, "R_flange_sensor", 4),
    ("tilt a deg", 180 / np.pi, "tilt_alpha_rad", 6),
    ("tilt b deg", 180 / np.pi, "tilt_beta_rad", 6),
)
_COLOUR = {"green": "bold green", "amber": "bold yellow", "red": "bold red"}
_FACES = ("+x", "-x", "+y", "-y", "+z", "-z")
_CUBE_WIDTH = 25
_NUMBER_WIDTH = 9
_TABLE_WIDTH = 53
_NARROWEST_BAR = 8
_OFF_SIGMA = 5.0
# A standard deviation below this, N or N·m, comes from rounding: its value was not fitted.
_ROUNDED = 1e-9
_ASCII = str.maketrans(
    dict(zip("┌┐└┘├┤┬┴┼─│━", "+++++++++-|=", strict=True))
    | {"±": "+-", "°": " deg", "·": ".", "…": "~", "✔": "ok", "✘": "FAIL"}
)


@dataclass
class SessionView:
    """The state that the screen draws."""

    command: str = "calibrate"
    now: StateChanged | None = None
    since_s: float = 0.0
    """Start of the state, in the clock of `frame`."""
    folder: str = ""
    resume: str = ""
    taken: dict[int, tuple[PoseTaken, float]] = field(default_factory=dict)
    """By stop, with the time."""
    last: PoseTaken | None = None
    estimated: Estimated | None = None
    compared: dict[int, Compared] = field(default_factory=dict)
    """By stop, in a verification."""
    drift: DriftCheck | None = None
    note: Noted | GuardTripped | None = None
    tripped: bool = False
    """A guard has stopped the arm, and STOP and HOLD repeat its words."""
    waiting: tuple[Key, ...] = ()
    ascii_only: bool = False
    """The terminal's encoding is ASCII."""
    keys: Literal["live", "asking", "over"] = "live"
    """Whether keys are read now."""

    def update(self, event: Event, now_s: float) -> None:
        """Update the state from an event."""
        match event:
            case RunOpened():
                self.folder, self.resume = event.folder, event.resume
            case StateChanged():
                self.now, self.since_s = event, now_s
                self.tripped = self.tripped and event.state in {State.STOP, State.HOLD}
            case PoseTaken():
                self._take(event, now_s)
            case Estimated():
                self.estimated = event
            case Compared():
                self.compared[event.stop] = event
            case Noted(warning=True):
                self.note = event
            case GuardTripped():
                self.note, self.tripped = event, True

    def shown(self, text: str) -> str:
        """Replace what the terminal's encoding lacks, which lengthens the text: call it before measuring or cutting."""
        return text.translate(_ASCII) if self.ascii_only else text

    def _take(self, event: PoseTaken, now_s: float) -> None:
        self.taken[event.stop] = event, now_s
        self.last, self.note = event, None
        first, first_s = self.taken[min(self.taken)]
        if event.number == first.number and event.stop != first.stop:
            sigma = np.hypot(first.sigma, event.sigma)
            self.drift = DriftCheck(np.subtract(event.mean, first.mean), sigma, now_s - first_s)


def frame(view: SessionView, now_s: float, *, width: int = 80, height: int = 24) -> Group:
    """Draw the screen: never wider than `width`, never higher than `height` less one line for the cursor.

    If there is not enough room, blocks are omitted, the highest rank first. Blocks of rank 0 stay.
    """
    wide = width >= _TABLE_WIDTH + 1 + _CUBE_WIDTH
    blocks: list[tuple[int, list[Text]]] = [(0, [_title(view, now_s, width), *state_lines(view, now_s, width)])]
    if view.folder or view.last is not None:
        blocks += [
            (3, _last(view)),
            (9, [_rule(width)]),
            *_findings(view, width, with_cube=wide and height > 20),
            (5, [_drift(view)]),
        ]
    note = "" if view.note is None else in_words(view.note)
    blocks += [
        (1, _folded(view, note, width, "bold red" if isinstance(view.note, GuardTripped) else "yellow")),
        (9, [_rule(width)]),
        (0, _keys(view)),
        (0, _kept(view, width)),
    ]
    while sum(len(lines) for _, lines in blocks) > height - 1 and max(number for number, _ in blocks) > 0:
        blocks.remove(max(blocks, key=lambda block: block[0]))
    lines = [line for _, some in blocks for line in some]
    for line in lines:
        line.plain = view.shown(line.plain)
        line.no_wrap, line.overflow = True, "crop"
        line.truncate(width, overflow="crop" if view.ascii_only else "ellipsis")
    return Group(*lines)


def _kept_poses(view: SessionView) -> int:
    return max(len(view.taken), view.estimated.poses if view.estimated else 0)  # more if resumed


def progress_in_words(view: SessionView, now_s: float) -> str:
    """Return how many poses are kept, and how long the others take, in the clock of `SessionView.since_s`."""
    times_s = sorted(at_s for _, at_s in view.taken.values())
    kept = _kept_poses(view)
    left = view.last.stops - kept if view.last else 0
    if len(times_s) <= 2 or left <= 0:
        return f"{kept} kept"
    # a stop with questions takes longer than usual
    usual_s = median(b - a for a, b in pairwise(times_s))
    # a hold does not shorten the rest
    rest_s = usual_s * left - min(now_s - times_s[-1], usual_s)
    return f"{kept} kept, about {_minutes(rest_s)} left"


def _title(view: SessionView, now_s: float, width: int) -> Text:
    kept, right = _kept_poses(view), progress_in_words(view, now_s)
    name = f"ftdrive {view.command}"
    room = width - len(name) - len(right)
    if view.last is None or room < _NARROWEST_BAR + 4:
        return Text.assemble((name, "bold"), " " * max(room, 2), right)
    done = min(kept / view.last.stops, 1.0)
    filled = round((room - 4) * done)
    return Text.assemble(
        (name, "bold"), "  ", ("━" * filled, "green"), ("━" * (room - 4 - filled), "bright_black"), "  ", right
    )


def state_lines(view: SessionView, now_s: float, width: int) -> list[Text]:
    """Return the state of the session, in lines of at most `width`."""
    now = view.now
    if now is None:
        return [Text("recording" if view.folder else "starting")]
    if view.keys == "asking" and now.state in {State.MOVE, State.SETTLE, State.SAMPLE}:
        # the motion before the question is over
        return [Text("WAITS for an answer", "bold cyan")]
    line = Text()
    if now.stop is not None:
        line.append(f"pose {now.stop}/{now.stops}" if now.stops is not None else f"pose {now.stop}", "bold")
        line.append(f" R{now.number:02d}  " if now.number is not None else "  ")
    stopped = now.state in {State.STOP, State.HOLD}
    line.append(now.state.upper(), "bold red" if stopped else "bold cyan")
    line.append(f"  {_minutes(now_s - view.since_s)}" if now.state is not State.HOLD else "")
    words = "" if view.tripped else now.words
    if len(line) + 2 + len(words) > width:
        return [line, *_folded(view, words, width)]
    line.append(f"  {words}" if words else "")
    return [line]


def _last(view: SessionView) -> list[Text]:
    pose, fit = view.last, view.estimated
    if pose is None:
        return []
    force_N, torque_Nm = rms_sigma(pose.sigma)
    line = Text(
        f"R{pose.number:02d}: settled {pose.settle_s:.1f} s, {pose.samples} samples, "
        f"sigma {force_N:.2g} N {to_place_of(torque_Nm, torque_Nm)} N·m"
    )
    if pose.attempts > 1:
        line.append(f", {pose.attempts} tries")
    if not pose.steady:
        line.append(", NOT STEADY", "bold yellow")
    if view.compared:
        return [line]
    if fit is None or fit.residual_sigma is None or fit.residual_force_N is None:
        return [line, Text("     residual: no fit before it", "dim")]
    off = fit.residual_sigma > _OFF_SIGMA
    residual = Text("     residual ")
    residual.append(f"{fit.residual_force_N:.3f} N, {fit.residual_sigma:.1f} sigma", "bold yellow" if off else "")
    residual.append(" OUT OF LINE: press r to redo" if off else " against the fit before it")
    return [line, residual]


def _findings(view: SessionView, width: int, *, with_cube: bool) -> list[tuple[int, list[Text]]]:
    if view.command == "calibrate":
        return [*_estimates(view, with_cube=with_cube), *_coverage(view, width)]
    lines = [Text("measured minus predicted, ± one sigma expected", "dim")]
    for event in view.compared.values():
        size, expected = (
            (np.linalg.norm(vector[:3]), np.linalg.norm(vector[3:])) for vector in (event.residual, event.sigma)
        )
        sigmas = sigmas_of(event)
        numbers = f"{size[0]:8.3f} ± {expected[0]:.3f} N {size[1]:9.4f} ± {expected[1]:.4f} N·m {sigmas:6.1f} sigma"
        lines.append(Text.assemble(f"R{event.number:02d}", (numbers, "bold yellow" if sigmas > _OFF_SIGMA else "")))
    hint = next(iter(reversed(view.compared.values()))).hint if view.compared else ""
    return [(1, lines), (4, _folded(view, hint, width))]


def _estimates(view: SessionView, *, with_cube: bool) -> list[tuple[int, list[Text]]]:
    fit = view.estimated
    rows = [Text(f"{'estimate':<13}{'':27}{'± 1 sigma':>12}", "dim")]
    rows += [_estimate(fit, label, factor, name) for label, factor, name, _ in ESTIMATES]
    newest = view.last.gravity_flange if view.last else None
    counts = (0,) * 6 if fit is None else fit.faces
    if with_cube:
        cube = [Text("gravity by flange axis", "dim"), *(Text(line) for line in _cube(counts, newest))]
        for row, picture in zip(rows, cube, strict=True):
            row.plain = view.shown(row.plain)
            row.truncate(_TABLE_WIDTH, pad=True)
            row.append(" ")
            row.append_text(picture)
        return [(0, rows)]
    seen = " ".join(f"{name} {count}" for name, count in zip(_FACES, counts, strict=True))
    each = [(number, [row]) for row, (*_, number) in zip(rows[1:], ESTIMATES, strict=True)]
    return [(7, rows[:1]), *each, (4, [Text(f"gravity along {seen}")])]


def _estimate(fit: Estimated | None, label: str, factor: float, name: str) -> Text:
    values, sigma = rounded_estimate(fit, factor, name)
    if not sigma:
        return Text(f"{label:<13}{'-':>9}")
    numbers = "".join(f"{one:>{_NUMBER_WIDTH}}" for one in values)
    return Text(f"{label:<13}{numbers:<27}  ± {sigma}")


def rounded_estimate(fit: Estimated | None, factor: float, name: str) -> tuple[list[str], str]:
    """Return the values of an estimate times `factor`, and their largest sigma; nothing before there is a fit."""
    if fit is None or name not in fit.values:
        return [], ""
    value: ArrayLike = fit.values[name]
    if name == "R_flange_sensor":
        value = Rotation.from_matrix(np.asarray(value)).as_rotvec()
    values, sigma = factor * np.atleast_1d(value), factor * float(np.max(fit.sigma[name]))
    digits = decimals(sigma)
    while digits and len(f"{-np.abs(values).max():.{digits}f}") > _NUMBER_WIDTH - 1:
        digits -= 1
    return [f"{one:.{digits}f}" for one in values], to_place_of(sigma, sigma)


def _cube(counts: Sequence[int], newest: Array | None) -> list[str]:
    """Draw the unfolded cube of the flange axes, with the number of poses that had gravity along each."""
    face = None
    if newest is not None:
        axis = int(np.abs(newest).argmax())
        face = 2 * axis + int(newest[axis] < 0)
    cells = {
        name: f"{name}{count or '-':>2}{'*' if k == face else ' '}"
        for k, (name, count) in enumerate(zip(_FACES, counts, strict=True))
    }
    return [
        "      ┌─────┐  * newest",
        f"      │{cells['+y']}│  - none yet",
        "┌─────┼─────┼─────┬─────┐",
        f"│{cells['-x']}│{cells['+z']}│{cells['+x']}│{cells['-z']}│",
        "└─────┼─────┼─────┴─────┘",
        f"      │{cells['-y']}│",
        "      └─────┘",
    ]


def _coverage(view: SessionView, width: int) -> list[tuple[int, list[Text]]]:
    fit = view.estimated
    if fit is None:
        return [(1, [Text("coverage  nothing yet", "dim")])]
    line = Text("coverage  ")
    line.append(fit.light.upper(), _COLOUR.get(fit.light, "bold"))
    for name, what in (("cond9", "condition"), ("cond_u1", "out of plane")):
        value, goal = getattr(fit, name), GREEN[name]
        line.append(f"   {what} {value:.1f}" if value < 100 else f"   {what} >100")
        line.append("" if value <= goal else f" (goal {goal:g})")
    line.append(f"   gap {fit.empty_cap_deg:.0f}°")
    return [(1, [line]), (4, _folded(view, f"helps most: {fit.hint}" if fit.hint else "", width))]


def _drift(view: SessionView) -> Text:
    fit = view.estimated
    if view.drift is not None:
        words, bad = drift_in_words(view.drift)
        return Text(f"drift  {words}", "bold yellow" if bad else "")
    if fit is None or not fit.values:
        when = "the fit" if view.command == "calibrate" else "the first pose is measured again"
        return Text(f"drift  not known before {when}", "dim")
    if "drift" not in fit.values:
        return Text("drift  none seen so far")
    change, sigma = fit.values["drift"], fit.sigma["drift"]
    fitted = sigma > _ROUNDED
    sure = bool((np.abs(change) > 4 * sigma)[fitted].any())
    parts = [
        f"{with_sigma(np.linalg.norm(change[some]), np.max(sigma[some]))} {unit}"
        for some, unit in ((slice(3), "N"), (slice(3, 6), "N·m"))
        if fitted[some].any()
    ]
    words = f"drift  {', '.join(parts)} since the first pose"
    return Text(words if sure else f"{words}, perhaps", "yellow" if sure else "")


def _keys(view: SessionView) -> list[Text]:
    end = "Ctrl-C ends, poses are kept" if view.resume else "Ctrl-C ends"
    if view.keys != "live":
        return [Text(f"Enter sends the answer; {end}", "dim")] if view.keys == "asking" else []
    # before and after the poses no key is read
    useful: set[Key] = set()
    if view.now is not None and view.now.stop is not None:
        # by hand there is no last one
        useful = set(KEYS) if view.now.stops is None else set(KEYS) - {Key.KEEP}
    line = Text()
    for key, word in KEYS.items():
        if key not in useful:
            continue
        line.append(f" {key.value} ", "reverse")
        line.append(f" {word.upper()} asked  " if key in view.waiting else f" {word}  ")
    line.append(end)
    return [line]


def _kept(view: SessionView, width: int) -> list[Text]:
    if not view.folder:
        return [] if view.taken else [Text("nothing is kept yet: there is no run", "dim")]
    resume = as_typed(view.resume) or "starts again: a recording in motion is not continued"
    return [Text("kept in " + _end_of(view.folder, width - 8)), Text("resume  " + _end_of(resume, width - 8))]


def _rule(width: int) -> Text:
    return Text("─" * width, "dim")


def _folded(view: SessionView, text: str, width: int, style: str = "") -> list[Text]:
    lines = textwrap.wrap(view.shown(text), width, max_lines=3, placeholder=view.shown(" …"))
    return [Text(line, style) for line in lines]


def _end_of(text: str, width: int) -> str:
    """Shorten a path at its beginning: its end distinguishes runs."""
    return text if len(text) <= width else "…" + text[len(text) - width + 1 :]


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 59.5 else f"{int(seconds) // 60}:{int(seconds) % 60:02d} min"


class Screen:
    """An operator at a terminal: messages scroll above a frame, questions are asked below it.

    Parameters
    ----------
    console : rich Console
        A terminal.
    keyboard : Keyboard, optional
        Without it there are no keys; questions are still answered by lines.
    verbose : bool
        Print every check, the table of the plan and each pose above the frame.
    command : str
        The task: "calibrate" or "verify".
    """

    pressed_by = "the operator"

    def __init__(
        self,
        console: Console,
        keyboard: Keyboard | None = None,
        *,
        stdin: TextIO | None = None,
        verbose: bool = False,
        command: str = "calibrate",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._console, self._keyboard = console, keyboard
        self.supervisor = Supervisor(stdin or sys.stdin, console.file, "standard error")
        self._clock = clock
        self._view = SessionView(command, ascii_only=console.options.ascii_only)
        self._text = SessionText(verbose=verbose, poses=False)
        self._lock = RLock()
        self._live = self._new_live()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            if self._keyboard is not None:
                stack.enter_context(self._keyboard)
            self._live.start()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._view.keys = "over"
        # nothing is drawn any more
        gone = suppress(OSError) if self.supervisor.absence() else nullcontext()
        with gone, self._stack:
            self._print(self._text.pending())
            # after an error the frame stays: it has the command to resume
            self._live.transient = kind is None
            self._live.stop()
        if kind is None and self._view.folder:
            # a sweep has no averages
            kept = f"{len(self._view.taken)} averages" if self._view.taken else "everything"
            self._print([TextLine(" ✔ ", f"{kept} kept in {self._view.folder}", "green")])

    def show(self, event: Event) -> None:
        """Show an event."""
        with self._lock:
            self._view.update(event, self._clock())
        with self.supervisor.writing():
            self._print(self._text.lines(event) if _history(event, self._view) else self._text.pending())

    def ask(self, question: Question) -> str:
        """Ask below the frame, which is not redrawn until the answer is there."""
        self.supervisor.expect_answer()
        suspended = self._keyboard.suspended() if self._keyboard is not None else nullcontext()
        with self.supervisor.writing():
            self._print(self._text.pending())
            self._view.keys = "asking"
            self._live.stop()
            with suspended:
                answer = self._answer(question)
        self._view.keys = "live"
        # the old one would erase the lines of its last frame
        self._live = self._new_live()
        self._live.start(refresh=True)
        return answer

    def absence(self) -> str | None:
        """Return why the session is not followed any more; see `Operator`."""
        return self.supervisor.absence()

    @property
    def has_keys(self) -> bool:
        """Whether keys are read."""
        return self._keyboard is not None

    def pressed(self) -> Key | None:
        """Return the oldest unread key, or None."""
        return None if self._keyboard is None else self._keyboard.pressed()

    def _print(self, lines: Sequence[TextLine]) -> None:
        for line in lines:
            head, words = self._view.shown(line.head), self._view.shown(line.words)
            self._console.print(hanging(head, words, self._console), style=line.style, soft_wrap=True)

    def _new_live(self) -> Live:
        return Live(console=self._console, get_renderable=self._frame, refresh_per_second=REFRESH_HZ)

    def _answer(self, question: Question) -> str:
        """Ask until there is an answer, then erase question and frame: the next frame is drawn in their place."""
        used = len(self._frame().renderables)
        while True:
            width = self._console.width
            *lines, last = Text(self._view.shown(prompt(question).rstrip()), "bold").wrap(self._console, width)
            for line in lines:
                self._console.print(line)
            self._console.print(last, end=" ", soft_wrap=True)
            try:
                typed = read_line(self.supervisor, question)
            except (KeyboardInterrupt, Declined):
                # the next message begins on a new line
                self._console.file.write("\n")
                raise
            used += len(lines) + (last.cell_len + 1 + cell_len(typed.rstrip("\n"))) // width + 1
            if (answer := match(question, typed)) is not None:
                break
            other = Text(self._view.shown(not_an_answer(question, typed)))
            self._console.print(other, crop=True, no_wrap=True)
            used += 1
        self._console.file.write(f"\x1b[{used}F\x1b[J")
        return answer

    def _frame(self) -> Group:
        size = self._console.size
        with self._lock:
            self._view.waiting = () if self._keyboard is None else self._keyboard.waiting
            return frame(self._view, self._clock(), width=size.width, height=size.height)


def _history(event: Event, view: SessionView) -> bool:
    """Whether an event is printed above the frame, where the frame does not show it already."""
    match event:
        case StateChanged():
            return event.state is State.HOLD and not view.tripped
        case Asked():
            return event.answer != ""
        case Estimated() | Compared():
            return False
        case _:
            return True


@contextmanager
def open_operator(*, as_json: bool = False, command: str = "calibrate", live: bool = True) -> Iterator[Operator]:
    """Choose the operator of a task: JSON if requested, a live screen in a terminal, otherwise plain lines.

    The screen is drawn on stderr. A dumb terminal, `-q` and tasks that are not `live` get plain lines.
    """
    if as_json:
        scripted = JsonOperator()
        with scripted.supervisor:
            yield scripted
        return
    if not live or messages.quiet or not messages.is_terminal or messages.is_dumb_terminal or not os.isatty(0):
        operator = PlainOperator(quiet=messages.quiet, verbose=messages.verbose)
        with operator.supervisor:
            try:
                yield operator
            finally:
                with suppress(SupervisorGone):
                    operator.finish()
        return
    keyboard = Keyboard(0) if Keyboard.usable(0) else None
    with Screen(messages, keyboard, verbose=messages.verbose, command=command) as screen, screen.supervisor:
        yield screen
