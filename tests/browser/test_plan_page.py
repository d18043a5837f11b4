"""The page of a plan in a browser."""

import signal
from collections.abc import Callable
from typing import TYPE_CHECKING

from tests.browser.conftest import address_of, nothing_is_cut
from tests.system.command_line import CommandLine

if TYPE_CHECKING:
    from playwright.sync_api import Page

PLAN = ("plan", "--model", "ur5e", "--tool", "0:200:100", "--minimal", "--view")


def test_the_tour_is_looked_at(ftdrive: CommandLine, open_page: "Callable[..., Page]") -> None:
    command = ftdrive.start(*PLAN)
    page = open_page(address_of(command))
    page.get_by_text("1 of 6").wait_for()
    slider = page.get_by_role("slider").first
    slider.focus()
    page.keyboard.press("End")
    page.get_by_text("6 of 6").wait_for()
    page.get_by_role("button", name="largest move").click()
    page.get_by_text("at 60°/s").wait_for()
    at = page.get_by_role("slider").first.get_attribute("aria-valuenow")
    page.get_by_role("checkbox").first.check()
    page.wait_for_function(f"document.querySelector('[role=slider]').ariaValueNow !== '{at}'")
    nothing_is_cut(page)
    command.send_signal(signal.SIGINT)
    assert command.wait(20) == 0
