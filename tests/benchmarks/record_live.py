"""Draw the live screen in its states as SVG for the documentation: `uv run python -m tests.benchmarks.record_live`.

A stream without devices feeds the real app. Dots of Braille become paths, because many fonts lack them.
"""

import asyncio
import os
import re
import time
from html import unescape
from pathlib import Path
from typing import get_args

from ftdrive.checks.check import Check
from ftdrive.terminal.live.feed import Feed
from ftdrive.terminal.live.summary import Summary
from ftdrive.terminal.live_screen import LiveApp
from tests.unit.ftdrive.terminal.fake_stream import FakeStream, Scenario

FOLDER = Path(__file__).parents[2] / "docs/pictures"
SIZE = (80, 24)
BLOCKS = 1200
CHECKS = (
    Check("calibration.devices", "ok", "verdict good, with these devices"),
    Check("robot.payload", "ok", "robot 1.74 kg; weighed 1.44 kg + 0.30 kg sensor"),
)
CELL_PX, ROW_PX = 12.2, 24.4
"""Of rich's SVG."""
DOTS = ((0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (3, 0), (3, 1))
"""Row and column of the dot of each bit."""


async def picture(scenario: Scenario) -> str:
    """Run the app in a state and draw it."""
    stream = FakeStream(scenario, silent_after=BLOCKS if scenario == "stale" else None)
    feed = Feed(stream)
    summary = Summary(feed, CHECKS)
    for _ in range(BLOCKS):
        feed.step()
    if scenario == "tare-refused":
        feed.request(stream.tare)
    feed.step()
    app = LiveApp(feed, summary)
    async with app.run_test(size=SIZE) as pilot:
        app.draw()
        await pilot.pause()
        return app.export_screenshot(simplify=True)


def with_dots(svg: str) -> str:
    """Replace Braille by one path a line, and the web fonts by those of the reader."""
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


def main() -> None:
    """Write all pictures."""
    FOLDER.mkdir(exist_ok=True)
    for scenario in get_args(Scenario):
        svg = with_dots(asyncio.run(picture(scenario)))
        path = FOLDER / f"live-{scenario}.svg"
        path.write_text(svg, encoding="utf-8")
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")  # noqa: T201


if __name__ == "__main__":
    os.environ["TZ"] = "UTC"
    time.tzset()
    main()
