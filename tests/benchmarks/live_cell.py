"""The compensated stream of an emulated cell over real wires: delay, residual of a moving arm, a push, cost.

    uv run python -m tests.benchmarks.live_cell [--sensor serial] [--seconds 20]

The arm swings with 1 rad/s, 2 rad/s² and 2 m/s², while the links delay the samples of the sensor and of the arm.
"""

import argparse
import sys
import time
from dataclasses import replace

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.model import Array
from ftdrive.cell.config import CellConfig
from ftdrive.cell.emulated import Station
from ftdrive.live.samples import Stages, WrenchFrame
from ftdrive.live.stream import CompensatedStream
from tests.unit.ftdrive.live.simulated import calibrated_from

HEIGHT_M = 0.03
OPTIONS = ("--time-scale", "1", "--sensor-origin", f"0,0,{HEIGHT_M}", "--inertia", "0,0,0,0,0,0")


ages_ms: list[float] = []


def read(stream: CompensatedStream, seconds: float) -> tuple[Array, Array]:
    """Wrenches (n, 6) and whether they are contact (n,), for so many seconds of the cell."""
    end_s = stream.clock.now_s() + seconds
    blocks = []
    while stream.clock.now_s() < end_s:
        blocks.append(stream.read())
        ages_ms.append((stream.clock.now_ns() - int(blocks[-1].t_host_ns[-1])) / 1e6)
    return np.concatenate([block.wrench for block in blocks]), np.concatenate([block.in_contact for block in blocks])


def rms(wrench: Array) -> Array:
    return np.asarray(np.sqrt(np.square(wrench).mean(axis=0)))


def moving(
    station: Station, cell: CellConfig, calibration: CalibrationResult, delays_ms: tuple[float, float], seconds: float
) -> None:
    sensor_ms, rtde_ms = delays_ms
    station.control(do="delay", sensor_ms=sensor_ms, rtde_ms=rtde_ms)
    with CompensatedStream(cell, calibration, stages=Stages(inertia=True)) as stream:
        read(stream, 1.0)
        still = rms(read(stream, 2.0)[0])
        while "error" in station.control(do="swing", seconds=1.5 * seconds):  # until the last swing has ended
            read(stream, 1.0)
        cpu_s, begin_s = time.process_time(), stream.clock.now_s()
        read(stream, seconds / 2)
        wrench, _ = read(stream, seconds / 2)
        cpu_s = (time.process_time() - cpu_s) / (stream.clock.now_s() - begin_s)
        status = stream.status()
        stream.stages = Stages()
        ages_ms.clear()
        static, _ = read(stream, seconds / 4)
        kinds = [event.kind for event in stream.take_events()]
    expected_ms = sensor_ms - rtde_ms
    ratio, beside = (rms(each) / still for each in (wrench, static))
    sys.stdout.write(
        f"sensor +{sensor_ms:g} ms, arm +{rtde_ms:g} ms: delay {1e3 * status.delay_s:+.2f} ± "
        f"{1e3 * status.delay_sigma_s:.2f} ms (links differ by {expected_ms:+g}), residual / noise "
        f"{ratio[:3].max():.2f} force {ratio[3:].max():.2f} torque, without inertia {beside[:3].max():.0f} and "
        f"{beside[3:].max():.0f}, CPU {100 * cpu_s:.0f} %, {status.sensor.rate_Hz:.0f} and "
        f"{status.arm.rate_Hz:.0f} Hz, gaps {kinds.count('gap')}, "
        f"newest sample of a block {np.median(ages_ms):.1f} ms old (p95 {np.percentile(ages_ms, 95):.1f})\n"
    )
    sys.stdout.flush()


def push(station: Station, cell: CellConfig, calibration: CalibrationResult) -> None:
    """A push along +X of the base is +X in every frame."""
    with CompensatedStream(cell, calibration, frame=WrenchFrame("base")) as stream:
        read(stream, 1.0)
        station.control(do="push", wrench=[10.0, 0, 0, 0, 0, 0], axes="base", seconds=1.5)
        for axes in ("base", "sensor", "flange", "tcp"):
            stream.frame = WrenchFrame(axes)
            wrench, contact = read(stream, 0.3)
            R = stream.read().R_base_flange[-1]
            sys.stdout.write(
                f"push of +10 N along X of the base, {axes} axes: {np.round(np.median(wrench, 0)[:3], 2)} N "
            )
            sys.stdout.write(f"contact {100 * contact.mean():.0f} %, flange x in base {np.round(R[:, 0], 2)}\n")
        read(stream, 2.0)
        for event in stream.take_events():
            sys.stdout.write(f"   {event.kind}: {event.text} {dict(event.values) if event.kind == 'contact' else ''}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", default="serial")
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    with Station(options.sensor, OPTIONS) as station:
        calibration = calibrated_from(station.truth)
        cell = replace(station.cell, sensor=replace(station.cell.sensor, height_mm=1e3 * HEIGHT_M))
        push(station, cell, calibration)
        for delays_ms in ((0.0, 0.0), (8.0, 0.0), (20.0, 0.0), (0.0, 10.0)):
            moving(station, cell, calibration, delays_ms, options.seconds)


if __name__ == "__main__":
    main()
