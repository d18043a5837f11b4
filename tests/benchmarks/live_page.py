"""What the page of `live --view` costs beside `live`, with one viewer or more.

    python -m tests.benchmarks.live_page [--seconds 60] [--sensor bota] [--viewers 5] [--suspended 1]

Reads an emulated sensor with 1 kHz by `live --json`, first alone, then with --view and a viewer that takes all that the
server sends and draws nothing, so that a browser on this computer does not take the time that is measured. Prints the
share of a core, the resident memory after 10 s and at the end, how often a second the numbers were drawn, and the age
of the samples. The last lines compare both with the targets. A suspended viewer opens the page and reads nothing more,
as a browser that sleeps.
"""

import argparse
import json
import os
import re
import subprocess
import tempfile
import threading
import time
import urllib.request
from dataclasses import dataclass, field
from http.cookiejar import CookieJar
from pathlib import Path

import msgspec
import numpy as np
import zstandard
from viser import __version__ as viser_version
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from ftdrive.cell.emulated import Station
from tests.benchmarks.common import show
from tests.system.command_line import CommandLine, listen_for
from tests.unit.ftdrive.live.simulated import calibrated_from

WARM_S = 10.0
CPU_TARGET, RATE_TARGET_HZ, GROWTH_TARGET_MB = 0.25, 20.0, 10.0
_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (1.0, 1.0, 1.0),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 800,
    "image_width": 1200,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class Figures:
    core: float
    begin_MB: float
    end_MB: float
    age_ms: float
    drawn_Hz: float
    received_kB_s: float


@dataclass
class Viewer:
    """Takes what a browser would take, and counts the drawings of the numbers."""

    url: str
    suspended: bool = False
    drawn: int = 0
    received: int = 0
    ended: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        jar = CookieJar()
        urllib.request.build_opener(urllib.request.HTTPCookieProcessor(jar)).open(self.url).read()
        (cookie,) = jar
        with connect(
            re.sub(r"^http(.*)/\?.*", r"ws\1", self.url),
            subprotocols=[Subprotocol(f"viser-v{viser_version}")],
            additional_headers={"Cookie": f"{cookie.name}={cookie.value}"},
            max_size=None,
            ping_interval=None,
        ) as socket:
            # a viewer counts from its first camera on
            socket.send(msgspec.msgpack.encode(_CAMERA))
            if self.suspended:
                self.ended.wait()
            while not self.ended.is_set():
                try:
                    window = socket.recv()
                except ConnectionClosed:  # the command has ended
                    return
                assert isinstance(window, bytes)
                self.received += len(window)
                packed = int.from_bytes(window[8:16], "little")
                words = zstandard.ZstdDecompressor().decompress(window[16 : 16 + packed])
                self.drawn += any(" at rest" in str(one) for one in msgspec.msgpack.decode(words)["messages"])


def used(pid: int) -> tuple[float, float]:
    """Return CPU seconds and resident MB of a process."""
    values = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(values[11]) + int(values[12])) / _TICKS, int(values[21]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(process: "subprocess.Popen[str]", seconds: float, viewer: Viewer) -> Figures:
    """Watch a process that prints readings, and its viewer."""
    ages_ms: list[float] = []

    def read() -> None:
        assert process.stdout is not None
        ages_ms.extend(1e3 * (time.monotonic() - json.loads(line)["t_s"]) for line in process.stdout)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    time.sleep(WARM_S)
    (begin_s, begin_MB), count, at_s = used(process.pid), len(ages_ms), time.monotonic()
    drawn, received = viewer.drawn, viewer.received
    time.sleep(seconds)
    (end_s, end_MB), wall_s = used(process.pid), time.monotonic() - at_s
    return Figures(
        core=(end_s - begin_s) / wall_s,
        begin_MB=begin_MB,
        end_MB=end_MB,
        age_ms=float(np.percentile(ages_ms[count:], 95)),
        drawn_Hz=(viewer.drawn - drawn) / wall_s,
        received_kB_s=(viewer.received - received) / wall_s / 1e3,
    )


def run(folder: Path, station: Station, seconds: float, *, viewers: int = 0, suspended: int = 0) -> Figures:
    """Measure `live` without viewers, or its page with some, of which the last ones are suspended."""
    command_line = CommandLine(folder)
    config = command_line.connect(station)
    # the computer's time, in which the age of a sample is measured
    command_line = CommandLine(folder)
    options = ("--config", config, "--calibration", folder / "calibration.json", "--force", "--json")
    try:
        process = command_line.start("live", *options, *(["--view"] if viewers else []))
        if not viewers:
            return measure(process, seconds, Viewer(""))
        said = listen_for(process, "/?token=")
        assert process.stderr is not None
        while not said.endswith(("\n", " ")):
            said += process.stderr.read(1)
        url = re.findall(r"http://\S+", said)[0]
        opened = [Viewer(url, suspended=i >= viewers - suspended) for i in range(viewers)]
        for viewer in opened:
            threading.Thread(target=viewer.run, daemon=True).start()
        figures = measure(process, seconds, opened[0])
        for viewer in opened:
            viewer.ended.set()
        return figures
    finally:
        command_line.end()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--sensor", default="bota")
    parser.add_argument("--viewers", type=int, default=1)
    parser.add_argument("--suspended", type=int, default=0)
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(prefix="ftdrive-") as folder,
        Station(options.sensor, ("--time-scale", "1")) as station,
    ):
        calibrated_from(station.truth).save(Path(folder) / "calibration.json")
        found = []
        for viewers in (0, options.viewers):
            figures = run(
                Path(folder), station, options.seconds, viewers=viewers, suspended=min(viewers, options.suspended)
            )
            show(
                f"{'live --view' if viewers else 'live':12} {100 * figures.core:5.1f} % of a core, memory "
                f"{figures.begin_MB:.0f} to {figures.end_MB:.0f} MB, drawn {figures.drawn_Hz:.1f} Hz, "
                f"{figures.received_kB_s:.0f} kB/s, "
                f"95 % of the samples younger than {figures.age_ms:.1f} ms"
            )
            found.append(figures)
    alone, page = found
    for name, figure, passed in (
        ("share of a core beyond live", page.core - alone.core, page.core - alone.core <= CPU_TARGET),
        ("drawn a second", page.drawn_Hz, page.drawn_Hz >= RATE_TARGET_HZ),
        ("growth of memory, MB", page.end_MB - page.begin_MB, page.end_MB - page.begin_MB <= GROWTH_TARGET_MB),
    ):
        show(f"{name:40} {figure:8.2f}   {'pass' if passed else 'FAIL'}")


if __name__ == "__main__":
    main()
