"""Long recordings: rate, memory and a plain copy of each, of the commands that read or write one.

    uv run python -m tests.benchmarks.long_recordings [--samples 1000000] [--folder FOLDER] [--fleet 40]

A recording at 7 kHz is generated as MCAP and as a pair of CSV files, with an arm that moves and rests, noise, contacts
and a wrench that is 4 ms late. Each command runs in a process of its own. A row has its wall time, the rate, the CPU
time of all its threads, and the largest memory that the system saw. Wall times and ratios hold on two free cores, since
commands read, process and write at once; the CPU time holds also beside other work.

The copies: DuckDB writes the rows of a Parquet file again, the package `mcap` the messages of an MCAP file, one by one,
of a tenth of a million samples at most. The ratio is our wall time for each sample to that of the copy.

An hour is 25200000 samples and needs 25 GB in FOLDER. With `--fleet 40`, so many files of the same samples together are
compensated by one process and by two; with fewer than 100000 samples a file, the start of the processes shows.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib.model import predict
from ftdrive.live.samples import Block, Stages, WrenchFrame
from ftdrive.recording import Recorder, RecordingReader
from ftdrivers.interfaces import Array
from tests.unit.ftdrive.recorded import NOISE, TRUTH, calibration, info

RATE_HZ, ARM_HZ, DELAY_S = 7000.0, 500.0, 0.004
PIECE = 7000
INFO = replace(info(), sensor_rate_Hz=RATE_HZ, p_flange_sensor_m=np.array([0.0, 0.0, 0.05]))
FEW = 100_000
_CALL = (
    "import sys; from ftdrive.cli import main; code = main(); "
    "sys.stderr.write(open('/proc/self/status').read()); sys.exit(code)"
)
"""Runs the program, then prints its largest memory."""


def turned(t_s: Array) -> Rotation:
    """Return orientations (n,): the arm moves for 12 s of each 20 s."""
    begin = np.floor(t_s / 20)
    phase = 12 * begin + np.minimum(t_s - 20 * begin, 12)
    turn = np.stack([np.sin(0.5 * phase), 0.8 * np.sin(0.31 * phase + 1), 0.5 * np.sin(0.23 * phase + 2)], axis=1)
    return Rotation.from_rotvec(turn)


def block(start: int, n: int) -> Block:
    """Make n samples from number `start` on, with a contact of 6 N in the last second of each minute."""
    rng, seq = np.random.default_rng(start), np.arange(start, start + n)
    t_s = seq / RATE_HZ
    R = turned(t_s).as_matrix()
    raw = predict(TRUTH, R) + rng.normal(0, NOISE, (n, 6))
    raw[:, 0] += np.where(t_s % 60 > 59, 6.0, 0.0)
    nothing = np.zeros((n, 6))
    return Block(
        t_host_ns=10**12 + np.rint(1e9 * t_s).astype(np.int64),
        t_device_s=t_s,
        seq=seq,
        status=np.zeros(n, np.uint32),
        raw=raw,
        wrench=nothing,
        chi2=nothing[:, 0],
        in_contact=np.zeros(n, bool),
        q_rad=np.sin(np.outer(t_s, np.arange(1, 7)) / 10),
        R_base_flange=R,
        p_base_flange_m=0.1 * np.sin(np.outer(t_s, [0.4, 0.3, 0.2])),
        sigma=NOISE,
        frame=WrenchFrame(),
        stages=Stages(),
    )


def write_mcap(path: Path, samples: int) -> None:
    """Write the recording."""
    recorder = Recorder([path], INFO, {})
    for start in range(0, samples, PIECE):
        recorder.write(block(start, min(PIECE, samples - start)))
    recorder.close()


def write_pair(wrench: Path, orientation: Path, samples: int) -> None:
    """Write the same wrench, later than the pose, and quaternions of the arm."""
    with wrench.open("w") as file:
        file.write("t,fx,fy,fz,tx,ty,tz\n")
        for start in range(0, samples, PIECE):
            made = block(start, min(PIECE, samples - start))
            rows = np.c_[made.t_device_s + DELAY_S, made.raw].tolist()
            file.write("".join("%.6f,%.4f,%.4f,%.4f,%.5f,%.5f,%.5f\n" % tuple(row) for row in rows))  # noqa: UP031
    with orientation.open("w") as file:
        file.write("t,qx,qy,qz,qw\n")
        count = round(samples / RATE_HZ * ARM_HZ) + 10
        for start in range(0, count, PIECE):
            t_s = np.arange(start, min(start + PIECE, count)) / ARM_HZ
            rows = np.c_[t_s, turned(t_s).as_quat()].tolist()
            file.write("".join("%.6f,%.9f,%.9f,%.9f,%.9f\n" % tuple(row) for row in rows))  # noqa: UP031


def measured(name: str, samples: int, command: Sequence[str]) -> float:
    """Run a command of ftdrive and print its figures; return its time in s."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    before, begin = os.times(), time.perf_counter()
    done = subprocess.run([sys.executable, "-c", _CALL, *command], env=environment, capture_output=True, check=False)
    took_s, after = time.perf_counter() - begin, os.times()
    if done.returncode:
        sys.exit(f"{' '.join(command)}: {done.returncode}: {done.stderr.decode()}")
    cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    memory_kB = int(done.stderr.rsplit(b"VmHWM:")[-1].split()[0])
    print_row(name, samples, took_s, f"{cpu_s:7.1f} s CPU   {memory_kB / 1024:5.0f} MB")
    return took_s


