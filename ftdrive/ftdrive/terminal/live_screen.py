"""The live screen: the compensated wrench in a terminal, with keys.

`Feed` reads the stream in a thread. Ten times a second `Summary` takes what is new, and `frame` draws its `View` as
lines.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from ftdrive.checks.check import Check, check_calibration
from ftdrive.checks.sensor import AXES
from ftdrive.runs.verification import fitted_dataset
from ftdrive.terminal import live_panels
from ftdrive.terminal.canvas import Canvas
from ftdrive.terminal.console import messages
from ftdrive.terminal.lines import CONTACT, FAINT, STRONG, Line, characters, envelope, level
from ftdrive.terminal.live_feed import Feed, after
from ftdrive.terminal.live_view import SPANS_S, PlotColumns, Summary, View

_HELP = """\
 ftdrive live: the wrench on the tool, ten times a second

 now      mean of the last 0.1 s
 ± σ      one sigma of that mean: noise and calibration
 peak     extremes since p
 bars     their scale follows the recent extremes

 t tare: change the bias so that a free tool reads zero        u undo the tare
 x axes: sensor, flange, base, tcp     a reference point: sensor, flange, tcp
 1 2 3 4 stages: bias, gravity, inertia, low-pass
 z freeze the screen; a recording goes on
 b mark: text for recording and plots  r start or complete a recording
 p reset the peaks                     g span of the plots: 2, 10, 60, 600 s

 Emulated cell: f push the tool with 8 N for 1 s
 Replay: space pause    ← → seek 5 s    . next samples    + - speed
 Sensor alone (--raw): t subtracts the present mean; r saves a .csv
 Page in the browser (--view): v its QR code

 Plots: smallest and largest value of each column; dotted lines at 0 and at
        ± 1 sigma of a sample; ━ contact, ◆ mark, tare or change of stages

 Any key returns."""


def run_live(feed: Feed, checks: Sequence[Check] = (), address: str = "") -> None:
    """Show a stream until the user quits.

    Parameters
    ----------
    feed : Feed
        Of an open stream, which is read here and closed by the caller.
    checks : sequence of Check
        Findings about the cell that the stream does not know, such as "robot.payload".
    address : str
        Of the page in the browser, if there is one.

    Raises
    ------
    DeviceError
        The stream had failed when the user quit.
    SupervisorGone
        The terminal was closed.
    """
    info = feed.stream.info
    dataset = None
    if not info.is_raw:
        checks = [check_calibration(info.calibration, {"arm": info.arm, "sensor": info.sensor}), *checks]
        dataset = fitted_dataset(info.calibration, Path(info.calibration_name))
    screen = LiveScreen(feed, Summary(feed, checks, dataset), address)
    try:
        screen.run()
    finally:
        for path in feed.recorded:
            messages.print(f" Recorded: {path}")
    if feed.reader.failure is not None:
        raise feed.reader.failure


class LiveScreen(Canvas):
    """Draws what a `Feed` knows."""

    def __init__(self, feed: Feed, summary: Summary, address: str = "") -> None:
        super().__init__(address)
        self._feed, self._summary = feed, summary

    def draw(self, width: int, height: int) -> list[Line]:
        """Draw the present state; raises what has ended the thread that reads."""
        if self._feed.crash is not None:
            raise self._feed.crash
        return frame(self._summary.view(), width, height, self.page())

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Let the feed read."""
        self._feed.start()
        try:
            yield
        finally:
            self._feed.stop()

    def act(self, key: str) -> None:
        """Do what a key stands for."""
        if key == "?":
            self.cover = [Line(text) for text in _HELP.split("\n")]
        elif key == "z":
            self._summary.is_frozen = not self._summary.is_frozen
        elif key == "p":
            self._summary.reset_peaks()
        elif key == "g":
            self._summary.span_s = after(self._summary.span_s, SPANS_S)[0]
        elif key == "b":
            self.entry = partial(self._feed.request, "b"), "text of the mark, then Enter; Esc leaves", ""
        else:
            self._feed.request("space" if key == " " else key)


# From this width on the plots stand beside the table.
_WIDE = 120
_LEFT = 78
# Columns for the scale of a plot.
_GUTTER = 7
_LEAST_PLOT_ROWS, _LEAST_EVENTS = 3, 3


def frame(view: View, width: int, height: int, page: Line | None = None) -> list[Line]:
    """Draw the screen, with the address of a page in the browser.

    Returns
    -------
    list of Line
        `height` lines of `width` cells.
    """
    head = live_panels.head(view, width, page)
    foot = live_panels.keys(view, width)
    rows = max(0, height - len(head) - 1)
    body = _wide(view, width, rows) if width >= _WIDE else _narrow(view, width, rows)
    return [*head, *body, *[Line().to(width)] * (rows - len(body)), foot][:height]


