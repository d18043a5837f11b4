"""The full-screen view of `ftdrive live`: the compensated wrench in a terminal, with keys.

`Feed` reads the stream in a thread. Ten times per second, `StreamSummary` takes the new data, and `draw_live` draws its
`View` as lines.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np

from ftdrive.checks.check import Check, check_calibration
from ftdrive.checks.sensor import AXES
from ftdrive.runs.verification import fitted_dataset
from ftdrive.stream.feed import SPANS_S, Feed, PlotColumns
from ftdrive.stream.samples import Axes, Point
from ftdrive.stream.sources import RecordingSource
from ftdrive.terminal import live_panels
from ftdrive.terminal.canvas import Canvas
from ftdrive.terminal.console import messages
from ftdrive.terminal.lines import CONTACT, FAINT, STRONG, Line, envelope, plot
from ftdrive.words.stream import StreamSummary, View, full_scale

_HELP = """\
 ftdrive live: the wrench on the tool, ten times per second

 now      mean of the last 0.1 s
 ± σ      one sigma of that mean: noise and calibration
 peak     extremes since p
 bars     scaled to the recent extremes

 t tare: change the bias so that a free tool reads zero        u undo the tare
 x axes: sensor, flange, base, tcp     a reference point: sensor, flange, tcp
 1 2 3 4 stages: bias, gravity, inertia, low-pass
 z freeze the screen; a recording continues
 b mark: text for recording and plots  r start or complete a recording
 p reset the peaks                     g span of the plots: 2, 10, 60, 600 s

 Emulated cell: f push the tool with 8 N for 1 s
 Replay: space pause    ← → seek 5 s    . next samples    + - speed
 Sensor alone (--raw): t subtracts the present mean; r saves a .csv
 Page in the browser (--view): v shows its QR code

 Plots: smallest and largest value of each column; dotted lines at 0 and at
        ± 1 sigma of a sample; ━ contact, ◆ mark, tare or change of stages

 Any key returns."""


def run_live(feed: Feed, checks: Sequence[Check] = (), address: str = "") -> None:
    """Read and show the open stream of a feed until the user quits; `checks` are findings not based on the stream.

    `address` is the address of the browser page, or empty. Raises `DeviceError` if the stream had failed when
    the user quit, and `SupervisorGone` if the terminal was closed.
    """
    info = feed.stream.info
    dataset = None
    if not info.is_raw:
        checks = [check_calibration(info.calibration, {"arm": info.arm, "sensor": info.sensor}), *checks]
        dataset = fitted_dataset(info.calibration, Path(info.calibration_name))
    screen = LiveScreen(feed, StreamSummary(feed, checks, dataset), address)
    try:
        screen.run()
    finally:
        for path in feed.recorded:
            messages.print(f" Recorded: {path}")
    if screen.failure is not None:
        raise screen.failure


class LiveScreen(Canvas):
    """Full-screen display of the stream of a `Feed`, with keys."""

    def __init__(self, feed: Feed, summary: StreamSummary, address: str = "") -> None:
        super().__init__(address)
        self._feed, self._summary = feed, summary

    def draw(self, width: int, height: int) -> list[Line]:
        """Return the lines that show the current state of the stream."""
        return draw_live(self._summary.view(), width, height, self.page())

    def turns(self) -> Iterator[object]:
        """Read the stream, for the screen and the browser page, until the screen is over."""
        return self._feed.turns(until=lambda: self.is_over)

    def act(self, key: str) -> None:
        """Perform the action of a key."""
        if key == "?":
            self.cover = [Line(text) for text in _HELP.split("\n")]
        elif key == "z":
            self._summary.is_frozen = not self._summary.is_frozen
        elif key == "p":
            self._summary.reset_peaks()
        elif key == "g":
            self._summary.span_s = SPANS_S[(SPANS_S.index(self._summary.span_s) + 1) % len(SPANS_S)]
        elif key == "b":
            mark = self._feed.stream.mark
            self.entry = (lambda text: self._feed.do(partial(mark, text)), "text, then Enter; Esc cancels", "")
        elif (action := _actions(self._feed).get(key)) is not None:
            self._feed.do(action)


_SEEK_S = 5.0


def _actions(feed: Feed) -> dict[str, Callable[[], object]]:
    stream = feed.stream
    found: dict[str, Callable[[], object]] = {
        "x": partial(feed.next_frame, "axes", get_args(Axes)),
        "a": partial(feed.next_frame, "about", get_args(Point)),
        "1": partial(feed.switch_stage, "bias"),
        "2": partial(feed.switch_stage, "gravity"),
        "3": partial(feed.switch_stage, "inertia"),
    }
    if stream.info.is_raw:
        words = "raw readings have no stages and no other axes: start with --calibration to get them"
        found = dict.fromkeys(found, partial(feed.note, words))
    found |= {"t": stream.tare, "u": stream.undo_tare, "4": partial(feed.switch_stage, "lowpass_Hz")}
    found |= {"r": feed.switch_recording, "f": feed.push_tool}
    if isinstance(replay := stream.source, RecordingSource):
        found |= {
            " ": replay.toggle,
            "left": lambda: replay.seek(replay.at_s - _SEEK_S),
            "right": lambda: replay.seek(replay.at_s + _SEEK_S),
            ".": replay.step,
            **dict.fromkeys("+=", lambda: setattr(replay, "speed", 2 * replay.speed)),
            "-": lambda: setattr(replay, "speed", replay.speed / 2),
        }
    return found


# On a terminal with at least this number of columns, the plots are drawn to the right of the table.
_WIDE = 120
_LEFT = 78
# Width of the labels at the left of a plot, in cells.
_GUTTER = 7
_LEAST_PLOT_ROWS, _LEAST_EVENTS = 3, 3


def draw_live(view: View, width: int, height: int, page: Line | None = None) -> list[Line]:
    """Return the live screen as `height` lines of `width` cells; `page` is the line with the browser page's address."""
    head = live_panels.head_lines(view, width, page)
    foot = live_panels.keys(view, width)
    rows = max(0, height - len(head) - 1)
    body = _wide_lines(view, width, rows) if width >= _WIDE else _narrow_layout(view, width, rows)
    return [line.fit(width) for line in [*head, *body, *[Line()] * (rows - len(body)), foot][:height]]


