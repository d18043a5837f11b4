"""The page of the scale in a browser."""

import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ftdrive.cell.emulated import Station
from tests.browser.conftest import WIDTHS, address_of, nothing_is_cut
from tests.system.command_line import CommandLine
from tests.unit.ftdrive.stream.simulated import calibrated_from

if TYPE_CHECKING:
    from playwright.sync_api import Page

PART_KG = 0.75


def test_a_part_is_weighed_and_a_viewer_zeroes(
    ftdrive: CommandLine, open_page: "Callable[..., Page]", tmp_path: Path
) -> None:
    with Station.of(None) as station:
        calibrated_from(station.truth).save(path := tmp_path / "calibration.json")
        options = ("--config", ftdrive.connect(station), "--calibration", path, "--force", "--allow-control")
        command = ftdrive.start("weigh", *options, "--count", str(PART_KG), "--view")
        page = open_page(address_of(command))
        page.get_by_text("not zeroed: zero the empty gripper").wait_for()
        page.get_by_role("button", name="Zero the empty gripper").click()
        page.get_by_text("zero: the empty gripper was tared").wait_for()
        page.get_by_text(re.compile(r"^zeroed \d min ago$")).wait_for()
        station.control(do="grip", mass_kg=2 * PART_KG, at_mm=[0, 0, 150])
        page.wait_for_function(
            "() => Math.abs(parseFloat(document.querySelector('.number.huge .value')?.innerText) - 1.5) < 0.05"
        )
        page.get_by_text("2", exact=True).wait_for()
        page.reload()
        page.wait_for_function(
            "() => /^1[.][0-9]+\\u00a0kg$/.test(document.querySelector('.number.huge .value')?.innerText)"
        )
        nothing_is_cut(page)
        for across, down in WIDTHS.values():
            page.set_viewport_size({"width": across, "height": down})
            page.wait_for_function(f"() => window.innerWidth === {across}")
            lines, size_px = page.evaluate(
                "[...document.querySelectorAll('.number.huge .value')].flatMap(one =>"
                " [one.getClientRects().length, parseFloat(getComputedStyle(one).fontSize)])"
            )
            assert (lines, size_px >= 48) == (1, True)  # a unit beside its number, and read from afar
        assert not page.locator("#scene").is_visible()
        command.send_signal(signal.SIGINT)
        assert command.wait(20) == 130
        page.get_by_text(re.compile("^ended ")).wait_for()
