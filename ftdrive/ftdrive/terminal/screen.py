"""The screen of a session in a terminal: state, progress, estimates, coverage, keys."""

import os
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from threading import RLock
from typing import Self, TextIO

import numpy as np
from rich.cells import cell_len
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from ftdrive.errors import Declined, SupervisorGone
from ftdrive.session.events import (
    Asked,
    Compared,
    Estimated,
    Event,
    GuardTripped,
    Key,
    Operator,
    Question,
    State,
    StateChanged,
)
from ftdrive.terminal.console import indented, messages
from ftdrive.terminal.keyboard import Keyboard
from ftdrive.terminal.operators import JsonOperator, PlainOperator, match_answer, not_an_answer, prompt, read_answer
from ftdrive.terminal.supervisor import Supervisor
from ftdrive.words.session import (
    ESTIMATES,
    OFF_SIGMA,
    SessionText,
    SessionView,
    coverage_in_words,
    differences,
    drift_so_far,
    in_words,
    pose_in_words,
    progress_in_words,
    residual_in_words,
    rounded_estimate,
    sigmas_of,
    state_in_words,
)
from ftdrive.words.text import TextLine, as_typed
from ftdrivers.interfaces import Array

REFRESH_HZ = 4
KEYS = {Key.KEEP: "finish", Key.REDO: "redo", Key.SKIP: "skip", Key.PAUSE: "pause", Key.STOP: "quit"}

_COLOUR = {"green": "bold green", "amber": "bold yellow", "red": "bold red"}
_FACES = ("+x", "-x", "+y", "-y", "+z", "-z")
_CUBE_WIDTH = 25
_TABLE_WIDTH = 53
_NUMBER_WIDTH = 9
_NARROWEST_BAR = 8


def draw_session(view: SessionView, now_s: float, *, width: int = 80, height: int = 24) -> Group:
    """Return the lines of a session's screen, at most `width` wide and `height` - 1 high, to leave one for the cursor.

    Each block of lines has a rank. If there is not enough room, the highest ranks are omitted; rank 0 always stays.
    """
    wide = width >= _TABLE_WIDTH + 1 + _CUBE_WIDTH
    blocks: list[tuple[int, list[Text]]] = [
        (0, [_session_title(view, now_s, width), *_state_lines(view, now_s, width)])
    ]
    if view.folder or view.last is not None:
        drift = drift_so_far(view)
        blocks += [
            (3, _last_pose(view)),
            (9, [_rule(width)]),
            *_finding_rows(view, width, with_cube=wide and height > 20),
            (5, [Text(f"drift  {drift.words}", drift.style)]),
        ]
    note = "" if view.note is None else in_words(view.note)
    blocks += [
        (1, _folded(view, note, width, "bold red" if isinstance(view.note, GuardTripped) else "yellow")),
        (9, [_rule(width)]),
        (0, _keys(view)),
        (0, _saved_lines(view, width)),
    ]
    while sum(len(lines) for _, lines in blocks) > height - 1 and max(number for number, _ in blocks) > 0:
        blocks.remove(max(blocks, key=lambda block: block[0]))
    lines = [line for _, some in blocks for line in some]
    for line in lines:
        line.plain = view.shown(line.plain)
        line.no_wrap, line.overflow = True, "crop"
        line.truncate(width, overflow="crop" if view.ascii_only else "ellipsis")
    return Group(*lines)


def _session_title(view: SessionView, now_s: float, width: int) -> Text:
    kept, right = view.kept, progress_in_words(view, now_s)
    name = f"ftdrive {view.command}"
    room = width - len(name) - len(right)
    if view.last is None or room < _NARROWEST_BAR + 4:
        return Text.assemble((name, "bold"), " " * max(room, 2), right)
    done = min(kept / view.last.stops, 1.0)
    filled = round((room - 4) * done)
    return Text.assemble(
        (name, "bold"), "  ", ("━" * filled, "green"), ("━" * (room - 4 - filled), "bright_black"), "  ", right
    )


