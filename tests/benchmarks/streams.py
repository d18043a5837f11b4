"""What the streams carry, against emulated sensors in processes of their own.

    python -m tests.benchmarks.streams [--seconds 60] [--samples 0] [--only bota]

Prints one line per figure: the figure, the target, pass or FAIL. The 7 kHz stream of an ATI serial sensor and the
500 Hz of an arm are each followed alone. Then the serial stream runs beside the wrist sensor of an arm, 500 samples a
second over RTDE, and an arm that is looked at 100 times a second, which sends 500 samples a second too. Our process has
one core, on which it is measured; the emulators have the others. The CAN sensor is compared with a bare client that
writes and reads the adapter's lines itself, at the same 1 kHz the driver allows itself, turn by turn.
With `--samples 100000` every fault of tests/wire/test_sensor_faults.py befalls every sensor until so many samples have
come: an hour. Faults that end a stream come again and again, 2 s after each opening, at most `--cycles` times for each
emulator. Slow sensors are several at a time, because some send 100 samples in a second; `--only` takes the faults of
one sensor and nothing else.
"""

import argparse
import os
import statistics
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import serial

from ftdrivers.ati import modbus
from ftdrivers.clock import REAL
from ftdrivers.errors import DeviceError
from ftdrivers.interfaces import ForceTorqueSensor, FtSamples, RobotArm
from ftdrivers.ur.arm import UrArm
from tests.benchmarks.common import show
from tests.wire.conftest import Station
from tests.wire.laboratory import Laboratory, numbers_in
from tests.wire.sensor_kinds import KINDS
from tests.wire.test_sensor_faults import (
    CYCLES,
    HEALTHY,
    SCRIPT,
    UNASKED,
    Emulator,
    Watched,
    applies,
    chances,
    starts,
    suffer,
)

PIECE_S = 2.0
POLL_S = 1e-3
CPU_TARGET, CAN_TARGET, DECODE_TARGET = 0.40, 0.95, 20.0
FOLLOW_SENSOR_TARGET, FOLLOW_ARM_TARGET = 0.25, 0.10


def report(name: str, figure: str, target: str, passed: bool) -> bool:
    show(f"{name:52} {figure:>34}   target {target:16} {'pass' if passed else 'FAIL'}")
    return passed


def pin(pid: int, cores: set[int]) -> None:
    """Keep a process, with all its threads, on some cores."""
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread.name), cores)


@contextmanager
def one_core_for_us(*others: int) -> Iterator[None]:
    """Keep this process on one core, and other processes off it where there are more."""
    cores = os.sched_getaffinity(0)
    ours = {max(cores)}
    for pid in others:
        pin(pid, cores - ours or cores)
    pin(os.getpid(), ours)
    try:
        yield
    finally:
        pin(os.getpid(), cores)


def missing(samples: FtSamples) -> tuple[int, int]:
    """Count the samples that were measured and did not arrive, and those that were never measured."""
    number, right = numbers_in(samples.wrench)
    return int((np.diff(number) % 160_000 - 1).sum()), int((~right).sum())


def serial_beside_an_arm(laboratory: Laboratory, folder: Path, seconds: float) -> bool:
    """Collect the 7 kHz stream and 500 Hz of RTDE while an arm is looked at, on one core."""
    with (
        closing(Laboratory()) as controller,  # a process of its own
        Station() as station,
        ExitStack() as plugs,
    ):
        emulators = [
            Emulator(laboratory, "ati-serial", folder / "serial", clock=REAL),
            Emulator(controller, "ur-ft", folder, clock=REAL),
        ]
        for emulator in emulators:
            plugs.callback(emulator.unplug)
        with (
            one_core_for_us(laboratory.process.pid, controller.process.pid, station.process.pid),
            closing(UrArm(station.host)) as arm,
            emulators[0].sensor() as serial_sensor,
            emulators[1].sensor() as rtde_sensor,
        ):
            arm.open()
            watched = [Watched(serial_sensor), Watched(rtde_sensor)]
            looks, cpu, begin = 0, time.process_time(), time.monotonic()
            while time.monotonic() - begin < seconds:
                arm.state()
                looks += 1
                serial_sensor.check()
                rtde_sensor.check()
                time.sleep(0.01)
            cpu_s, wall_s = time.process_time() - cpu, time.monotonic() - begin
            streams = [each.samples() for each in watched]
            healthy = serial_sensor.health().lost == 0
    passed = True
    for name, samples, rate_Hz in zip(("serial", "RTDE"), streams, (7000, 500), strict=True):
        lost, wrong = missing(samples)
        passed &= report(
            f"{rate_Hz} Hz {name} for {wall_s:.0f} s beside each other, lost or wrong",
            f"{lost} lost, {wrong} wrong of {len(samples)}",
            "0",
            lost == wrong == 0 and healthy,
        )
        passed &= report(
            "  rate",
            f"{len(samples) / wall_s:.1f} Hz",
            f"{rate_Hz} Hz +- 1 %",
            abs(len(samples) / wall_s / rate_Hz - 1) < 0.01,
        )
    share = cpu_s / wall_s
    return passed & report(
        f"  our process, on one core ({looks} looks at an arm)",
        f"{share:.1%} of a core",
        f"< {CPU_TARGET:.0%}",
        share < CPU_TARGET,
    )


