"""The page of the live wrench in a browser."""

import re
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ftdrive.cell.emulated import Station
from tests.browser.conftest import WIDTHS, address_of, nothing_is_cut
from tests.system.command_line import CommandLine, wait_until
from tests.unit.ftdrive.stream.simulated import calibrated_from

if TYPE_CHECKING:
    from playwright.sync_api import Page

PUSH = {"do": "push", "wrench": [0.0, 0.0, -8.0, 0.0, 0.0, 0.0]}
PUSHED = re.compile(r"contact [78]\.\d N")


def wait_for_force(page: "Page", least_N: float, most_N: float) -> None:
    """Return when the large number, with its unit, is between these."""
    page.wait_for_function(
        "([least, most]) => {"
        " const found = /^([0-9.]+)\\u00a0N$/.exec(document.querySelector('.number.huge .value')?.innerText);"
        " return found && found[1] >= least && found[1] <= most; }",
        arg=[least_N, most_N],
    )


def test_a_push_is_seen_and_viewers_change_nothing(
    ftdrive: CommandLine, open_page: "Callable[..., Page]", tmp_path: Path
) -> None:
    with Station.of(None) as station:
        calibrated_from(station.truth).save(path := tmp_path / "calibration.json")
        options = ("--config", ftdrive.connect(station), "--calibration", path, "--force", "--allow-control")
        with (tmp_path / "readings").open("w") as out:
            command = ftdrive.start("live", *options, "--json", "--view", stdout=out)
            url = address_of(command)
            page = open_page(url)
            # software draws a small page several times a second
            page.set_viewport_size({"width": 390, "height": 320})
            # the error of the calibration can look like a small contact that lasts
            tare(page)
            wait_for_force(page, 0, 1)
            station.control(**PUSH)
            page.get_by_text(re.compile(r"^contact, \d+\.\d s")).wait_for()
            wait_for_force(page, 7, 9)
            page.get_by_text(re.compile("^towards ")).wait_for()
            station.control(do="push", wrench=[0.0] * 6)
            page.get_by_text("free", exact=True).wait_for()
            page.get_by_text(PUSHED).wait_for()
            page.get_by_label("Axes").select_option("base")
            page.get_by_text(re.compile("^contact wrench, base axes")).wait_for()
            with page.expect_response("**/do"):
                page.get_by_label("Plots of the last").select_option("2 s")
            page.reload()
            page.get_by_text(PUSHED).wait_for()
            assert page.get_by_label("Axes").input_value() == "base"
            assert page.get_by_label("Plots of the last").input_value() == "2 s"
            nothing_is_cut(page)
            plots_and_number_are_readable(page)
            page.close()
            other = open_page(url)
            other.get_by_text(PUSHED).wait_for()
            before = (tmp_path / "readings").stat().st_size
            wait_until(lambda: (tmp_path / "readings").stat().st_size > before, command)
            assert '"axes":"base"' in (tmp_path / "readings").read_text().replace(" ", "").splitlines()[-2]
            command.send_signal(signal.SIGINT)
            assert command.wait(20) == 130
            other.get_by_text(re.compile("^ended ")).wait_for()
            other.get_by_text(PUSHED).wait_for()


def tare(page: "Page") -> None:
    """Press until the tool is free: a tare is refused, or a little off, while the push is in the last half second."""
    done = page.get_by_text(re.compile(r"\d tare: the bias has changed")).first
    for _ in range(60):
        page.get_by_role("button", name="Tare", exact=True).click()
        page.wait_for_timeout(1000)
        if done.count() and page.get_by_text("free", exact=True).is_visible():
            return
    done.wait_for()


def plots_and_number_are_readable(page: "Page") -> None:
    """At each width six plots are inside the window, and the force has large letters."""
    page.locator("#plots canvas").nth(5).wait_for()
    for across, down in WIDTHS.values():
        page.set_viewport_size({"width": across, "height": down})
        page.wait_for_function(
            "() => [...document.querySelectorAll('#plots canvas')].map(one => one.getBoundingClientRect())"
            ".filter(at => at.width > 100 && at.left >= 0 && at.right <= window.innerWidth).length === 6"
        )
        size_px = page.evaluate("parseFloat(getComputedStyle(document.querySelector('.number.huge .value')).fontSize)")
        assert size_px >= 40


def test_a_silent_sensor_takes_the_numbers_away(
    ftdrive: CommandLine, open_page: "Callable[..., Page]", tmp_path: Path
) -> None:
    with Station.of(None) as station:
        calibrated_from(station.truth).save(path := tmp_path / "calibration.json")
        options = ("--config", ftdrive.connect(station), "--calibration", path, "--force", "--json", "--view")
        command = ftdrive.start("live", *options, stdout=subprocess.DEVNULL)  # a full pipe would stop it
        page = open_page(address_of(command))
        wait_for_force(page, 0, 1)
        page.locator("#plots canvas").nth(5).wait_for()
        assert page.get_by_role("button", name="Tare").count() == 0
        station.control(do="unplug", device="sensor")
        page.get_by_role("alert").filter(has_text="No live values").wait_for()
        numbers = page.locator("#numbers").inner_text()
        assert not re.search(r"\d", numbers), numbers
        assert not page.locator("#plots").is_visible()