def _state_lines(view: SessionView, now_s: float, width: int) -> list[Text]:
    where, state, words = state_in_words(view, now_s)
    stopped = view.now is not None and view.now.state in {State.STOP, State.HOLD}
    style = "" if view.now is None else "bold red" if stopped else "bold cyan"
    line = Text.assemble((f"{where}  " if where else "", "bold"), (state, style))
    if len(line) + 2 + len(words) > width:
        return [line, *_folded(view, words, width)]
    return [line.append(f"  {words}" if words else "")]


def _last_pose(view: SessionView) -> list[Text]:
    pose, fit = view.last, view.estimated
    if pose is None:
        return []
    line = Text(pose_in_words(pose), "" if pose.steady else "bold yellow")
    if view.compared:
        return [line]
    if fit is None or fit.residual_sigma is None:
        return [line, Text("     residual: no previous fit", "dim")]
    off = fit.residual_sigma > OFF_SIGMA
    residual = Text(f"     residual {residual_in_words(fit)}", "bold yellow" if off else "")
    return [line, residual.append(" OUTLIER: press r to redo" if off else "")]


def _finding_rows(view: SessionView, width: int, *, with_cube: bool) -> list[tuple[int, list[Text]]]:
    if view.command == "calibrate":
        return [*_estimate_rows(view, with_cube=with_cube), *_coverage_rows(view, width)]
    lines = [Text("measured minus predicted, ± one sigma expected", "dim")]
    for event in view.compared.values():
        force, torque, sigmas = differences(event)
        numbers = f"{force:>16} N {torque:>18} N·m {sigmas:>6} sigma"
        lines.append(
            Text.assemble(f"R{event.number:02d}", (numbers, "bold yellow" if sigmas_of(event) > OFF_SIGMA else ""))
        )
    hint = next(iter(reversed(view.compared.values()))).hint if view.compared else ""
    return [(1, lines), (4, _folded(view, hint, width))]


def _estimate_rows(view: SessionView, *, with_cube: bool) -> list[tuple[int, list[Text]]]:
    fit = view.estimated
    rows = [Text(f"{'estimate':<13}{'':27}{'± 1 sigma':>12}", "dim")]
    rows += [_estimate_text(fit, label, factor, name) for label, factor, name, _ in ESTIMATES]
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


def _estimate_text(fit: Estimated | None, label: str, factor: float, name: str) -> Text:
    values, sigma = rounded_estimate(fit, factor, name)
    if not sigma:
        return Text(f"{label:<13}{'-':>9}")
    numbers = "".join(f"{one:>{_NUMBER_WIDTH}}" for one in values)
    return Text(f"{label:<13}{numbers:<27}  ± {sigma}")


def _cube(counts: Sequence[int], newest: Array | None) -> list[str]:
    """Draw an unfolded cube whose faces are the flange axes, each with the number of poses with gravity along it."""
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


def _coverage_rows(view: SessionView, width: int) -> list[tuple[int, list[Text]]]:
    fit = view.estimated
    if fit is None:
        return [(1, [Text("coverage  nothing yet", "dim")])]
    line = Text.assemble("coverage  ", (fit.light.upper(), _COLOUR.get(fit.light, "bold")), coverage_in_words(fit))
    return [(1, [line]), (4, _folded(view, f"helps most: {fit.hint}" if fit.hint else "", width))]


def _keys(view: SessionView) -> list[Text]:
    end = "Ctrl-C ends; the poses are kept" if view.resume else "Ctrl-C ends"
    if view.keys != "live":
        return [Text(f"Enter sends the answer; {end}", "dim")] if view.keys == "asking" else []
    # list the keys only between the first and the last pose, because otherwise they are not read
    useful: set[Key] = set()
    if view.now is not None and view.now.stop is not None:
        # "finish" is only for hand guiding, where the number of poses is not fixed
        useful = set(KEYS) if view.now.stops is None else set(KEYS) - {Key.KEEP}
    line = Text()
    for key, word in KEYS.items():
        if key not in useful:
            continue
        line.append(f" {key.value} ", "reverse")
        line.append(f" {word.upper()} asked  " if key in view.waiting else f" {word}  ")
    line.append(end)
    return [line]


def _saved_lines(view: SessionView, width: int) -> list[Text]:
    if not view.folder:
        return [] if view.taken else [Text("nothing is stored yet: there is no run", "dim")]
    resume = as_typed(view.resume) or "start again: a recording in motion cannot be continued"
    return [Text("kept in " + _end_of(view.folder, width - 8)), Text("resume  " + _end_of(resume, width - 8))]


