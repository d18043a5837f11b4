"""A real browser for the pages of --view: Chromium of the system, drawing by software.

With `PICTURES=docs/pictures` in the environment, the tests also draw the pictures of the documentation.
"""

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.system.command_line import CommandLine, listen_for

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

_DRAWS_BY_SOFTWARE = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
_NAMES = ("chromium", "chromium-browser", "google-chrome")
WIDTHS = {"phone": (390, 844), "tablet": (800, 1024), "desktop": (1280, 860)}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of this folder."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.browser)


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    """Chromium without a window."""
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None:
        pytest.skip("no Chromium here")
    playwright = pytest.importorskip("playwright.sync_api", reason="the group browser is not installed")
    pytest.importorskip("uplot", reason="the extra viz is not installed")
    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=path, args=[*_DRAWS_BY_SOFTWARE])
        yield found
        found.close()


@pytest.fixture
def open_page(browser: "Browser") -> "Iterator[Callable[..., Page]]":
    """Open an address as a new viewer."""
    contexts = []

    def open_page(url: str) -> "Page":
        # Drawing by software takes time by the pixel.
        contexts.append(browser.new_context(viewport={"width": 700, "height": 500}))
        page = contexts[-1].new_page()
        page.set_default_timeout(60_000)
        page.goto(url)
        # The title arrives with the first parts.
        page.get_by_role("heading", name="ftdrive ").wait_for()
        return page

    yield open_page
    for context in contexts:
        context.close()


@pytest.fixture
def ftdrive(tmp_path: Path) -> Iterator[CommandLine]:
    command_line = CommandLine(tmp_path)
    yield command_line
    command_line.end()


def address_of(process: "subprocess.Popen[str]") -> str:
    """Read the address of the page that a command has begun to serve."""
    said = listen_for(process, "/?token=")
    assert process.stderr is not None
    while not said.endswith(("\n", " ")):
        said += process.stderr.read(1)
    found = re.search(r"http://\S+", said)
    assert found is not None, said
    return found[0]


FOLDER = os.environ.get("PICTURES", "")
"""Where pictures are drawn; empty: they are not."""


def picture(page: "Page", name: str, after_s: float = 3.0) -> None:
    """Save a picture for the documentation, if any are drawn."""
    if not FOLDER:
        return
    page.set_viewport_size({"width": 1280, "height": 860})
    page.wait_for_timeout(1e3 * after_s)
    page.screenshot(path=Path(FOLDER) / f"{name}.png")


def nothing_is_cut(page: "Page") -> None:
    """At each width, each word of the controls is inside the window, and the page does not scroll sideways."""
    for across, down in WIDTHS.values():
        page.set_viewport_size({"width": across, "height": down})
        page.wait_for_timeout(150)  # a function to wait for would be blocked by the policy of the page
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        outside = page.evaluate(
            "[...document.querySelectorAll('button, label, input, select, p, h1, h2, td, li, .bar span, .number *')]"
            ".map(e => [e.innerText || e.value || '', e.getBoundingClientRect()])"
            ".filter(([text, at]) => text && at.width && (at.left < -1 || at.right > window.innerWidth + 1))"
            ".map(([text]) => text)"
        )
        assert outside == [], across
