"""Record `ftdrive demo` in a terminal of 80x24 as an animated SVG: `uv run python -m tests.benchmarks.record_demo`.

Runs the real command in tmux, copies its screen about once a second, and draws the screens with rich.
"""

import re
import subprocess
import time
from io import StringIO
from pathlib import Path

from rich.console import Console
from rich.text import Text

PICTURE = Path(__file__).parents[2] / "docs/pictures/demo.svg"
COLUMNS, ROWS = 80, 24
ROW_PX = 24.4
"""Of rich's SVG, whose characters are 20 px high."""
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
    subprocess.run([*TMUX, "new-session", "-d", "-x", str(COLUMNS), "-y", str(ROWS), command], check=True)
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


def svg(strip: list[str]) -> str:
    """Draw all screens in one column; the animation shows one at a time. Without animation the last one is shown."""
    console = Console(width=COLUMNS, record=True, file=StringIO(), force_terminal=True)
    for screen in strip:
        lines = screen.split("\n")[:ROWS]
        for line in [*lines, *[""] * (ROWS - len(lines))]:
            console.print(Text.from_ansi(line), no_wrap=True, crop=True, soft_wrap=False)
    screen_px, total_s = ROWS * ROW_PX, SHOWN_S * (len(strip) - 1) + LAST_SHOWN_S
    frames = " ".join(
        f"{100 * SHOWN_S * i / total_s:.2f}% {{{{ transform: translateY({-screen_px * i:g}px) }}}}"
        for i in range(len(strip))
    )
    code = STRIP.replace("@keyframes@", frames).replace("@total@", f"{total_s:g}")
    code = code.replace("@last@", f"{screen_px * (len(strip) - 1):.1f}").replace("@height@", f"{screen_px + 24:.0f}")
    code = code.replace("@inner_width@", f"{12.2 * COLUMNS + 2:.0f}").replace("@inner_height@", f"{screen_px:.1f}")
    picture = console.export_svg(code_format=code, unique_id="d")
    return re.sub(r' (clip-path|textLength)="[^"]*"', "", picture)  # each line is cut by the screen already


if __name__ == "__main__":
    PICTURE.parent.mkdir(exist_ok=True)
    PICTURE.write_text(svg(chosen(screens())), encoding="utf-8")
    print(f"{PICTURE}: {PICTURE.stat().st_size / 1e3:.0f} kB")  # noqa: T201
