"""Speed of recordings: compensation from Parquet, and writing and reading of each format.

    uv run python tests/benchmarks/compensate_speed.py [samples]

A loop over samples in numpy stands beside the compensation, without frame, contacts and statistics. CPU seconds are of
all threads of this process; the verdict goes by them, because other load on the machine hardly changes them.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from ftcalib.model import predict
from ftdrive.live.samples import WrenchFrame
from ftdrive.recording import Header, Recording, read_recording, write_recording
from ftdrive.recording.compensation import NEEDED, compensated
from ftdrive.recording.recording import rows_of
from tests.unit.ftdrive.recorded import BASE_TCP, USUAL, block, calibration, info

RATE_HZ = 7000.0
TARGET_PER_S = 1e6
_LOOPED = 20_000


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Return CPU and wall seconds."""
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    work()
    return time.process_time() - cpu_s, time.perf_counter() - wall_s


def compensate(path: Path, frame: WrenchFrame) -> None:
    compensated(read_recording(path, NEEDED), frame)


def show(name: str, count: int, what: str, seconds: tuple[float, float], end: str = "") -> None:
    cpu_s, wall_s = seconds
    sys.stdout.write(f"{name:42} {count / wall_s:9.3g} {what}/s   {count / cpu_s:9.3g} {what}/CPU s {end}\n")


def main() -> None:
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    samples = block(n, step_ns=round(1e9 / RATE_HZ))
    known = replace(info(), sensor_rate_Hz=RATE_HZ)
    recording = Recording(Header(known, BASE_TCP, USUAL), rows_of(samples), [])
    with TemporaryDirectory() as folder:
        for ending, count in ((".parquet", n), (".mcap", n), (".csv", n // 10)):
            path, part = Path(folder) / f"a{ending}", replace(recording, rows=recording.rows[:count])
            written = timed(partial(write_recording, path, part))
            size = f"{path.stat().st_size / count:.0f} bytes/sample"
            show(f"write {ending}", count, "samples", written, size)
            show(f"read {ending}", count, "samples", timed(partial(read_recording, path)))
            if ending == ".mcap":
                show("write .mcap", 5 * count, "messages", written)
        path = Path(folder) / "a.parquet"
        for frame in (WrenchFrame(), WrenchFrame("base")):
            results = [timed(partial(compensate, path, frame)) for _ in range(5)]
            found = min(cpu_s for cpu_s, _ in results), min(wall_s for _, wall_s in results)
            verdict = "pass" if n / found[0] >= TARGET_PER_S else "FAIL"
            name = f"compensate from .parquet, {frame.axes} axes"
            show(name, n, "samples", found, f"target {TARGET_PER_S:g}: {verdict}")
    parameters, raw, R_base_flange = calibration().parameters, samples.raw, samples.R_base_flange

    def loop() -> None:
        for i in range(_LOOPED):
            raw[i] - predict(parameters, R_base_flange[i])

    show("loop over samples in numpy", _LOOPED, "samples", timed(loop))


if __name__ == "__main__":
    main()
