"""CPU, memory and delay of the live screen: `uv run python tests/benchmarks/live_screen_cost.py`.

A stream without devices gives blocks of 10 ms at 7 kHz to the real app on a pseudo-terminal, whose output is read and
counted. The cost of devices, pairing and processing is not in these figures.
"""

import argparse
import json
import os
import resource
import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from ftdrive.live.samples import Block
from ftdrive.terminal.live.feed import Feed
from ftdrive.terminal.live.summary import Summary
from ftdrive.terminal.live_screen import LiveApp
from tests.benchmarks.on_terminal import on_terminal
from tests.unit.ftdrive.terminal.fake_stream import FakeStream

SIZES = ((80, 24), (160, 50))


class Paced(FakeStream):
    """A stream at the pace of the computer."""

    begun_s = time.monotonic()

    def __init__(self, rate_Hz: float) -> None:
        super().__init__("contact", rate_Hz)
        self.unseen_s = list[float]()
        """When each block was read that is not on the screen yet."""

    def read(self) -> Block:
        time.sleep(max(0.0, self.begun_s + 0.01 * self.blocks - time.monotonic()))
        self.unseen_s.append(time.monotonic())
        return super().read()


class Timed(LiveApp):
    """Notes how long each block has waited when the terminal gets it."""

    waits_s: list[float]
    stream: Paced

    def draw(self) -> None:
        seen, self.stream.unseen_s = self.stream.unseen_s, []
        super().draw()
        self.call_after_refresh(lambda: self.waits_s.extend(time.monotonic() - read_s for read_s in seen))


def run(rate_Hz: float, duration_s: float, with_screen: bool) -> dict[str, float]:
    """Run the app, or the stream alone, for a while; return CPU seconds per second, and the growth of memory."""
    stream = Paced(rate_Hz)
    feed = Feed(stream)
    feed.start()
    waits_s = [0.0]
    used, memory_kB = list[float](), list[int]()

    def note() -> None:
        used.append(time.process_time())
        memory_kB.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)

    def watch(finish: object) -> None:
        for wait_s in (3.0, duration_s):  # without start-up
            time.sleep(wait_s)
            note()
        if callable(finish):
            finish()

    if with_screen:
        app = Timed(feed, Summary(feed))
        app.stream, app.waits_s = stream, waits_s
        threading.Thread(target=watch, args=(lambda: app.call_from_thread(app.exit),), daemon=True).start()
        app.run()
    else:
        watch(None)
    feed.stop()
    late_s = sorted(waits_s)[round(0.95 * (len(waits_s) - 1))]
    grown_MB = (memory_kB[1] - memory_kB[0]) / 1e3
    return {"cpu": (used[1] - used[0]) / duration_s, "grown_MB": grown_MB, "late_ms": 1e3 * late_s}


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=7000.0)
    parser.add_argument("--report", type=int)
    options = parser.parse_args()
    if options.report is not None:
        figures = run(options.rate, options.seconds, with_screen=True)
        os.write(options.report, json.dumps(figures).encode())
        sys.exit()
    reading = run(options.rate, options.seconds, with_screen=False)
    sys.stdout.write(f"stream alone          {100 * reading['cpu']:5.1f} % of a core\n")
    for width, height in SIZES:
        figures, size_kB = on_terminal(__file__, width, height, sys.argv[1:])
        sys.stdout.write(
            f"{width:3d}x{height:<3d}               {100 * figures['cpu']:5.1f} % of a core, "
            f"{size_kB / (options.seconds + 3):5.1f} kB/s, memory grown by {figures['grown_MB']:.1f} MB, "
            f"block to terminal {figures['late_ms']:.0f} ms p95\n"
        )
