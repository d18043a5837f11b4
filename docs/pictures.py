"""Draw the pictures of the documentation: `uv run python -m docs.pictures [NAME]...`, all without a name.

demo      runs `ftdrive demo` in tmux at 80x40, copies its screen about once a second, and animates the screens as SVG
live      draws the screen of `ftdrive live` with a stream without devices, one SVG for each of its states
weigh     draws the screen of `ftdrive weigh` with a weight
report    calibrates an emulated cell, and photographs the head of `ftdrive report` in Chromium (group browser)
fleet     photographs the page of `ftdrive fleet status` for four cells, one of which drifts
tour      stick figures of `ftdrive plan`, and the sweep of `ftdrive demo --sweep`

Tests of the browser draw the pages of --view: `PICTURES=docs/pictures uv run pytest -m browser tests/browser`.
"""

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from html import unescape
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, cast, get_args

import numpy as np
from rich.console import Console
from rich.text import Text

from ftdrive.fleet.page import fleet_page
from ftdrive.stream.weighing import ScaleState
from ftdrive.terminal.canvas import Canvas
from tests.benchmarks.common import show
from tests.unit.ftdrive.fleet.fleet_records import cell, daily, fleet, observed, result
from tests.unit.ftdrive.terminal.fake_stream import INFO, Scenario
from tests.unit.ftdrive.terminal.test_live_screen import Screen
from tests.unit.ftdrive.terminal.test_weigh_screen import PART, FakeWeighing, Scale

FOLDER = Path(__file__).parent / "pictures"
COLUMNS, ROWS, DEMO_ROWS = 80, 24, 40
CELL_PX, ROW_PX = 12.2, 24.4
"""Of rich's SVG, whose characters are 20 px high."""

# The animated demo

SHOWN_S, LAST_SHOWN_S = 1.0, 8.0
MOST_SCREENS = 12
TMUX = ("tmux", "-L", "ftdrive-demo")

# rich fills in its own fields; what is ours stands between @.
STRIP = """\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} @height@" role="img" aria-label="ftdrive demo">
<style>
.{unique_id}-matrix {{ font-family: "DejaVu Sans Mono", Menlo, Consolas, monospace; font-size: {char_height}px; }}
{styles}
.strip {{ transform: translateY(-@last@px); animation: strip @total@s infinite step-end; }}
@keyframes strip {{ @keyframes@ }}
</style>
<rect width="100%" height="100%" rx="8" fill="#292929"/>
<svg x="12" y="12" width="@inner_width@" height="@inner_height@">
<g class="strip {unique_id}-matrix">{backgrounds}{matrix}</g>
</svg>
</svg>
"""


def screens() -> list[str]:
    """Run the demo; return its distinct screens with their colours, the last one when the prompt is back."""
    command = 'echo "$ uv run ftdrive demo"; uv run -q ftdrive demo; printf READY; sleep 60'
    subprocess.run([*TMUX, "new-session", "-d", "-x", str(COLUMNS), "-y", str(DEMO_ROWS), command], check=True)
    found: list[str] = []
    try:
        while not (found and "READY" in found[-1]):
            time.sleep(0.7)
            screen = subprocess.run(
                [*TMUX, "capture-pane", "-p", "-e"], check=True, capture_output=True, text=True
            ).stdout
            if screen.strip() and screen not in found:
                found.append(screen)
    finally:
        subprocess.run([*TMUX, "kill-server"], check=False)
    return [screen.replace("READY", "") for screen in found]


