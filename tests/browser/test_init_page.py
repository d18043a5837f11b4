"""The form of `ftdrive init` in a browser writes the file that the terminal writes for the same answers."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from tests.browser.conftest import address_of, nothing_is_cut, picture
from tests.system.command_line import CommandLine

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

HOST, SENSOR = "127.99.99.9", "ati-serial:///dev/no-such-port"


def field(page: "Page", label: str, which: int = 1) -> "Locator":
    """The input behind a label; its words below belong to the label too."""
    named = page.locator("label").filter(has=page.locator("span").get_by_text(label, exact=True))
    return named.locator("input, select").nth(which - 1)


def enter(page: "Page", label: str, text: str, which: int = 1) -> None:
    field(page, label, which).fill(text)


def choose(page: "Page", label: str, choice: str) -> None:
    field(page, label).select_option(choice)


def test_a_cell_is_described(ftdrive: CommandLine, open_page: "Callable[..., Page]") -> None:
    command = ftdrive.start("init", "--view")
    page = open_page(address_of(command))
    enter(page, "Robot address", HOST)
    enter(page, "Sensor address", SENSOR)
    choose(page, "Model of the arm", "UR10e")
    enter(page, "Sensor height", "high")
    page.get_by_text("--height is 'high', which is not a number").wait_for()
    enter(page, "Sensor height", "33,5")
    enter(page, "Cylinder 1", "0 33.5 80")
    page.get_by_role("button", name="Add cylinder").click()
    enter(page, "Cylinder 2", "33 90 50 45 0")
    for wall, (distance, side) in enumerate((("800", "+x"), ("20", "-y")), start=1):
        page.get_by_role("button", name="Add wall").click()
        choose(page, f"Wall {wall} at", side)
        enter(page, "Distance", distance, wall)
    page.get_by_text("(-y 20 mm) is 0 mm from the arm's shoulder").wait_for()
    page.get_by_text("Correct the red fields: Wall 2").wait_for()
    assert page.get_by_role("button", name="Write ftdrive.toml").is_disabled()
    enter(page, "Distance", "60 cm", 2)
    page.get_by_role("button", name="Add box").click()
    enter(page, "Box 1", "400 400 0 800 800 300")
    page.get_by_text("ftdrive.toml can be written").wait_for()
    nothing_is_cut(page)
    picture(page, "view-init")
    page.get_by_role("button", name="Write ftdrive.toml").click()
    assert command.wait(60) == 0
    answers = [HOST, "", "UR10e", SENSOR, "", "33,5", "", "", "0 33.5 80", "33 90 50 45 0", "", "", ""]
    answers += ["+x 800", "-y 60 cm", "", "400 400 0 800 800 300", "", "", ""]
    outcome = ftdrive.run("init", "-o", "terminal.toml", typed="".join(f"{answer}\n" for answer in answers))
    assert outcome.returncode == 0, outcome.stderr
    written, typed = ((ftdrive.folder / name).read_bytes() for name in ("ftdrive.toml", "terminal.toml"))
    assert written == typed
    assert not list(ftdrive.folder.glob(".*.draft"))