def _narrow_layout(view: View, width: int, rows: int) -> list[Line]:
    body = live_panels.component_table(view, width, with_trace=True)
    separator = Line("─" * width, FAINT)
    if rows - len(body) >= 3 * _LEAST_PLOT_ROWS + 10:
        plot_rows = min(7, (rows - len(body) - 10) // 3)
        body += _plots(view, width, 3 * plot_rows, across=2)
    links = [separator, *live_panels.links(view)]
    # leave the panel out unless the whole newest event, such as a refused tare, still fits below it
    if rows - len(body) - len(links) - 1 >= max(1, live_panels.newest_rows(view, width)):
        body += links
    if rows - len(body) >= 20:
        body += [separator, *live_panels.identity(view, width)]
    left = rows - len(body) - 1
    if left > 0:
        body += [separator, *live_panels.events(view, width, left)]
    return body[:rows]


def _wide_lines(view: View, width: int, rows: int) -> list[Line]:
    separator = Line("─" * _LEFT, FAINT)
    left = [*live_panels.component_table(view, _LEFT, with_trace=False), separator, *live_panels.links(view), separator]
    for extra in (live_panels.other_wrench_lines(view), live_panels.sphere(view), live_panels.identity(view, _LEFT)):
        if extra and rows - len(left) >= len(extra) + 1 + _LEAST_EVENTS:
            left += [*extra, separator]
    left += live_panels.events(view, _LEFT, max(0, rows - len(left)))
    right = _plots(view, width - _LEFT - 1, rows, across=1)
    right += [Line()] * (rows - len(right))
    return [
        Line().join(a.fit(_LEFT)).add("│", FAINT).join(b.fit(width - _LEFT - 1))
        for a, b in zip(left[:rows], right, strict=True)
    ]


def _plots(view: View, width: int, rows: int, *, across: int) -> list[Line]:
    """Draw the plots of all six components, `across` side by side, in `rows` lines; the last one is the time axis."""
    each, cells = (rows - 1) // (6 // across), width // across - _GUTTER - 1
    if each < 2 or cells < 8:
        return []
    columns = view.columns(2 * cells)
    full = [full_scale(columns, view.reading, first) for first in (0, 3)]
    drawn = [_plot_lines(view, columns, i, full[i // 3], each, with_value=across == 1) for i in range(6)]
    below = 6 // across
    beside = [parts for first in range(below) for parts in zip(*drawn[first::below], strict=True)]
    axis, half, lines = Line(" " * _GUTTER).add(f"-{columns.span}", FAINT), f"-{columns.span_s / 2:.0f}", []
    axis.to(_GUTTER + cells // 2 - len(half)).add(half, FAINT).to(_GUTTER + cells - 3).add("now", FAINT)
    for parts in (*beside, [axis] * across):
        line = Line()
        for part in parts:
            line.join(part.fit(width // across))
        lines.append(line)
    return lines


def _plot_lines(view: View, columns: PlotColumns, i: int, full: float, rows: int, *, with_value: bool) -> list[Line]:
    """Return the plot of one component: a line with contacts, marks and an optional value, then lines of Braille.

    The envelope of the samples is drawn over the zero line and the band of ±1 sigma of a single sample.
    """
    reading, unit = view.reading, "N" if i < 3 else "N·m"
    head = Line(f"{AXES[i]:>{_GUTTER - 1}} ", STRONG)
    if with_value and view.live is not None:
        head.add(f"{' ± '.join(live_panels.format_component(view.live, i))} {unit} ")
    contact, marks = columns.contact_cells, [column // 2 for column in columns.marks]
    cells, start = len(contact), head.width - _GUTTER
    text, styles = np.where(contact, "━", "─"), np.where(contact, CONTACT, FAINT)
    text[marks], styles[marks] = "◆", STRONG
    head.join(Line.of_cells(text[start:].tolist(), styles[start:].tolist()))

    rows -= 1
    under = np.zeros((4 * rows, 2 * cells), np.bool_)
    if reading is not None and np.isfinite(sigma := reading.sample_sigma[i]):
        for value in (-sigma, 0.0, sigma):
            flat = np.full(2 * cells, value)
            under |= envelope(flat, flat, rows, full)
    under[:, np.arange(2 * cells) % 4 > 0] = False
    under[::2, 2 * np.array(marks, np.intp)] = True
    lines = [head]
    for row, drawn in enumerate(plot(columns.low[i], columns.high[i], rows, full, contact, under)):
        label = f"{full:+g}" if row == 0 else f"{-full:+g}" if row == rows - 1 else "0" if row == rows // 2 else ""
        lines.append(Line(f"{label:>{_GUTTER - 1}} ", FAINT).join(drawn))
    return lines