def cpu_of_following(laboratory: Laboratory, folder: Path, seconds: float) -> bool:
    """Follow the 7 kHz stream, then an arm, each alone, with 50 reads a second; reports CPU seconds per second."""
    emulator = Emulator(laboratory, "ati-serial", folder / "followed", clock=REAL)
    passed = True
    with Station() as station, one_core_for_us(laboratory.process.pid, station.process.pid):
        arm = UrArm(station.host)
        with emulator.sensor() as sensor:
            passed &= follow_for(seconds, "7000 Hz serial", sensor, 7000.0, FOLLOW_SENSOR_TARGET)
        with closing(arm):
            arm.open()
            passed &= follow_for(seconds, "500 Hz arm", arm, 500.0, FOLLOW_ARM_TARGET)
    emulator.unplug()
    return passed


def follow_for(seconds: float, name: str, device: ForceTorqueSensor | RobotArm, rate_Hz: float, target: float) -> bool:
    """Follow one device and report what it costs."""
    with device.follow() as follow:
        samples, cpu_s, begin_s = 0, time.process_time(), time.monotonic()
        while (wall_s := time.monotonic() - begin_s) < seconds:
            time.sleep(0.02)
            samples += len(follow.read(0.1))
        share = (time.process_time() - cpu_s) / wall_s
    return report(
        f"following {name} for {wall_s:.0f} s, {samples / wall_s:.0f} Hz",
        f"{share:.4f} CPU s per s",
        f"< {target:g}, {rate_Hz:g} Hz",
        share < target and abs(samples / wall_s / rate_Hz - 1) < 0.01,
    )


def bare_can_rate(path: str, seconds: float) -> float:
    """Poll with as little as possible: one line out, two lines in, at most 1000 times a second."""
    done, next_s = 0, 0.0
    with serial.Serial(path, timeout=0.1) as port:
        port.write(b"C\rS5\rO\r")
        time.sleep(0.1)
        port.reset_input_buffer()
        begin = time.monotonic()
        while time.monotonic() - begin < seconds:
            time.sleep(max(0.0, next_s - time.monotonic()))
            next_s = max(next_s + POLL_S, time.monotonic())
            port.write(b"t2000\r")
            port.read_until(b"\r")
            while not (line := port.read_until(b"\r")).startswith(b"t2016") and line:
                pass
            done += 1
        rate_Hz = done / (time.monotonic() - begin)
        port.write(b"C\r")
    return rate_Hz


def can_against_ceiling(laboratory: Laboratory, folder: Path, latency_s: float) -> bool:
    """Compare the driver with the bare client, turn by turn."""
    emulator = Emulator(laboratory, "ati-can", folder / "can", clock=REAL)
    emulator.faults(delay_s=latency_s)
    ours, bare = [], []
    try:
        for _ in range(5):
            bare.append(bare_can_rate(str((folder / "can").resolve()), PIECE_S))
            with emulator.sensor() as sensor:
                ours.append(len(sensor.collect(PIECE_S)) / PIECE_S)
    finally:
        emulator.unplug()
    share = statistics.median(ours) / statistics.median(bare)
    return report(
        f"CAN polls, answers after {latency_s * 1e3:g} ms, at most 1 kHz",
        f"{statistics.median(ours):.0f} of {statistics.median(bare):.0f} Hz = {share:.1%}",
        f">= {CAN_TARGET:.0%}",
        share >= CAN_TARGET,
    )


def struct_loop(data: bytes) -> modbus.Records:
    """Decode the same to the same, record by record."""
    gauges, intact, error = [], [], []
    for at in range(0, len(data), 13):
        g0, g2, g4, g1, g3, g5, last = struct.unpack(">6hB", data[at : at + 13])
        gauges.append((g0, g1, g2, g3, g4, g5))
        intact.append(sum(data[at : at + 12]) & 0x7F == last & 0x7F)
        error.append(last & 0x80 != 0)
    return modbus.Records(np.array(gauges, np.int32), np.array(intact), np.ones(len(intact), bool), np.array(error))


