"""The live screen as a whole: which parts are shown at which size, and the plots."""

import numpy as np

from ftdrive.checks.sensor import AXES
from ftdrive.terminal.live import panels
from ftdrive.terminal.live.lines import CONTACT, FAINT, STRONG, Line, characters, envelope, level
from ftdrive.terminal.live.view import PlotColumns, View

# From this width on the plots stand beside the table.
_WIDE = 120
_LEFT = 78
# Columns for the scale of a plot.
_GUTTER = 7
_LEAST_PLOT_ROWS, _LEAST_EVENTS = 3, 3


def frame(view: View, width: int, height: int) -> list[Line]:
    """Draw the screen.

    Returns
    -------
    list of Line
        `height` lines of `width` cells.
    """
    head = [
        panels.title(view, width),
        panels.provenance(view, width),
        panels.state(view, width),
        panels.rule(view, width),
    ]
    foot = panels.keys(view, width)
    rows = max(0, height - len(head) - 1)
    body = _wide(view, width, rows) if width >= _WIDE else _narrow(view, width, rows)
    return [*head, *body, *[Line().to(width)] * (rows - len(body)), foot][:height]


def plain(view: View, width: int) -> list[Line]:
    """Draw the table and the state of both links, without keys and events."""
    return [
        panels.title(view, width),
        panels.provenance(view, width),
        panels.state(view, width),
        panels.rule(view, width),
        *panels.table(view, width, with_trace=True),
        Line("─" * width, FAINT),
        *panels.links(view, width),
    ]


def _narrow(view: View, width: int, rows: int) -> list[Line]:
    body = panels.table(view, width, with_trace=True)
    separator = Line("─" * width, FAINT)
    if rows - len(body) >= 3 * _LEAST_PLOT_ROWS + 10:
        plot_rows = min(7, (rows - len(body) - 10) // 3)
        body += _plots(view, width, 3 * plot_rows, across=2)
    links = [separator, *panels.links(view, width)]
    # a refusal is read to its end
    if rows - len(body) - len(links) - 1 >= max(1, panels.newest_rows(view, width)):
        body += links
    if rows - len(body) >= 20:
        body += [separator, *panels.identity(view, width)]
    left = rows - len(body) - 1
    if left > 0:
        body += [separator, *panels.events(view, width, left)]
    return body[:rows]


def _wide(view: View, width: int, rows: int) -> list[Line]:
    separator = Line("─" * _LEFT, FAINT)
    left = [*panels.table(view, _LEFT, with_trace=False), separator, *panels.links(view, _LEFT), separator]
    for extra in (panels.others(view, _LEFT), panels.sphere(view, _LEFT), panels.identity(view, _LEFT)):
        if rows - len(left) >= len(extra) + 1 + _LEAST_EVENTS:
            left += [*extra, separator]
    left += panels.events(view, _LEFT, max(0, rows - len(left)))
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
    full = [panels.full_scale(columns, view.reading, first) for first in (0, 3)]
    drawn = [_plot(view, columns, i, full[i // 3], each, with_value=across == 1) for i in range(6)]
    lines = []
    for first in range(6 // across):
        beside = drawn[first::3] if across == 2 else [drawn[first]]
        for parts in zip(*beside, strict=True):
            line = Line()
            for part in parts:
                line.join(part.fit(width // across))
            lines.append(line.fit(width))
    axis = Line()
    for _ in range(across):
        axis.join(_time_axis(columns, cells).fit(width // across))
    return [*lines, axis.fit(width)]


def _time_axis(columns: PlotColumns, cells: int) -> Line:
    span, half = f"-{panels.span(columns)}", f"-{columns.span_s / 2:.0f}"
    line = Line(" " * _GUTTER).add(span, FAINT, "g")
    line.to(_GUTTER + cells // 2 - len(half)).add(half, FAINT)
    return line.to(_GUTTER + cells - 3).add("now", FAINT)


def _plot(view: View, columns: PlotColumns, i: int, full: float, rows: int, *, with_value: bool) -> list[Line]:
    """Draw one component: a line with contacts, marks and perhaps the value, then `rows` - 1 lines of Braille.

    The envelope of the samples stands before the zero line and the band of ±1 sigma of a sample about it.
    """
    reading, unit = view.reading, "N" if i < 3 else "N·m"
    head = Line(f"{AXES[i]:>{_GUTTER - 1}} ", STRONG)
    if with_value and reading is not None and not view.silent:
        places = panels.decimals(reading, i // 3 * 3)
        head.add(f"{reading.wrench[i]:+z.{places}f} ± {panels.digits(reading.sigma[i], places)} {unit} ")
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
        lines.append(line.join(panels.layers(ink[row], paper[row], contact)))
    return lines
