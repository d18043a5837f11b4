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
    from playwright.sync_api import expect

    command = ftdrive.start(*PLAN)
    page = open_page(address_of(command))
    page.get_by_text("Move 1 of 6").wait_for()
    page.get_by_text("pose 1 of 6, 0 of").wait_for()
    slider = page.get_by_role("slider")
    slider.focus()
    page.keyboard.press("End")
    page.get_by_text("pose 6 of 6").wait_for()
    page.get_by_role("button", name="Next pose").click()
    page.get_by_text("pose 1 of 6").wait_for()
    page.get_by_role("button", name="Next pose").click()
    page.get_by_text("pose 2 of 6").wait_for()
    page.get_by_role("button", name="Previous pose").click()
    page.get_by_text("pose 1 of 6").wait_for()
    page.get_by_role("button", name="Largest move").click()
    page.get_by_text("at 60 °/s").wait_for()
    page.get_by_label("Speed").select_option("2 ×")
    at = slider.input_value()
    page.get_by_role("button", name="Play").click()
    expect(slider).not_to_have_value(at)
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Play").wait_for()
    at = slider.input_value()
    page.get_by_role("checkbox").check()
    legend = page.locator("#legend")
    legend.get_by_text("space swept by the tool").wait_for()
    for words in ("arm", "tool", "path of the tool tip", "ball to keep free", "surroundings"):
        assert legend.get_by_text(words, exact=True).is_visible()
    assert slider.input_value() == at
    nothing_is_cut(page)
    command.send_signal(signal.SIGINT)
    assert command.wait(20) == 0
    page.get_by_text("last state").wait_for()
    assert page.get_by_role("button", name="Play").is_disabled()