def decode_speed() -> bool:
    """Compare decoding in batches with a loop over single records."""
    record = bytes.fromhex("0064012C01F4FF38FE70FDA850")
    passed = True
    for batch in (32, 512, 8192):
        data = record * batch
        one, other = struct_loop(data), modbus.decode_records(data)
        assert (one.gauges == other.gauges).all()
        assert (one.intact == other.intact).all()
        best = {}
        for name, decode in (("loop", struct_loop), ("batch", modbus.decode_records)):
            times = []
            for _ in range(max(10, 20_000 // batch)):
                begin = time.perf_counter()
                decode(data)
                times.append(time.perf_counter() - begin)
            best[name] = min(times) / batch
        ratio = best["loop"] / best["batch"]
        target = f">= {DECODE_TARGET:g} x" if batch == 8192 else "(for information)"
        passed &= report(
            f"decoding {batch} records at once, against a loop",
            f"{1e-6 / best['batch']:.2f} M/s, {ratio:.1f} x",
            target,
            ratio >= DECODE_TARGET or batch < 8192,
        )
    return passed


def crew(scheme: str, fault: str) -> int:
    """How many sensors of a kind suffer at a time, so that together they send about 1000 samples in a second."""
    slow = {("ati-can", "delay"): 16, ("ati-can", "drop"): 6}
    return slow.get((scheme, fault), {"ati-serial": 1, "robotiq-ft300": 12, "robotous-can": 5}.get(scheme, 2))


def endure(emulator: Emulator, fault: str, samples: int) -> Counter[str]:
    """Let a fault befall one sensor until so many samples have come; counts them, the wrong ones and errors by name."""
    count = Counter(received=0)
    while count["received"] < samples:
        sensor = emulator.sensor()
        try:
            sensor.open()
        except DeviceError as error:  # a busy computer
            count[type(error).__name__] += 1
            continue
        with closing(sensor):
            watched = Watched(sensor)
            emulator.faults(**chances(emulator.kind.scheme, fault))
            count.update(type(error).__name__ for error in suffer(sensor, REAL, PIECE_S * 5))
            emulator.faults(**HEALTHY)
            time.sleep(0.05)  # what was delayed belongs to this stream
        count["received"] += len(watched.samples())
        count["wrong"] += watched.wrong()
    return count


def repeat(emulator: Emulator, fault: str, samples: int, cycles: int) -> Counter[str]:
    """Let a fault end the stream of one sensor again and again; counts as `endure` does, and the cycles."""
    count = Counter(received=0)
    while count["received"] < samples and count["cycles"] < cycles:
        count["cycles"] += 1
        try:
            for watched in CYCLES[fault](emulator, PIECE_S):
                count["received"] += len(watched.samples())
                count["wrong"] += watched.wrong()
        except DeviceError as error:  # a busy computer
            count[type(error).__name__] += 1
        except (AssertionError, pytest.fail.Exception) as error:
            sys.stderr.write(f"{emulator.kind.scheme}, {fault}: {error}\n")
            count["UNDOCUMENTED"] += 1
        emulator.unplug()
        emulator.plug_in()
    return count


def all_faults(laboratory: Laboratory, folder: Path, scheme: str, samples: int, cycles: int) -> bool:
    """Let every fault befall one kind of sensor and compare each sample with the truth."""
    passed = True
    lasting = {fault: partial(endure, fault=fault) for fault in SCRIPT if applies(scheme, fault)}
    ending = {fault: partial(repeat, fault=fault, cycles=cycles) for fault in CYCLES if (scheme, fault) not in UNASKED}
    for fault, suffered in (lasting | ending).items():
        size = crew(scheme, fault)
        emulators = [
            Emulator(laboratory, scheme, folder / f"{scheme}-{fault}-{number}", starts(scheme, fault), REAL)
            for number in range(size)
        ]
        with ThreadPoolExecutor(size) as pool:
            count = sum(pool.map(partial(suffered, samples=-(-samples // size)), emulators), Counter())
        for emulator in emulators:
            emulator.unplug()
        received, wrong, undocumented = count.pop("received", 0), count.pop("wrong", 0), count["UNDOCUMENTED"]
        errors = "".join(f", {number} {error}" for error, number in count.items() if number)
        passed &= report(
            f"{scheme}, {fault}" + (f" ({size} at a time)" if size > 1 else ""),
            f"{wrong} wrong of {received}{errors}",
            "0 wrong",
            not wrong and not undocumented and received > 0,
        )
    return passed


def main() -> int:
    """Run the benchmarks; returns 1 when a target is missed."""
    parser = argparse.ArgumentParser(description="What the streams carry.")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the 7 kHz stream")
    parser.add_argument("--samples", type=int, default=0, help="for each sensor and fault; none without")
    parser.add_argument("--cycles", type=int, default=50, help="at most, of a fault that ends the stream")
    parser.add_argument("--only", choices=KINDS, help="just the faults of this sensor")
    options = parser.parse_args()
    laboratory = Laboratory()
    try:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            passed = True
            if not options.only:
                passed = decode_speed()
                passed &= cpu_of_following(laboratory, folder, options.seconds / 4)
                passed &= serial_beside_an_arm(laboratory, folder, options.seconds)
                for latency_s in (0.0, 0.001):
                    passed &= can_against_ceiling(laboratory, folder, latency_s)
            for scheme in [options.only] if options.only else KINDS:
                if options.samples:
                    passed &= all_faults(laboratory, folder, scheme, options.samples, options.cycles)
    finally:
        laboratory.close()
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
