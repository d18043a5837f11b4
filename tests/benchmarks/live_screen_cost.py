"""CPU and memory of the live screen: `uv run python tests/benchmarks/live_screen_cost.py`.

A stream without devices gives blocks of 10 ms at 7 kHz to the real app on a pseudo-terminal, whose output is read and
counted. The cost of devices, pairing and processing is not in these figures.
"""

import argparse
import fcntl
import json
import os
import pty
import resource
import struct
import subprocess
import sys
import termios
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from ftdrive.live.samples import Block
from ftdrive.terminal.live.feed import Feed
from ftdrive.terminal.live.summary import Summary
from ftdrive.terminal.live_screen import LiveApp
from tests.unit.ftdrive.terminal.fake_stream import FakeStream

SIZES = ((80, 24), (160, 50))


class Paced(FakeStream):
    """A stream at the pace of the computer."""

    begun_s = time.monotonic()

    def read(self) -> Block:
        time.sleep(max(0.0, self.begun_s + 0.01 * self.blocks - time.monotonic()))
        return super().read()


def run(rate_Hz: float, duration_s: float, with_screen: bool) -> dict[str, float]:
    """Run the app, or the stream alone, for a while; return CPU seconds per second, and the growth of memory."""
    feed = Feed(Paced("contact", rate_Hz))
    feed.start()
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
        app = LiveApp(feed, Summary(feed))
        threading.Thread(target=watch, args=(lambda: app.call_from_thread(app.exit),), daemon=True).start()
        app.run()
    else:
        watch(None)
    feed.stop()
    return {"cpu": (used[1] - used[0]) / duration_s, "grown_MB": (memory_kB[1] - memory_kB[0]) / 1e3}


def on_terminal(width: int, height: int, arguments: list[str]) -> tuple[dict[str, float], float]:
    """Run this script on a terminal of a size; return its figures and how many kilobytes it wrote."""
    main, side = pty.openpty()
    fcntl.ioctl(side, termios.TIOCSWINSZ, struct.pack("HHHH", height, width, 0, 0))
    report, written = os.pipe()
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": str(width), "LINES": str(height)}
    command = [sys.executable, __file__, "--report", str(written), *arguments]
    with subprocess.Popen(command, stdin=side, stdout=side, stderr=side, pass_fds=[written], env=environment) as child:
        os.close(side)
        os.close(written)
        size = 0
        while True:
            try:
                size += len(os.read(main, 1 << 16))
            except OSError:  # the child has ended
                break
        child.wait()
    with os.fdopen(report) as file:
        return json.loads(file.read()), size / 1e3


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
    print(f"stream alone          {100 * reading['cpu']:5.1f} % of a core")  # noqa: T201
    for width, height in SIZES:
        figures, size_kB = on_terminal(width, height, sys.argv[1:])
        print(  # noqa: T201
            f"{width:3d}x{height:<3d}               {100 * figures['cpu']:5.1f} % of a core, "
            f"{size_kB / (options.seconds + 3):5.1f} kB/s, memory grown by {figures['grown_MB']:.1f} MB"
        )