def chosen(found: list[str]) -> list[str]:
    """Thin out the screens evenly; the last one stays."""
    step = max(1, -(-(len(found) - 1) // (MOST_SCREENS - 1)))
    return [*found[:-1:step], found[-1]]


def animated(strip: list[str]) -> str:
    """Draw all screens in one column; the animation shows one at a time. Without animation the last one is shown."""
    console = Console(width=COLUMNS, record=True, file=StringIO(), force_terminal=True)
    for screen in strip:
        lines = screen.split("\n")[:DEMO_ROWS]
        for line in [*lines, *[""] * (DEMO_ROWS - len(lines))]:
            console.print(Text.from_ansi(line), no_wrap=True, crop=True, soft_wrap=False)
    screen_px, total_s = DEMO_ROWS * ROW_PX, SHOWN_S * (len(strip) - 1) + LAST_SHOWN_S
    frames = " ".join(
        f"{100 * SHOWN_S * i / total_s:.2f}% {{{{ transform: translateY({-screen_px * i:g}px) }}}}"
        for i in range(len(strip))
    )
    code = STRIP.replace("@keyframes@", frames).replace("@total@", f"{total_s:g}")
    code = code.replace("@last@", f"{screen_px * (len(strip) - 1):.1f}").replace("@height@", f"{screen_px + 24:.0f}")
    code = code.replace("@inner_width@", f"{CELL_PX * COLUMNS + 2:.0f}").replace("@inner_height@", f"{screen_px:.1f}")
    picture = console.export_svg(code_format=code, unique_id="d")
    return re.sub(r' (clip-path|textLength)="[^"]*"', "", picture)  # each line is cut by the screen already


# The states of the live screen

SCALE_ROWS = 12
DOTS = ((0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (3, 0), (3, 1))
"""Row and column of the dot of each bit."""


def picture(screen: Canvas, rows: int, title: str) -> str:
    """Draw a screen."""
    console = Console(width=COLUMNS, record=True, file=StringIO(), force_terminal=True)
    for line in screen.lines(COLUMNS, rows):
        console.print(line.as_text(), crop=False)
    return console.export_svg(title=title)


def with_dots(svg: str) -> str:
    """Replace Braille, which many fonts lack, by one path a line, and the web fonts by those of the reader."""
    svg = re.sub(r' clip-path="[^"]*"', "", svg)  # it cuts the descenders of the last line
    svg = re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL)
    svg = svg.replace("Fira Code", "DejaVu Sans Mono, Menlo, Consolas")
    svg = re.sub(r'<text class="([^"]*)" x="([\d.]+)" y="([\d.]+)"[^>]*>([^<]*)</text>', _dots, svg)
    colours = dict(re.findall(r"\.(\S+-r\d+) \{ fill: (#\w+)", svg))
    strokes = "".join(f".{name}.dots {{ stroke: {colour} }}\n" for name, colour in colours.items())
    dots = f".dots {{ stroke-width: 3.2; stroke-linecap: round }}\n{strokes}"
    return svg.replace("</style>", f"{dots}</style>", 1)


def _dots(text: re.Match[str]) -> str:
    style, x, y, content = text[1], float(text[2]), float(text[3]), unescape(text[4])
    path = ""
    for i, character in enumerate(content):
        code = ord(character) - 0x2800
        for bit, (row, column) in enumerate(DOTS):
            if 0 <= code < 256 and code >> bit & 1:
                path += f"M{x + CELL_PX * (i + 0.27 + 0.5 * column):.1f} {y - 15 + ROW_PX * row / 4:.1f}h0"
    if not path:
        return text[0]
    rest = re.sub("[\u2800-\u28ff]", "\N{NO-BREAK SPACE}", text[0])
    return f'{rest}<path class="{style} dots" d="{path}"/>'


def write(name: str, svg: str) -> None:
    path = FOLDER / name
    path.write_text(svg, encoding="utf-8")
    show(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


def draw_demo() -> None:
    write("demo.svg", animated(chosen(screens())))


def draw_live() -> None:
    for scenario in get_args(Scenario):
        write(f"live-{scenario}.svg", with_dots(picture(Screen(scenario).screen, ROWS, "ftdrive live")))


def draw_weigh() -> None:
    weighing = FakeWeighing(ScaleState(PART, None))
    cast("Any", weighing.stream).info = INFO
    write("weigh.svg", with_dots(picture(Scale(weighing).screen, SCALE_ROWS, "ftdrive weigh")))


# What commands write into files

REPORT_PX, FLEET_PX = 900, 1120


def draw_report() -> None:
    with TemporaryDirectory() as folder:
        _run(folder, "demo")
        (run,) = Path(folder, "runs").iterdir()
        _run(folder, "report", str(run), "-o", "report.html")
        # The head and the estimates.
        last = "document.querySelectorAll('section')[1].getBoundingClientRect().top"
        _photograph(Path(folder, "report.html"), "report", REPORT_PX, last)


def draw_fleet() -> None:
    cells, results, checks = [], [], []
    drift = np.zeros((60, 6))
    drift[20:, 0] = np.linspace(0.0, 9.0, 40)
    for i, name in enumerate(("press-1", "press-2", "press-4", "saw")):
        cells.append(cell(name))
        results.append(result(name, 70))
        checks += daily(results[-1], 60, seed=i, added=drift if name == "press-4" else None)
    with TemporaryDirectory() as folder:
        file = Path(folder, "fleet.html")
        records = cells, results, checks
        file.write_text(fleet_page(fleet(*records), observed(*records), "sqlite:///store.sqlite"), encoding="utf-8")
        footer = "document.querySelector('footer').getBoundingClientRect().top"
        _photograph(file, "fleet", FLEET_PX, footer)


def _photograph(file: Path, name: str, width_px: int, height: str) -> None:
    """Draw the upper part of a page; `height` is an expression of its JavaScript."""
    from PIL import Image
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": width_px, "height": 1000})
        tab.goto(file.as_uri())
        tab.screenshot(
            path=FOLDER / f"{name}.png",
            full_page=True,
            clip={"x": 0, "y": 0, "width": width_px, "height": tab.evaluate(height)},
        )
        browser.close()
    Image.open(FOLDER / f"{name}.png").quantize(128).save(FOLDER / f"{name}.png", optimize=True)


def draw_tour() -> None:
    from PIL import Image

    with TemporaryDirectory() as folder:
        tool, room = "--tool 0:60:90 --tool 60:200:60", "--plane=-1:0:0:-800 --box 350:-700:0:600:-300:250"
        _run(folder, "plan", "--model", "ur5e", *tool.split(), *room.split(), "--png", "tour.png")
        _run(folder, "demo", "--sweep")
        for figure in Path(folder).rglob("*.png"):
            Image.open(figure).quantize(128).save(FOLDER / figure.name, optimize=True)


def _run(folder: str, *command: str) -> None:
    here = {**os.environ, "XDG_DATA_HOME": folder}  # not the history of who draws
    subprocess.run([sys.executable, "-m", "ftdrive", *command], cwd=folder, env=here, check=True)


PICTURES: Mapping[str, Callable[[], None]] = MappingProxyType(
    {
        "demo": draw_demo,
        "live": draw_live,
        "weigh": draw_weigh,
        "report": draw_report,
        "fleet": draw_fleet,
        "tour": draw_tour,
    }
)


def main(wanted: list[str]) -> None:
    """Write the pictures asked for, or all."""
    FOLDER.mkdir(exist_ok=True)
    for name in wanted or PICTURES:
        PICTURES[name]()


if __name__ == "__main__":
    os.environ["TZ"] = "UTC"  # the screens show the time of day
    time.tzset()
    main(sys.argv[1:])
