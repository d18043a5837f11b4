"""Draw the plots of the pages of figures, from the tables of the same pages: `uv run python docs/plots.py`.

Picture and table cannot differ: `tests/house/test_pages.py` draws the plots again. Colours are of middle brightness, so
that a plot is readable on a white and on a dark page. The other drawings in `docs/pictures` are edited as SVG.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from html import escape
from math import log10
from pathlib import Path

ROOT = Path(__file__).parents[1]
FIGURES = "docs/contributing/figures"
GREY, BLUE, ORANGE, GREEN = "#7a7f87", "#2f7fd0", "#c8791e", "#2f9e5f"
NUMBER = re.compile(r"(?<![\w.])\d*\.?\d+")


def _rows(page: str, heading: str) -> list[list[str]]:
    """Return the cells of the first table below a heading, without its head."""
    text = (ROOT / page).read_text(encoding="utf-8").split(f"\n## {heading}\n", 1)[1]
    table = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]


def _numbers(cell: str) -> list[float]:
    return [float(number) for number in NUMBER.findall(cell)]


Row = tuple[str, Sequence[tuple[str, Sequence[float]]]]
"""Label, and the values of each colour; a line joins the values of one colour."""


def _line(x: float, y: float, u: float, v: float, colour: str = GREY, width: float = 2) -> str:
    style = f'fill="none" stroke="{colour}" stroke-width="{width:g}" stroke-linejoin="round"'
    return f'<path d="M{x:g},{y:g} L{u:g},{v:g}" {style}/>'


def _dot(x: float, y: float, colour: str) -> str:
    return f'<circle cx="{x:g}" cy="{y:g}" r="5" fill="{colour}" stroke="{colour}" stroke-width="2"/>'


def _text(x: float, y: float, words: str, colour: str = GREY, anchor: str = "start", weight: str = "") -> str:
    return f'<text x="{x:g}" y="{y:g}" fill="{colour}" text-anchor="{anchor}"{weight}>{escape(words)}</text>'


def _dots(title: str, rows: Sequence[Row], ticks: Sequence[float], key: Mapping[str, str], *, logarithmic: bool) -> str:
    """Draw a line of dots for each row above a common axis; `key` has the words of each colour."""
    left, right, row_px = 350, 840, 24
    bottom = 40 + row_px * len(rows)
    scale = log10 if logarithmic else float
    start, end = scale(ticks[0]), scale(ticks[-1])

    def x(value: float) -> float:
        return round(left + (right - left) * (scale(value) - start) / (end - start), 1)

    drawn = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 880 {50 + bottom}" role="img" '
        f'font-family="sans-serif" font-size="13">\n<title>{escape(title)}</title>',
        _text(20, 20, title, weight=' font-weight="bold"'),
    ]
    for tick in ticks:
        drawn += [_line(x(tick), 34, x(tick), bottom, width=0.5)]
        drawn += [_text(x(tick), bottom + 18, f"{tick:g}", anchor="middle")]
    for i, (label, series) in enumerate(rows):
        y = 52 + row_px * i
        drawn += [_text(left - 16, y + 5, label, anchor="end")]
        for colour, values in series:
            if len(values) > 1:
                drawn += [_line(x(min(values)), y, x(max(values)), y, colour)]
            drawn += [_dot(x(value), y, colour) for value in values]
    width = 20.0
    for colour, words in key.items():
        drawn += [_dot(width + 5, bottom + 32, colour), _text(width + 16, bottom + 36, words, colour)]
        width += 40 + 7.5 * len(words)
    return "\n".join([*drawn, "</svg>", ""])


def calibration() -> str:
    """Draw the force error of five methods in each session."""
    colours = (GREY, GREY, GREEN, ORANGE, BLUE)
    rows: list[Row] = []
    for session, *cells in _rows("README.md", "Accuracy"):
        found = [(colour, _numbers(cell)[:1]) for colour, cell in zip(colours, cells, strict=True) if _numbers(cell)]
        rows.append((session, found))
    key = {GREY: "10-parameter LS; Carlson", GREEN: "LROM", ORANGE: "SROM", BLUE: "ftdrive"}
    title = "Force error in poses that were not used, rms, mN"
    return _dots(title, rows, (50, 100, 1000, 10000, 30000), key, logarithmic=True)


def motion() -> str:
    """Draw error over sigma of calibrations from motion."""
    rows = _rows(f"{FIGURES}/motion.md", "Calibration from motion")
    found: list[Row] = [(label.partition(", which")[0], [(BLUE, sorted(_numbers(cell)))]) for label, cell, _ in rows]
    key = {BLUE: "smallest, overall and largest of 23 parameters; 1 is right"}
    return _dots("Error over sigma, 200 runs a row", found, (0.5, 1, 1.5, 2, 2.5, 3, 3.5), key, logarithmic=False)


def planning() -> str:
    """Draw the distances of the tours: certified, between hulls, between meshes."""
    rows: list[Row] = [
        (arm, [(BLUE, _numbers(certified)), (ORANGE, _numbers(hulls)[:1]), (GREEN, _numbers(meshes))])
        for arm, certified, hulls, meshes in _rows(f"{FIGURES}/planning.md", "Tours against meshes")
    ]
    key = {BLUE: "certified, of each tour", ORANGE: "smallest between hulls", GREEN: "smallest between meshes"}
    title = "Distance of the moving parts on all tours, mm; target 15 between hulls"
    return _dots(title, rows, (0, 15, 20, 25, 30, 35), key, logarithmic=False)


def devices() -> str:
    """Draw how soon a failure of arm or link is reported, and how soon the arm rests."""
    rows: list[Row] = []
    for event, reported, arm, _ in _rows(f"{FIGURES}/devices.md", "Failures of the arm"):
        if reported and _numbers(arm):
            label = event.partition(";")[0].partition(" (")[0].partition(", or")[0]
            rows.append((label, [(ORANGE, _numbers(arm)), (BLUE, _numbers(reported))]))
    key = {BLUE: "reported, target 0.5 s", ORANGE: "the arm rests, target 1 s where a stop can reach it"}
    return _dots(
        "Failures of the arm: seconds after the event", rows, (0, 0.25, 0.5, 0.75, 1, 1.25), key, logarithmic=False
    )


def fleet() -> str:
    """Draw after how many days a drift is found."""
    rows: list[Row] = [
        (case, [(BLUE, _numbers(days))]) for case, days, _ in _rows(f"{FIGURES}/fleet.md", "Drift") if _numbers(days)
    ]
    key = {BLUE: "median, 90 % and 99 % of 200 cells"}
    return _dots(
        "A drift of the bias is found after, days", rows, (0, 10, 20, 30, 40, 50, 60, 70, 80), key, logarithmic=False
    )


PLOTS: Mapping[str, Callable[[], str]] = {
    "figure-calibration": calibration,
    "figure-motion": motion,
    "figure-planning": planning,
    "figure-devices": devices,
    "figure-fleet": fleet,
}

if __name__ == "__main__":
    for name, draw in PLOTS.items():
        (ROOT / f"docs/pictures/{name}.svg").write_text(draw(), encoding="utf-8")
