"""A stream with all its consumers: screen, recording and one Foxglove client, from the wires of an emulated cell.

    uv run python tests/benchmarks/live_soak.py [--seconds 600] [--size 160x50]

An ATI sensor at 7 kHz and the arm at 500 Hz, in another process and in real time. Printed: samples that are missing in
the file, CPU and growth of memory of the whole program, the age of the newest sample (by the clock of the cell) when a
block is read from the stream and when the terminal has it, and the time from there to the client.
"""

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from ftdrive.cell.emulated import Station
from ftdrive.live.samples import Block, StreamEvent
from ftdrive.live.stream import CompensatedStream
from ftdrive.recording import Recorder, read_recording
from ftdrive.servers.foxglove import FoxgloveServer
from ftdrive.terminal.live.feed import Feed
from ftdrive.terminal.live.summary import Summary
from ftdrive.terminal.live_screen import LiveApp
from tests.benchmarks.on_terminal import on_terminal
from tests.unit.ftdrive.live.simulated import calibrated_from

WARM_UP_S = 60.0
CLIENT = Path(__file__).with_name("stream_latency.py")


class Both:
    """A recorder and a server as one consumer; notes how old the newest sample of each block is."""

    def __init__(self, recorder: Recorder, server: FoxgloveServer, stream: CompensatedStream) -> None:
        self.recorder, self._server, self._clock = recorder, server, stream.clock
        self.read_ms = list[float]()

    def write(self, block: Block) -> None:
        self.read_ms.append((self._clock.now_ns() - int(block.t_host_ns[-1])) * 1e-6)
        self.recorder.write(block)
        now_ns = time.monotonic_ns()  # the client subtracts the stamp of a message from this clock
        self._server.write(replace(block, t_host_ns=np.arange(now_ns - len(block) + 1, now_ns + 1)))

    def event(self, event: StreamEvent) -> None:
        self.recorder.event(event)

    def close(self) -> None:
        self.recorder.close()


class Timed(LiveApp):
    """Notes how old the newest sample is once the terminal has it."""

    stream: CompensatedStream
    feed: Feed
    drawn_ms: list[float]

    def draw(self) -> None:
        newest_ns = self.feed.newest_ns
        super().draw()
        if newest_ns is not None:
            self.call_after_refresh(
                lambda: self.drawn_ms.append((self.stream.clock.now_ns() - newest_ns) * 1e-6),
            )


def memory_MB() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def run(duration_s: float) -> dict[str, object]:
    with (
        TemporaryDirectory() as folder,
        Station("serial", ("--time-scale", "1")) as station,
        CompensatedStream(station.cell, calibrated_from(station.truth)) as stream,
        closing(FoxgloveServer(stream, port=0)) as server,
    ):
        server._info = replace(stream.info, utc_offset_ns=0)
        both = Both(Recorder([path := Path(folder, "soak.mcap")], stream.info, {}), server, stream)
        feed = Feed(stream, lambda _: both)
        client = subprocess.Popen(
            [sys.executable, CLIENT, "client", str(server.port)], stdout=subprocess.PIPE, text=True
        )
        assert client.stdout is not None
        client.stdout.readline()
        feed.request(feed.switch_recording)
        app = Timed(feed, Summary(feed))
        app.stream, app.feed, app.drawn_ms = stream, feed, []
        cpu_s, grown_MB = 0.0, 0.0

        def watch() -> None:
            nonlocal cpu_s, grown_MB
            warm_s = min(WARM_UP_S, duration_s / 2)
            time.sleep(warm_s)
            begin_s, cpu_s, grown_MB = time.monotonic(), time.process_time(), memory_MB()
            time.sleep(duration_s - warm_s)
            cpu_s = (time.process_time() - cpu_s) / (time.monotonic() - begin_s)
            grown_MB = memory_MB() - grown_MB
            app.call_from_thread(app.exit)

        threading.Thread(target=watch, daemon=True).start()
        feed.start()
        app.run()
        feed.stop()
        server.close()
        received = json.loads(client.communicate()[0])
        seq = read_recording(path).paired().seq
        return {
            "samples": len(seq),
            "missing": int(seq[-1] - seq[0]) + 1 - len(seq),
            "cpu": cpu_s,
            "grown_MB": grown_MB,
            "read_ms": np.percentile(both.read_ms, [50, 95]).tolist(),
            "drawn_ms": np.percentile(app.drawn_ms, [50, 95]).tolist(),
            "client_ms": [received["p50"], received["p95"]],
            "client_wrenches": received["wrenches"],
        }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--size", default="160x50")
    parser.add_argument("--report", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.report is not None:
        os.write(options.report, json.dumps(run(options.seconds)).encode())
        sys.exit()
    columns, lines = map(int, options.size.split("x"))
    figures, _ = on_terminal(__file__, columns, lines, ["--seconds", str(options.seconds)])
    for name, figure in figures.items():
        sys.stdout.write(f"{name:16} {figure}\n")
