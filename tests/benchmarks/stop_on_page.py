"""How soon Stop on a page makes a moving arm brake, on both control paths.

    python -m tests.benchmarks.stop_on_page [--trials 20] [--path script] [--browser]

An emulated UR5e at real speed goes along six poses; Stop is pressed once a joint turns at 58 deg/s or more. Each
session continues the one before it. Columns: median and longest time from the callback of the button until braking
begins, in the time of the cell; with `--browser` also from the press in Chromium to the callback, in that of the
computer; and the sum. The goal is 0.3 s. Every stop must name its viewer.
"""

import argparse
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from ftdrive.cell.emulated import REAL_PACE, Station
from ftdrive.errors import Declined
from ftdrive.runs.run import Run
from ftdrive.session.options import SessionOptions
from ftdrive.session.rehearsal import NoOperator
from ftdrive.session.session import Calibrating, take_poses
from ftdrive.view.page import Page
from ftdrive.view.session_page import SessionPage
from ftdrive.view.site import serve
from tests.benchmarks.common import show

_FAST_RAD_S: Final = np.radians(58)
_GOAL_S: Final = 0.3
_LONGEST_S: Final = 120


class TimedPage(SessionPage):
    """Keeps when Stop arrived: in nanoseconds of the cell, and in seconds of the computer."""

    clock: Any
    arrived: tuple[int, float, float] | None = None

    def stop(self, viewer: str) -> None:
        seen = self._onlooker.seen
        speed_rad_s = 0.0 if seen is None else float(np.abs(seen.state.qd_rad_s).max())
        self.arrived = self.clock.now_ns(), time.monotonic(), speed_rad_s
        super().stop(viewer)


def stop_once(
    station: Station, page: Page, options: SessionOptions, press: Callable[[TimedPage], object]
) -> tuple[float, float, Path] | None:
    """Run a session until Stop.

    Returns seconds from the click to the callback, from there to braking, and the run; None if the session ended before
    a move was fast.
    """
    cell = replace(station.cell, sampling=replace(station.cell.sampling, average_s=0.1, noise_record_s=0.0))
    since = len(station.control(do="state")["events"])
    shown = TimedPage(page, NoOperator(), "calibrate")
    shown.clock = station.clock
    options = replace(options, watch=shown.watch)
    ends: list[BaseException] = []

    def run() -> None:
        try:
            take_poses(Calibrating(cell, options), shown, options)
        except BaseException as error:
            ends.append(error)

    thread = threading.Thread(target=run)
    with shown:
        thread.start()
        while thread.is_alive():
            seen = shown._onlooker.seen
            if seen is not None and np.abs(seen.state.qd_rad_s).max() >= _FAST_RAD_S:
                break
            time.sleep(0.002)
        clicked_s = time.monotonic()
        if thread.is_alive():
            press(shown)
        thread.join(_LONGEST_S)
    if not ends:
        return None
    (end,) = ends
    if not isinstance(end, Declined) or not str(end).startswith("stopped by viewer "):
        raise end
    if shown.arrived is None:
        raise RuntimeError("the stop has not arrived")
    at_ns, at_s, speed_rad_s = shown.arrived
    state = station.control(do="state", since=since)
    if state["moving"]:
        raise RuntimeError("the arm still moves")
    stood_ns = [event["t_host_ns"] for event in state["events"] if event["what"] == "stands"][-1]
    brakes_s = (stood_ns - at_ns) / 1e9 - speed_rad_s / np.radians(cell.robot.stop_deceleration_deg_s2)
    newest = max(options.runs.iterdir(), key=lambda folder: folder.stat().st_mtime)
    return at_s - clicked_s, brakes_s, newest


@contextmanager
def pressing(page: Page, *, browser: bool) -> Iterator[Callable[[TimedPage], object]]:
    """Yield what presses Stop: the callback of the button, or a click in Chromium."""
    if not browser:
        yield lambda shown: shown.stop("viewer 0")
        return
    import shutil

    from playwright.sync_api import sync_playwright

    arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=shutil.which("chromium"), args=arguments)
        looked_at = chromium.new_page(viewport={"width": 500, "height": 400})
        looked_at.set_default_timeout(60_000)
        looked_at.goto(page.url)

        def press(shown: TimedPage) -> None:
            looked_at.locator("#stop button").dispatch_event("pointerdown")
            while shown.arrived is None:
                time.sleep(0.001)

        yield press
        chromium.close()


def measure(path: str, trials: int, *, browser: bool) -> bool:
    """Print the row of a control path; return whether every stop was in time."""
    rows: list[tuple[float, float]] = []
    with (
        TemporaryDirectory(prefix="ftdrive-") as folder,
        Station("can", REAL_PACE, control_path=path) as station,
        serve("stops") as page,
        pressing(page, browser=browser) as press,
    ):
        options = SessionOptions(Path(folder), poses=6, real=False, questions=False, description=station.description)
        resume = None
        while len(rows) < trials:
            stopped = stop_once(station, page, replace(options, resume=resume), press)
            resume = None
            if stopped is not None:
                rows.append(stopped[:2])
                resume = stopped[2] if len(Run(stopped[2]).stops()) < 5 else None
    click, brakes = np.array(rows).T
    columns = [brakes] if not browser else [brakes, click, click + brakes]
    show(f"{path:8} " + "   ".join(f"{np.median(one):6.3f} to {one.max():6.3f}" for one in columns))
    return bool(columns[-1].max() <= _GOAL_S)


def main() -> int:
    """Print the table; return 1 if a stop came too late."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--path", choices=("script", "ur-rtde"), action="append")
    parser.add_argument("--browser", action="store_true")
    chosen = parser.parse_args()
    show("path     brakes s" + "           click s            sum s" * chosen.browser)
    in_time = [measure(path, chosen.trials, browser=chosen.browser) for path in chosen.path or ("script", "ur-rtde")]
    return 0 if all(in_time) else 1


if __name__ == "__main__":
    sys.exit(main())
