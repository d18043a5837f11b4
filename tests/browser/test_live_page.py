"""The page of the live wrench in a browser."""

import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ftdrive.cell.emulated import Station
from tests.browser.conftest import address_of, nothing_is_cut
from tests.system.command_line import CommandLine, wait_until
from tests.unit.ftdrive.live.simulated import calibrated_from

if TYPE_CHECKING:
    from playwright.sync_api import Page

PUSH = {"do": "push", "wrench": [0.0, 0.0, -8.0, 0.0, 0.0, 0.0]}


def force_N(page: "Page") -> float:
    """Read the large number."""
    (text,) = page.get_by_text(re.compile(r"^\d+\.?\d* ± \d+\.?\d* N$")).all_inner_texts()
    return float(text.split()[0])


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
            page.get_by_text("free", exact=True).wait_for()
            assert force_N(page) < 2
            station.control(**PUSH)
            page.get_by_text(re.compile(r"^contact, \d+\.\d s$")).wait_for()
            page.wait_for_function("/(^|\\n)[78]\\.\\d+ ± [\\d.]+ N/.test(document.body.innerText)")
            station.control(do="push", wrench=[0.0] * 6)
            page.get_by_text("free", exact=True).wait_for()
            page.get_by_text(re.compile(r"contact 8\.\d N")).wait_for()
            page.get_by_role("button", name="Tare", exact=True).click()
            page.get_by_text(re.compile("tare")).last.wait_for()
            page.reload()
            page.get_by_text(re.compile(r"contact 8\.\d N")).wait_for()
            nothing_is_cut(page)
            page.close()
            other = open_page(url)
            other.get_by_text(re.compile(r"contact 8\.\d N")).wait_for()
            other.close()
            before = (tmp_path / "readings").stat().st_size
            wait_until(lambda: (tmp_path / "readings").stat().st_size > before, command)
            command.send_signal(signal.SIGINT)
            assert command.wait(20) == 130
