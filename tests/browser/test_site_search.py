"""The search of the site, used as a person would: a symptom in everyday words has its section as the first result."""

import functools
import http.server
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

DOCS = Path(__file__).parents[2] / "docs"

SYMPTOMS = {
    "reads 5 N in free air after turning": (
        "reads 5 N in free air after turning",
        "force not zero when nothing touches the tool",
        "tool in the air shows force in another orientation",
    ),
    "drifts after switching on": (
        "force drifts after switching on",
        "sensor value creeps while warming up",
        "zero wanders with temperature",
    ),
    "jumps at 180": (
        "jumps at 180 degrees",
        "orientation flips at pi",
        "force spike when wrist 3 passes 180°",
    ),
    "torque is wrong": (
        "force right torque wrong",
        "torque does not match force",
        "moment about wrong point TCP",
    ),
    "verdict is USABLE": (
        "verdict usable",
        "why only usable and not good",
        "what does USABLE mean",
    ),
    "quaternion order": (
        "quaternion order",
        "is w first or last in the quaternion",
        "qw qx qy qz convention",
    ),
    "robot get the payload": (
        "how does the robot get the payload",
        "send mass and center of gravity to UR controller",
        "set payload in polyscope from calibration",
    ),
    "sign is reversed": (
        "sign reversed",
        "force has wrong sign",
        "pushing gives negative values",
    ),
    "25,000 N": (
        "reads 25000 N",
        "sensor shows 25,000 newton",
        "ur e-series raw force huge value",
    ),
}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of the site in the folder `SITE`, or of one built here; Sphinx loses index entries in a partial build."""
    pytest.importorskip("furo", reason="the group docs is not installed")
    folder = os.environ.get("SITE") or str(tmp_path_factory.mktemp("site"))
    if "SITE" not in os.environ:
        subprocess.run([sys.executable, "-m", "sphinx", "-q", str(DOCS), folder], check=True)
    handler = functools.partial(_Quiet, directory=folder)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Log nothing."""


@pytest.fixture(scope="module")
def page(browser: "Browser") -> "Iterator[Page]":
    found = browser.new_page()
    yield found
    found.close()


@pytest.mark.parametrize(("section", "typed"), [(section, one) for section, words in SYMPTOMS.items() for one in words])
def test_a_symptom_finds_its_section_first(site: str, page: "Page", section: str, typed: str) -> None:
    page.goto(f"{site}/search.html")
    box = page.locator("#search-documentation form input[name=q], form input[name=q]").first
    box.fill(typed)
    box.press("Enter")
    first = page.locator("#search-results ul.search li a").first
    first.click()
    page.wait_for_url("**/how-to/what-is-wrong.html*")
    # The anchor of the result is that of the section, or the index entry before its heading.
    heading = page.evaluate(
        "(() => { const at = document.getElementById(location.hash.slice(1));"
        " return at?.closest('section').querySelector('h1, h2').innerText; })()"
    )
    assert section.lower() in heading.lower()
