"""Texts of files, cells and tools on each page: shown as text, whatever HTML is in them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ftdrive.cell.emulated import Station
from tests.browser.conftest import address_of
from tests.system.command_line import CommandLine, say, wait_until
from tests.unit.ftdrive.stream.simulated import calibrated_from

if TYPE_CHECKING:
    from playwright.sync_api import Page

HTML = "<img src=x onerror=window.taken=1><b>&lt;\"'`<script>window.taken=1<"
LONG = HTML * 150


def shows_text(page: "Page") -> None:
    """Nothing of a text has become an element, has run, or has left the window."""
    page.get_by_text("onerror=window.taken=1").first.wait_for()
    assert page.evaluate("window.taken") is None
    assert page.locator("img, b:not(.bar b), script:not([src])").count() == 0
    for across in (390, 1280):
        page.set_viewport_size({"width": across, "height": 800})
        page.wait_for_timeout(500)  # plots follow the window in the next frame
        assert page.evaluate("[window.innerWidth, document.documentElement.scrollWidth]") == [across, across]


def test_on_the_form(ftdrive: CommandLine, open_page: "Callable[..., Page]") -> None:
    command = ftdrive.start("init", "--view", "-o", f"{HTML}.toml")
    page = open_page(address_of(command))
    shows_text(page)
    for field in page.locator("input").all():
        field.fill(LONG[:9_990])
    page.get_by_text("which is not a number").first.wait_for()
    page.get_by_text("Correct the red fields").wait_for()
    shows_text(page)
    page.locator("input").last.fill("60")
    assert command.poll() is None


@pytest.mark.parametrize("name", ["live", "weigh"])
def test_of_a_calibration(ftdrive: CommandLine, open_page: "Callable[..., Page]", name: str) -> None:
    with Station.of(None) as station:
        calibrated_from(station.truth).save(path := ftdrive.folder / f"{HTML}.json")
        command = ftdrive.start(name, *named(ftdrive, station), "--calibration", path, "--force", "--view")
        shows_text(open_page(address_of(command)))


def test_of_a_session(ftdrive: CommandLine, open_page: "Callable[..., Page]") -> None:
    with Station("can") as station:
        command = ftdrive.start("calibrate", *named(ftdrive, station), "--minimal", "--view", "--runs", HTML)
        page = open_page(address_of(command))
        say(command, "yes\nyes\nyes\nMOVE\nyes\n")
        wait_until(lambda: any(ftdrive.folder.glob("*/*/poses/*.npz")), command)
        page.get_by_role("button", name="Stop").dispatch_event("click")
        page.get_by_text("Next").wait_for()
        shows_text(page)


def named(ftdrive: CommandLine, station: Station) -> tuple[str, Path]:
    """Describe the cell of a station, whose tool has a name of HTML."""
    path = ftdrive.connect(station)
    path.write_text(path.read_text().replace("[tool]\n", f"[tool]\nname = {json.dumps(HTML)}\n"))
    return "--config", path


def test_the_redirect_of_a_browser_ends_on_the_page(
    ftdrive: CommandLine, open_page: "Callable[..., Page]", monkeypatch: pytest.MonkeyPatch
) -> None:
    opened, browser = ftdrive.folder / "opened", ftdrive.folder / "browser"
    browser.write_text(f'#!/bin/sh\necho "$@" > {opened}\n')
    browser.chmod(0o755)
    monkeypatch.setenv("BROWSER", str(browser))
    monkeypatch.setenv("DISPLAY", ":99")
    command = ftdrive.start("init", "--view")
    url = address_of(command)
    while not opened.exists() or not opened.read_text():
        assert command.poll() is None
    page = open_page(opened.read_text().strip())
    assert url.startswith(page.url)
    assert "token" not in page.url + page.evaluate("document.referrer")
    page.get_by_text("Robot address", exact=True).wait_for()
