"""Pictures of a report in headless Chromium: light and dark, at the width of a desk and of a phone. Run by hand.

    uv run ftdrive report RUN -o report.html
    uv run python tests/benchmarks/report_pictures.py report.html --out pictures

Prints a line per picture. The exit code is 1 if the browser writes anything to its console or the page is wider than
the screen. Needs the command `chromium`.
"""

import re
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

WIDTHS_PX = (1200, 400)
SCHEMES = {"dark": 0, "light": 1}
"""As Chromium numbers `prefers-color-scheme`."""
OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run", "--disable-sync"),
    *("--disable-quic", "--disable-background-networking", "--disable-component-update", "--enable-logging=stderr"),
)
MEASURE = """<script>addEventListener("load", () => {
  const page = document.documentElement;
  document.title = `size ${page.scrollWidth} ${page.scrollHeight}`;
})</script>"""


def chromium(page: Path, *options: str) -> tuple[str, list[str]]:
    """Load a page; return what the browser prints and the lines of its console."""
    with TemporaryDirectory() as profile:
        command = ["chromium", *OPTIONS, f"--user-data-dir={profile}", *options, page.absolute().as_uri()]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return ended.stdout, [line for line in ended.stderr.splitlines() if ":CONSOLE:" in line or "CONSOLE(" in line]


def size_px(page: Path, width: int, folder: Path) -> tuple[int, int]:
    """Return the width and height (px) of the page in a window of this width."""
    measured = folder / f"measured-{width}.html"
    measured.write_text(page.read_text(encoding="utf-8").replace("</body>", f"{MEASURE}</body>"), encoding="utf-8")
    printed, _ = chromium(measured, f"--window-size={width},1000", "--dump-dom")
    found = re.search(r"<title>size (\d+) (\d+)</title>", printed)
    if found is None:
        sys.exit(f"chromium did not load {page}")
    return int(found[1]), int(found[2])


def pictures(page: Path, out: Path) -> Iterator[str]:
    """Write the pictures; yield each fault."""
    out.mkdir(exist_ok=True)
    with TemporaryDirectory() as folder:
        sizes = {width: size_px(page, width, Path(folder)) for width in WIDTHS_PX}
    for width, (scheme, number) in product(WIDTHS_PX, SCHEMES.items()):
        needed, height = sizes[width]
        picture = out / f"{page.stem}-{scheme}-{width}.png"
        _, console = chromium(
            page,
            f"--blink-settings=preferredColorScheme={number}",
            f"--window-size={width},{height}",
            f"--screenshot={picture.absolute()}",
        )
        print(f"{picture}  {width} x {height} px")
        yield from console
        if needed > width:
            yield f"the page is {needed} px wide in a window of {width} px"


def main() -> int:
    """Draw every page of the command line."""
    parser = ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("pictures"))
    options = parser.parse_args()
    faults = [f"{page}: {fault}" for page in options.pages for fault in pictures(page, options.out)]
    print("\n".join(faults) or "no message in the console, no page too wide")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