def _rule(width: int) -> Text:
    return Text("─" * width, "dim")


def _folded(view: SessionView, text: str, width: int, style: str = "") -> list[Text]:
    lines = textwrap.wrap(view.shown(text), width, max_lines=3, placeholder=view.shown(" …"))
    return [Text(line, style) for line in lines]


def _end_of(text: str, width: int) -> str:
    """Shorten a text to `width` from its beginning, because the paths of runs differ at their end."""
    return text if len(text) <= width else "…" + text[len(text) - width + 1 :]


class Screen:
    """An operator at a terminal. A frame shows the session; messages scroll above it, and questions appear below it.

    Questions are answered by lines. Without a `keyboard`, no keys are read during motion. With `verbose`, each check,
    the table of the plan and each pose are printed above the frame. `command` is "calibrate" or "verify".
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
        # ignore errors of drawing if the terminal is closed
        gone = suppress(OSError) if self.supervisor.absence() else nullcontext()
        with gone, self._stack:
            self._print(self._text.pending())
            # erase the frame, but keep it after an error, because it contains the command to resume
            self._live.transient = kind is None
            self._live.stop()
        if kind is None and self._view.folder:
            # a sweep takes no poses, so there are no averages to count
            kept = f"{len(self._view.taken)} averages" if self._view.taken else "everything"
            self._print([TextLine(" ✔ ", f"{kept} kept in {self._view.folder}", "green")])

    def show(self, event: Event) -> None:
        """Update the frame by an event, and print the event above it if it is part of the history."""
        with self._lock:
            self._view.update(event, self._clock())
        with self.supervisor.writing():
            self._print(self._text.lines(event) if _history(event, self._view) else self._text.pending())

    def ask(self, question: Question) -> str:
        """Ask a question below the frame, which is redrawn after the answer."""
        self.supervisor.expect_answer()
        suspended = self._keyboard.suspended() if self._keyboard is not None else nullcontext()
        with self.supervisor.writing():
            self._print(self._text.pending())
            self._view.keys = "asking"
            self._live.stop()
            with suspended:
                answer = self._answer(question)
        self._view.keys = "live"
        # a new display, because the old one would erase the lines of its last frame
        self._live = self._new_live()
        self._live.start(refresh=True)
        return answer

    def absence(self) -> str | None:
        """Return why no operator follows the session any more, or None; see `Operator`."""
        return self.supervisor.absence()

    @property
    def has_keys(self) -> bool:
        """Whether single keys are read during motion."""
        return self._keyboard is not None

    def pressed(self) -> Key | None:
        """Return the oldest key that was not returned yet; None if there is none."""
        return None if self._keyboard is None else self._keyboard.pressed()

    def _print(self, lines: Sequence[TextLine]) -> None:
        for line in lines:
            head, words = self._view.shown(line.head), self._view.shown(line.words)
            self._console.print(indented(head, words, self._console), style=line.style, soft_wrap=True)

    def _new_live(self) -> Live:
        return Live(console=self._console, get_renderable=self._frame, refresh_per_second=REFRESH_HZ)

    def _answer(self, question: Question) -> str:
        """Ask until an answer is valid, then erase question and frame, so that the next frame takes their place."""
        used = len(self._frame().renderables)
        while True:
            width = self._console.width
            *lines, last = Text(self._view.shown(prompt(question).rstrip()), "bold").wrap(self._console, width)
            for line in lines:
                self._console.print(line)
            self._console.print(last, end=" ", soft_wrap=True)
            try:
                typed = read_answer(self.supervisor, question)
            except (KeyboardInterrupt, Declined):
                # end the line of the prompt before the next message
                self._console.file.write("\n")
                raise
            used += len(lines) + (last.cell_len + 1 + cell_len(typed.rstrip("\n"))) // width + 1
            if (answer := match_answer(question, typed)) is not None:
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
            return draw_session(self._view, self._clock(), width=size.width, height=size.height)


def _history(event: Event, view: SessionView) -> bool:
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
    """Yield the operator of a session: JSON on request, a live screen on a terminal, else plain lines.

    The screen is drawn on stderr. A dumb terminal, `-q` and `live=False` give plain lines.
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
