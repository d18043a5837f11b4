"""What the page of `live --view` costs beside `live`: age of samples, share of a core, memory with many viewers.

    python -m tests.benchmarks.live_page [--seconds 30] [--rounds 3] [--sensor netft] [--many 200]

Reads an emulated sensor by `live --json`, in each round first alone, then with a page and one viewer, then with five,
because other load on this computer changes from minute to minute. A viewer takes all that the server sends and draws
nothing, so that a browser does not take the time that is measured. The last run has many viewers, of which each fourth
opens the page and reads nothing more, as a browser that sleeps. The last lines compare the figures with the targets.
"""

import argparse
import asyncio
import json
import os
import subprocess
import tempfile
import threading
import time
import urllib.request
from contextlib import suppress
from dataclasses import dataclass, field
from http.cookiejar import CookieJar
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from ftdrive.cell.emulated import Station
from tests.benchmarks.common import most, show, show_rows
from tests.browser.conftest import address_of
from tests.system.command_line import CommandLine
from tests.unit.ftdrive.live.simulated import calibrated_from

WARM_S = 10.0
VIEWERS = (0, 1, 5)
SLEEPS_EACH = 4
AGE_TARGET, CORE_TARGET, GROWTH_TARGET_MB = 1.05, 0.25, 50.0
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class Figures:
    """Of one run."""

    ages_ms: list[float]
    core: float
    before_MB: float
    after_MB: float
    drawn_Hz: float
    received_kB_s: float

    @property
    def p95_ms(self) -> float:
        return float(np.percentile(self.ages_ms, 95))


@dataclass
class Viewers:
    """So many browsers of one page, without the drawing; counts what the first one receives."""

    url: str
    count: int
    sleeping: int
    drawn: int = 0
    received: int = 0
    ended: int = 0
    _loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.new_event_loop)

    def run(self) -> None:
        jar = CookieJar()
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(jar))
        opener.open(self.url).read()
        (cookie,) = jar
        self._loop.run_until_complete(self._watch(f"{cookie.name}={cookie.value}"))

    async def _watch(self, cookie: str) -> None:
        await asyncio.gather(*(self._follow(cookie, i) for i in range(self.count)))

    async def _follow(self, cookie: str, i: int) -> None:
        await asyncio.sleep(0.01 * i)
        with suppress(ConnectionError):
            await self._receive(cookie, i)
        self.ended += 1

    async def _receive(self, cookie: str, i: int) -> None:
        at = urlsplit(self.url)
        reader, writer = await asyncio.open_connection(at.hostname, at.port)
        writer.write(f"GET /parts HTTP/1.1\r\nHost: {at.netloc}\r\nCookie: {cookie}\r\n\r\n".encode())
        if i >= self.count - self.sleeping:
            writer.transport.pause_reading()  # type: ignore[attr-defined]
        while received := await reader.read(1 << 16):
            if i == 0:
                self.received += len(received)
                self.drawn += received.count(b'"numbers":{')


def used(pid: int) -> tuple[float, float]:
    """Return CPU seconds and resident MB of a process."""
    values = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(values[11]) + int(values[12])) / _TICKS, int(values[21]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(process: "subprocess.Popen[str]", seconds: float, viewers: Viewers | None) -> Figures:
    """Watch a process that prints readings; viewers come when it has run for some seconds."""
    ages_ms: list[float] = []

    def read() -> None:
        assert process.stdout is not None
        ages_ms.extend(1e3 * (time.monotonic() - json.loads(line)["t_s"]) for line in process.stdout)

    threading.Thread(target=read, daemon=True).start()
    time.sleep(WARM_S / 2)
    before_MB = used(process.pid)[1]
    watched = viewers or Viewers("", 0, 0)
    if viewers is not None:
        threading.Thread(target=viewers.run, daemon=True).start()
    time.sleep(WARM_S / 2)
    begin_s, count, at_s, drawn, received = (
        used(process.pid)[0],
        len(ages_ms),
        time.monotonic(),
        watched.drawn,
        watched.received,
    )
    time.sleep(seconds)
    (end_s, after_MB), wall_s = used(process.pid), time.monotonic() - at_s
    if watched.ended or process.poll() is not None:
        raise RuntimeError(f"{watched.ended} viewers were disconnected: {process.communicate()[1]}")
    return Figures(
        ages_ms=ages_ms[count:],
        core=(end_s - begin_s) / wall_s,
        before_MB=before_MB,
        after_MB=after_MB,
        drawn_Hz=(watched.drawn - drawn) / wall_s,
        received_kB_s=(watched.received - received) / wall_s / 1e3,
    )


def run(folder: Path, station: Station, seconds: float, count: int, sleeping: int = 0) -> Figures:
    """Measure `live` alone, or its page with so many viewers, of which some sleep."""
    command_line = CommandLine(folder)
    config = command_line.connect(station)
    # the computer's time, in which the age of a sample is measured
    command_line = CommandLine(folder)
    options = ("--config", config, "--calibration", folder / "calibration.json", "--force", "--json")
    try:
        process = command_line.start("live", *options, *(["--view"] if count else []))
        found = measure(process, seconds, Viewers(address_of(process), count, sleeping) if count else None)
    finally:
        command_line.end()
    show(
        f"{count:3} viewers  95 % of {len(found.ages_ms)} readings younger than {found.p95_ms:5.1f} ms, "
        f"{100 * found.core:5.1f} % of a core, memory {found.before_MB:.0f} to {found.after_MB:.0f} MB, "
        f"drawn {found.drawn_Hz:.1f} Hz, {found.received_kB_s:.0f} kB/s each"
    )
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--sensor", default="netft")
    parser.add_argument("--many", type=int, default=200)
    options = parser.parse_args()
    runs: dict[int, list[Figures]] = {count: [] for count in VIEWERS}
    with (
        tempfile.TemporaryDirectory(prefix="ftdrive-") as folder,
        Station(options.sensor, ("--time-scale", "1")) as station,
    ):
        calibrated_from(station.truth).save(Path(folder) / "calibration.json")
        for _ in range(options.rounds):
            for count in VIEWERS:
                runs[count].append(run(Path(folder), station, options.seconds, count))
        many = run(Path(folder), station, options.seconds, options.many, options.many // SLEEPS_EACH)
    # other load of the computer only makes a round worse
    p95_ms = {count: min(one.p95_ms for one in runs[count]) for count in VIEWERS}
    core = {count: float(np.median([one.core for one in runs[count]])) for count in VIEWERS}
    rows = []
    for count in VIEWERS[1:]:
        age = p95_ms[count] / p95_ms[0]
        rows.append(
            most(f"95 % age of samples in the best round, {count} viewers over none", age, AGE_TARGET, options.rounds)
        )
        rows.append(most(f"share of a core, {count} viewers", core[count] - core[0], CORE_TARGET, options.rounds))
    growth_MB = many.after_MB - many.before_MB
    rows.append(most(f"growth of memory with {options.many} viewers", growth_MB, GROWTH_TARGET_MB, 1, " MB"))
    return show_rows(rows)


if __name__ == "__main__":
    raise SystemExit(main())
