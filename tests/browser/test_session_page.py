"""The page of a session in a browser: its state, its question, Stop, and its verdict."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ftdrive.cell.emulated import REAL_PACE, Station
from tests.browser.conftest import FOLDER, WIDTHS, address_of, nothing_is_cut, picture
from tests.system.command_line import CommandLine, end_of, say, wait_until

if TYPE_CHECKING:
    from playwright.sync_api import Page


def connect(ftdrive: CommandLine, station: Station) -> Path:
    """Describe the cell; its sensor on CAN reports no range, so it is configured."""
    path = ftdrive.connect(station)
    path.write_text(re.sub(r'(url = ".*)"', r'\1&range=40,4"', path.read_text()))
    return path


def stop_is_large(page: "Page") -> None:
    """At each width, Stop is over the whole width and high enough for a thumb."""
    for across, down in WIDTHS.values():
        page.set_viewport_size({"width": across, "height": down})
        box = page.get_by_role("button", name="Stop").bounding_box()
        assert box is not None
        assert box["height"] >= 64
        assert box["width"] >= across - 40
        assert box["y"] + box["height"] < 200


def test_a_viewer_stops_the_arm_in_mid_move_and_sees_the_verdict(
    ftdrive: CommandLine, open_page: "Callable[..., Page]"
) -> None:
    with Station("can", REAL_PACE) as station:
        command = ftdrive.start("calibrate", "--config", connect(ftdrive, station), "--minimal", "--view")
        page = open_page(address_of(command))
        page.get_by_text("Is the tool free").wait_for()
        page.get_by_text(re.compile(r"^pose 1 of 6, \d+ of \d+ s$")).wait_for()
        nothing_is_cut(page)
        stop_is_large(page)
        # The approach takes 12 s, the tour a minute.
        say(command, "yes\nyes\nyes\nMOVE\nyes\n")
        wait_until(lambda: bool(station.control(do="state")["moving"]), command)
        page.locator("#bars").get_by_text(re.compile(r"^[+-]\d+\.\d of 36 N$")).first.wait_for()
        page.get_by_text(re.compile(r"^pose 2/7 R..\s+MOVE")).wait_for()
        nothing_is_cut(page)
        if FOLDER:
            ftdrive.wait_for_poses(command, 4)
            picture(page, "view-session", after_s=1.5)
        wait_until(lambda: bool(station.control(do="state")["moving"]), command)
        page.get_by_role("button", name="Stop").click()
        code, printed = end_of(command)
        assert code == 130, printed
        assert "stopped by viewer 0" in printed
        assert not station.control(do="state")["moving"]
        assert len(ftdrive.poses()) < 7
        # The process has ended, and the page keeps its last state.
        result = page.locator("#result")
        result.get_by_role("heading", name="Stopped by viewer 0").wait_for()
        result.get_by_text("--resume").wait_for()
        assert page.get_by_role("button", name="Stop").is_hidden()
        assert page.locator("#bars").is_hidden()
        nothing_is_cut(page)
        page.close()
    (run,) = ftdrive.folder.glob("runs/*")
    with Station("can") as station:
        resumed = ftdrive.start("calibrate", "--config", ftdrive.connect(station), "--resume", run, "--view")
        page = open_page(address_of(resumed))
        page.get_by_text("Is the tool free").wait_for()
        resumed_at, printed = end_of(resumed, "yes\nyes\nyes\nMOVE\nyes\nyes\n")
        assert resumed_at == 0, printed
    assert len(ftdrive.poses()) == 7
    assert resumed.poll() == 0
    result = page.locator("#result")
    result.get_by_role("heading", name=re.compile("GOOD|USABLE")).wait_for()
    shown = result.inner_text()
    assert re.search(r"mass\s+0\.\d+\skg ± 0\.\d+ \(1 sigma\)", shown), shown
    assert "compensation error" in shown
    for command_line in re.findall(r"ftdrive (?:report|live|verify) \S.*", printed.partition("Next")[2]):
        assert " ".join(command_line.split()) in shown
    page.get_by_text("ended", exact=True).wait_for()
    assert page.locator("#bars").is_hidden()
    nothing_is_cut(page)
