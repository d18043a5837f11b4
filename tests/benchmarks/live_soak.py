"""A stream with all its consumers: screen, recording and one Foxglove client, from the wires of an emulated cell.

    uv run python -m tests.benchmarks.live_soak [--seconds 600] [--size 160x50]

An ATI sensor at 7 kHz and the arm at 500 Hz, in another process and in real time. Printed: samples that are missing in
the file, CPU and growth of memory of the whole program, and latencies (median, 95 %) in ms by the clock of the cell:
from the measurement of a sample to its receipt from the wire, which is mostly the batch of the emulated adapter; from
there to the block that is read from the stream, and to the WebSocket client; and from the measurement to client and
terminal. Last, the age of the newest sample when a line of `ftdrive live --json` is read from a pipe, in a program of
its own.
"""

import argparse
import fcntl
import json
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from array import array
from collections import deque
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftdrive.cell.emulated import Station
from ftdrive.live.samples import Block, StreamEvent
from ftdrive.live.stream import CompensatedStream
from ftdrive.recording import Recorder, read_recording
from ftdrive.servers.foxglove import FoxgloveServer
from ftdrive.terminal.live.feed import Feed
from ftdrive.terminal.live.summary import Summary
from ftdrive.terminal.live_screen import LiveApp
from ftdrivers.interfaces import FtSamples
from tests.benchmarks.stream_latency import EVERY
from tests.unit.ftdrive.live.simulated import calibrated_from

WARM_UP_S = 60.0
SKIPPED = 25
"""Ages at the beginning that do not count in latencies: 2 s."""


class Both:
    """A server and a recorder as one consumer; notes when each sample was received and read."""

    def __init__(self, recorder: Recorder, server: FoxgloveServer, stream: CompensatedStream) -> None:
        self.recorder, self._server, self._clock = recorder, server, stream.clock
        self._received = deque[tuple[NDArray[np.int64], NDArray[np.int64]]](maxlen=200)
        self._batches = array("q"), array("q")
        """Last sequence number and receipt of every batch."""
        self._first = -1
        self._ages_ns = list[tuple[int, int]]()
        """Of one sample in every 20 blocks: all of them would fill the memory that is measured."""
        self._blocks = 0
        add = stream._pairing.add_samples

        def noted(samples: FtSamples) -> None:
            self._received.append((samples.seq, samples.t_host_ns))
            self._batches[0].extend(samples.seq[-1:].tolist())
            self._batches[1].extend(samples.t_host_ns[-1:].tolist())
            add(samples)

        stream._pairing.add_samples = noted  # type: ignore[method-assign]  # the only place to see it

    def write(self, block: Block) -> None:
        self._blocks += 1
        if self._first < 0:
            self._first = int(block.seq[0])
        if self._blocks % 20 == 0:
            seqs, times_ns = (np.concatenate(column) for column in zip(*self._received, strict=True))
            received_ns = int(times_ns[np.searchsorted(seqs, block.seq[0])])
            self._ages_ns.append((received_ns - int(block.t_host_ns[0]), self._clock.now_ns() - received_ns))
        self._server.write(block)
        self.recorder.write(block)

    def event(self, event: StreamEvent) -> None:
        self.recorder.event(event)

    def close(self) -> None:
        self.recorder.close()

    def stages(self) -> dict[str, list[float]]:
        """From measurement to receipt, and from there to the block."""
        received_ns, block_ns = zip(*self._ages_ns[SKIPPED:], strict=True)
        return {"received_ms": percentiles(list(received_ns)), "block_ms": percentiles(list(block_ns))}

    def from_receipt(self, arrivals_ns: list[int]) -> list[float]:
        """From the receipt of every 100th sample to its arrival at the client, without the first 10 %."""
        seqs = self._first + EVERY * np.arange(len(arrivals_ns))
        last_seq, received_ns = (np.frombuffer(column, np.int64) for column in self._batches)
        ages_ns = np.array(arrivals_ns) - received_ns[np.searchsorted(last_seq, seqs)]
        return percentiles(ages_ns[len(ages_ns) // 10 :])


def percentiles(age_ns: NDArray[np.int64] | list[int] | list[float]) -> list[float]:
    """Median and 95 %, ms."""
    return [round(float(age_ms), 2) for age_ms in np.percentile(np.asarray(age_ns), [50, 95]) * 1e-6]


class Timed(LiveApp):
    """Notes how old the newest sample is once the terminal has it."""

    stream: CompensatedStream
    feed: Feed
    drawn_ns: list[int]

    def draw(self) -> None:
        newest_ns = self.feed.newest_ns
        super().draw()
        if newest_ns is not None:
            self.call_after_refresh(
                lambda: self.drawn_ns.append(self.stream.clock.now_ns() - newest_ns),
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
            [
                sys.executable,
                "-m",
                "tests.benchmarks.stream_latency",
                "client",
                str(server.port),
                station.endpoints["clock"],
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert client.stdout is not None
        client.stdout.readline()
        feed.request(feed.switch_recording)
        app = Timed(feed, Summary(feed))
        app.stream, app.feed, app.drawn_ns = stream, feed, []
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
            **both.stages(),
            "wire_to_client_ms": both.from_receipt(received["arrivals_ns"]),
            "client_ms": [received["p50"], received["p95"]],
            "client_wrenches": received["wrenches"],
            "screen_ms": percentiles(app.drawn_ns),
        }


def piped(lines: int) -> list[float]:
    """Age of the newest sample when a line of `ftdrive live --json` is read from a pipe."""
    with TemporaryDirectory() as folder, Station("serial", ("--time-scale", "1")) as station:
        calibrated_from(station.truth).save(calibration := Path(folder, "calibration.json"))
        arm, sensor = station.endpoints["arm"], station.cell.sensor.url
        config = Path(folder, "ftdrive.toml")
        config.write_text(
            f'format = "ftdrive.config/1"\n[robot]\nhost = "{arm["host"]}"\nmodel = "{arm["model"]}"\n'
            f'[sensor]\nurl = "{sensor}"\n'
        )
        command = [sys.executable, "-m", "ftdrive", "live", "--json", "--config", str(config)]
        command += ["--calibration", str(calibration)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as live:
            assert live.stdout is not None
            age_ns = [time.monotonic_ns() - 1e9 * json.loads(line)["t_s"] for line in islice(live.stdout, lines)]
            live.send_signal(signal.SIGINT)
            live.stdout.read()
    return percentiles(age_ns[10:])


def on_terminal(width: int, height: int, arguments: Sequence[str]) -> Any:
    """Run this script on a pseudo-terminal whose output is read; return the figures that it writes to `--report`."""
    main, side = pty.openpty()
    fcntl.ioctl(side, termios.TIOCSWINSZ, struct.pack("HHHH", height, width, 0, 0))
    report, written = os.pipe()
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": str(width), "LINES": str(height)}
    command = [sys.executable, "-m", "tests.benchmarks.live_soak", "--report", str(written), *arguments]
    with subprocess.Popen(command, stdin=side, stdout=side, stderr=side, pass_fds=[written], env=environment) as child:
        os.close(side)
        os.close(written)
        try:
            while True:
                os.read(main, 1 << 16)
        except OSError:  # the child has ended
            child.wait()
    with os.fdopen(report) as file:
        return json.loads(file.read())


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
    figures = on_terminal(columns, lines, ["--seconds", str(options.seconds)])
    figures["stdout_ms"] = piped(round(10 * min(options.seconds, 30)))
    for name, figure in figures.items():
        sys.stdout.write(f"{name:16} {figure}\n")