def print_row(name: str, samples: int, took_s: float, more: str = "") -> None:
    """Print one line of the table."""
    sys.stdout.write(f"{name:34}{took_s:8.1f} s  {samples / took_s / 1e6:7.3f} M/s  {more}\n")
    sys.stdout.flush()


def copied(name: str, samples: int, copy: Callable[[], object], of_s: float, of: int) -> None:
    """Print the time of a plain copy of so many samples, and the ratio of a time for others."""
    begin = time.perf_counter()
    copy()
    took_s = time.perf_counter() - begin
    print_row(f"  plain copy, {name}", samples, took_s, f"ratio {of_s / of / (took_s / samples):.2f}")


def copy_mcap(source: Path, target: Path) -> None:
    """Copy the messages of a file one by one."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with source.open("rb") as file, target.open("wb") as new:
        writer, known = Writer(new), dict[int, int]()
        writer.start()
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if channel.id not in known and schema is not None:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(known[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]


def copy_parquet(source: Path, target: Path) -> None:
    """Copy the rows of a file."""
    import duckdb

    duckdb.sql(f"COPY (SELECT * FROM read_parquet('{source}')) TO '{target}' (FORMAT parquet, COMPRESSION zstd)")


def single(folder: Path, samples: int) -> None:
    """Measure one recording."""
    calibration().save(folder / "c.json")
    mcap, wrench, orientation = folder / "a.mcap", folder / "wrench.csv", folder / "orientation.csv"
    begin = time.perf_counter()
    write_mcap(mcap, samples)
    print_row("generated, MCAP", samples, time.perf_counter() - begin, f"{mcap.stat().st_size / 1e6:.0f} MB")
    begin = time.perf_counter()
    write_pair(wrench, orientation, samples)
    print_row("generated, CSV pair", samples, time.perf_counter() - begin, f"{wrench.stat().st_size / 1e6:.0f} MB")
    pair = ["--wrench", str(wrench), "--orientation-file", str(orientation), "--calibration", str(folder / "c.json")]
    few = min(samples, FEW)
    if samples > few:
        write_mcap(folder / "few.mcap", few)
    small = folder / "few.mcap" if samples > few else mcap
    times = dict[str, float]()
    for ending in (".parquet", ".mcap"):
        for name, source in (("CSV pair", pair), ("MCAP", [str(mcap)])):
            target = folder / f"new{ending}"
            command = ["compensate", *source, "-o", str(target)]
            times[ending] = measured(f"compensate, {name} to {ending}", samples, command)
            if ending == ".parquet" and name == "MCAP":
                copy = partial(copy_parquet, target, folder / "copy.parquet")
                copied("DuckDB", samples, copy, times[ending], samples)
                (folder / "copy.parquet").unlink()
            check(target, samples)
            target.unlink()
    copied("package mcap", few, lambda: copy_mcap(small, folder / "copy.mcap"), times[".mcap"], samples)
    measured("compensate, MCAP, bias estimated", samples, ["compensate", str(mcap), "--bias", "estimate"])
    measured("convert, MCAP to .parquet", samples, ["convert", str(mcap), str(folder / "new.parquet")])


def check(path: Path, samples: int) -> None:
    """Require that the result is complete, and right where nothing touches the tool."""
    count, squares = 0, 0.0
    for piece in (reader := RecordingReader(path, ("seq", "wrench", "t_host_ns"))).pieces():
        free = np.abs(piece.rows["wrench"][:, 0]) < 3
        squares += float(np.square(piece.rows["wrench"][free, :3]).sum()) / max(int(free.sum()), 1) * len(piece.rows)
        count += len(piece.rows)
    rms = np.sqrt(squares / count)
    if reader.cut or not 0.99 * samples - 1000 < count <= samples or abs(rms / np.linalg.norm(NOISE[:3]) - 1) > 0.1:
        sys.exit(f"{path}: {count} samples, {rms:.4f} N: {reader.cut or 'wrong'}")


def fleet(folder: Path, files: int, samples: int) -> None:
    """Measure many recordings in one process and in two."""
    (folder / "many").mkdir()
    write_mcap(folder / "many" / "0.mcap", samples // files)
    for number in range(1, files):
        (folder / "many" / f"{number}.mcap").write_bytes((folder / "many" / "0.mcap").read_bytes())
    for workers in ("1", "2"):
        command = [
            "fleet",
            "compensate",
            str(folder / "many"),
            "-o",
            str(folder / f"out{workers}"),
            "--workers",
            workers,
        ]
        measured(f"fleet, {files} files, {workers} processes", samples // files * files, command)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--fleet", type=int, default=0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        single(Path(folder), given.samples)
        if given.fleet:
            fleet(Path(folder), given.fleet, given.samples)


if __name__ == "__main__":
    main()
