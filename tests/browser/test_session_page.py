"""The page of a session in a browser: its state, its question, and Stop."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from ftdrive.cell.emulated import REAL_PACE, Station
from tests.browser.conftest import FOLDER, address_of, nothing_is_cut, picture
from tests.system.command_line import CommandLine, end_of, say, wait_until

if TYPE_CHECKING:
    from playwright.sync_api import Page


def test_a_viewer_stops_the_arm_in_mid_move(ftdrive: CommandLine, open_page: "Callable[..., Page]") -> None:
    with Station("can", REAL_PACE) as station:
        command = ftdrive.start("calibrate", "--config", ftdrive.connect(station), "--minimal", "--view")
        page = open_page(address_of(command))
        page.get_by_text("Is the tool free").wait_for()
        page.get_by_text("along the plan").wait_for()
        nothing_is_cut(page)
        stop = page.get_by_role("button", name="Stop").element_handle()
        # The approach takes 12 s, the tour a minute.
        say(command, "yes\nyes\nyes\nMOVE\nyes\n")
        wait_until(lambda: bool(station.control(do="state")["moving"]), command)
        if FOLDER:
            ftdrive.wait_for_poses(command, 4)
            picture(page, "view-session", after_s=1.5)
        stop.dispatch_event("click")
        code, printed = end_of(command)
        page.close()
        assert code == 130, printed
        assert "stopped by viewer 0" in printed
        assert not station.control(do="state")["moving"]
        assert len(ftdrive.poses()) < 7
    (run,) = ftdrive.folder.glob("runs/*")
    with Station("can") as station:
        resumed = ftdrive.run(
            "calibrate", "--config", ftdrive.connect(station), "--resume", run, typed="yes\nyes\nyes\nMOVE\nyes\nyes\n"
        )
    assert resumed.returncode == 0, resumed.stderr
    assert len(ftdrive.poses()) == 7