def _narrow(view: View, width: int, rows: int) -> list[Line]:
    body = live_panels.table(view, width, with_trace=True)
    separator = Line("─" * width, FAINT)
    if rows - len(body) >= 3 * _LEAST_PLOT_ROWS + 10:
        plot_rows = min(7, (rows - len(body) - 10) // 3)
        body += _plots(view, width, 3 * plot_rows, across=2)
    links = [separator, *live_panels.links(view, width)]
    # a refusal is read to its end
    if rows - len(body) - len(links) - 1 >= max(1, live_panels.newest_rows(view, width)):
        body += links
    if rows - len(body) >= 20:
        body += [separator, *live_panels.identity(view, width)]
    left = rows - len(body) - 1
    if left > 0:
        body += [separator, *live_panels.events(view, width, left)]
    return body[:rows]


def _wide(view: View, width: int, rows: int) -> list[Line]:
    separator = Line("─" * _LEFT, FAINT)
    left = [*live_panels.table(view, _LEFT, with_trace=False), separator, *live_panels.links(view, _LEFT), separator]
    for extra in (live_panels.others(view, _LEFT), live_panels.sphere(view, _LEFT), live_panels.identity(view, _LEFT)):
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
    """Draw all six plots in `rows` lines, the last of which is the time axis."""
    each, cells = (rows - 1) // (6 // across), width // across - _GUTTER - 1
    if each < 2 or cells < 8:
        return []
    columns = view.columns(2 * cells)
    full = [live_panels.full_scale(columns, view.reading, first) for first in (0, 3)]
    drawn = [_plot(view, columns, i, full[i // 3], each, with_value=across == 1) for i in range(6)]
    below = 6 // across
    beside = [parts for first in range(below) for parts in zip(*drawn[first::below], strict=True)]
    lines = []
    for parts in (*beside, [_time_axis(columns, cells) for _ in range(across)]):
        line = Line()
        for part in parts:
            line.join(part.fit(width // across))
        lines.append(line.fit(width))
    return lines


def _time_axis(columns: PlotColumns, cells: int) -> Line:
    span, half = f"-{live_panels.span(columns)}", f"-{columns.span_s / 2:.0f}"
    line = Line(" " * _GUTTER).add(span, FAINT)
    line.to(_GUTTER + cells // 2 - len(half)).add(half, FAINT)
    return line.to(_GUTTER + cells - 3).add("now", FAINT)


def _plot(view: View, columns: PlotColumns, i: int, full: float, rows: int, *, with_value: bool) -> list[Line]:
    """Draw one component: a line with contacts, marks and perhaps the value, then `rows` - 1 lines of Braille.

    The envelope of the samples stands before the zero line and the band of ±1 sigma of a sample about it.
    """
    reading, unit = view.reading, "N" if i < 3 else "N·m"
    head = Line(f"{AXES[i]:>{_GUTTER - 1}} ", STRONG)
    if with_value and reading is not None and not view.silent:
        places = live_panels.decimals(reading, i // 3 * 3)
        head.add(f"{reading.wrench[i]:+z.{places}f} ± {live_panels.digits(reading.sigma[i], places)} {unit} ")
    contact = columns.contact_cells
    cells = len(contact)
    marks = {
        column // 2
        for note in view.notes
        if note.is_mark and note.t_host_ns is not None and (column := columns.column_of(note.t_host_ns)) is not None
    }
    shown = slice(head.width - _GUTTER, cells)
    text, styles = (["━" if it else "─" for it in contact], [CONTACT if it else FAINT for it in contact])
    for cell in marks:
        text[cell], styles[cell] = "◆", STRONG
    head.join(Line.of_cells(text[shown], styles[shown]))

    rows -= 1
    ink = characters(envelope(columns.low[i], columns.high[i], rows, full))
    under = np.zeros((4 * rows, 2 * cells), np.bool_)
    if reading is not None and np.isfinite(sigma := reading.sample_sigma[i]):
        for value in (-sigma, 0.0, sigma):
            if (dot := level(value, rows, full)) is not None:
                under[dot, ::4] = True
    under[::2, [2 * cell for cell in marks]] = True
    paper = characters(under)
    lines = [head]
    for row in range(rows):
        label = f"{full:+g}" if row == 0 else f"{-full:+g}" if row == rows - 1 else "0" if row == rows // 2 else ""
        line = Line(f"{label:>{_GUTTER - 1}} ", FAINT)
        lines.append(line.join(live_panels.layers(ink[row], paper[row], contact)))
    return lines
