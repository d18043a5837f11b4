"""`ftdrive weigh` on an emulated cell: does sigma hold, and what is named that is no weight.

    uv run python -m tests.benchmarks.weigh [--weights 200] [--others 20]

A sensor of 200 Hz with noise of 0.05 N, its wires, the stream and one pose of half a second for each weight. The
calibration has 24 poses. Rows: parts of 0 to 3 kg after a zero in the same pose; without a zero, after drift of 0.5 N;
a cable of 0.1 N·m, of random direction and point; a push by hand that trembles; two parts, counted; a part that slips
meanwhile.
Exit code: 1 if a target is missed.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import click
import numpy as np

from ftcalib.after.weighing import Weight
from ftcalib.model import Array
from ftdrive.cell.emulated import Station
from ftdrive.live.stream import CompensatedStream
from ftdrive.live.weighing import CannotWeigh, Scale, count_of
from tests.unit.ftdrive.live.simulated import calibrated_from

OPTIONS = ("--time-scale", "20", "--seed", "5")
WRIST_DEG = (40.0, 40.0, 90.0)
PARTS_KG, PART_M = (0.0, 3.0), 0.04
CABLE_NM, CABLE_LEVER_M = 0.1, (0.1, 0.4)
SLIP_M = 0.005


class Bench:
    """One cell."""

    def __init__(self, station: Station, stream: CompensatedStream, seed: int) -> None:
        self.station, self.stream, self.rng = station, stream, np.random.default_rng(seed)
        self.truth = station.truth
        self.q = np.array(station.control(do="state")["q_rad"])
        self.com_m = np.array(self.truth["p_sensor_com_m"])

    def read(self, seconds: float) -> None:
        """Read the stream for so long."""
        end_s = self.stream.clock.now_s() + seconds
        while self.stream.clock.now_s() < end_s:
            self.stream.read()

    def turn(self) -> None:
        """Turn the wrist at random by hand."""
        turn = np.radians(self.rng.uniform(-1, 1, 3) * WRIST_DEG)
        self.station.control(do="hand-move", q_rad=[*self.q[:3], *(self.q[3:] + turn)], speed_rad_s=1.0)
        self.read(0.5)

    def hold(self, mass_kg: float, com_m: Array) -> None:
        """Change the part in the gripper."""
        tool_kg = self.truth["mass_kg"]
        joined = (tool_kg * self.com_m + mass_kg * com_m) / (tool_kg + mass_kg)
        self.station.control(do="payload-shift", mass_kg=tool_kg + mass_kg, p_sensor_com_m=joined.tolist())

    def part(self) -> tuple[float, Array]:
        """Draw a part."""
        return float(self.rng.uniform(*PARTS_KG)), 2 * self.com_m + self.rng.uniform(-PART_M, PART_M, 3) / 2

    def settled(self, act: Callable[[], object]) -> object:
        """Do something at rest, again while chance finds the noise unsteady; return its result or the last refusal."""
        refusal = CannotWeigh("samples")
        for _ in range(4):
            self.read(0.55)
            try:
                return act()
            except CannotWeigh as error:
                refusal = error
                if error.code not in ("unsteady", "samples", "moving"):
                    break
        return refusal

    def zero(self) -> Scale:
        """Tare the empty gripper."""
        self.hold(0.0, self.com_m)
        scale = Scale(self.stream)
        while isinstance(self.settled(scale.zero), CannotWeigh):
            pass
        return scale


def weights(bench: Bench, n: int, *, zero: bool) -> dict[str, float]:
    """Weigh n parts, each in a pose of its own; return the statistics."""
    z, sigma, lost = [], [], Counter[str]()
    for _ in range(n):
        bench.turn()
        scale = bench.zero() if zero else Scale(bench.stream)
        mass_kg, com_m = bench.part()
        bench.hold(mass_kg, com_m)
        found = bench.settled(scale.weigh)
        if isinstance(found, CannotWeigh):
            lost[found.code] += 1
        elif isinstance(found, Weight):
            z.append((found.mass_kg - mass_kg) / found.mass_sigma_kg)
            sigma.append(found.mass_sigma_kg)
    return {
        "weighed": len(z),
        "rms error / sigma": float(np.sqrt(np.mean(np.square(z)))),
        "mean |error| / sigma x 1.25": float(1.2533 * np.mean(np.abs(z))),
        "worst": float(np.abs(z).max()),
        "median sigma g": 1e3 * float(np.median(sigma)),
        "largest sigma g": 1e3 * max(sigma),
        "refused": float(sum(lost.values())),
    }


def disturbed(bench: Bench, n: int, disturb: Callable[[Scale], object]) -> Counter[str]:
    """Weigh n times with a disturbance; count what is named, "clean" if nothing is."""
    found = Counter[str]()
    for _ in range(n):
        bench.turn()
        scale = bench.zero()
        bench.hold(*bench.part())
        try:
            answer = disturb(scale)
            found["clean" if not isinstance(answer, CannotWeigh) else answer.code] += 1
        except CannotWeigh as error:
            found[error.code] += 1
        with suppress(Exception):
            bench.station.control(do="cable", on=False)
        bench.station.control(do="push", wrench=[0.0] * 6)
    return found


def cable(bench: Bench, scale: Scale) -> object:
    """Weigh with a cable at a point beyond the tool, which pulls in any direction."""
    lever = bench.rng.normal(size=3)
    point_m = bench.com_m + lever / np.linalg.norm(lever) * bench.rng.uniform(*CABLE_LEVER_M)
    pull = bench.rng.normal(size=3)
    torque = np.linalg.norm(np.cross(point_m, pull))
    force_N = (pull * CABLE_NM / torque).tolist()
    bench.station.control(do="cable", force_N=force_N, point_m=point_m.tolist())
    return bench.settled(scale.weigh)


def push(bench: Bench, scale: Scale) -> object:
    """Weigh while a hand holds the tool: 3 N that change by some percent ten times a second."""
    wrench = np.concatenate([bench.rng.normal(size=3) * 3, bench.rng.normal(size=3) * 0.2])
    refusal: object = None
    for _ in range(8):
        bench.station.control(do="push", wrench=(wrench * bench.rng.normal(1, 0.1)).tolist())
        bench.read(0.1)
    with suppress(CannotWeigh):
        return scale.weigh()
    bench.read(0.1)
    try:
        refusal = scale.weigh()
    except CannotWeigh as error:
        refusal = error
    return refusal


def two_parts(bench: Bench, scale: Scale) -> object:
    """Weigh two parts where one is expected; return the refusal, or the number if it is 1."""
    part_kg = float(bench.rng.uniform(0.05, 1.5))
    bench.hold(2 * part_kg, 2 * bench.com_m)
    found = bench.settled(scale.weigh)
    if isinstance(found, Weight) and count_of(found, part_kg) == 2:
        return CannotWeigh("count", found)
    return found


def slip(bench: Bench, scale: Scale) -> object:
    """Weigh while the part slips in the gripper."""
    mass_kg, com_m = bench.part()
    mass_kg = max(mass_kg, 0.2)
    bench.hold(mass_kg, com_m)
    bench.read(0.4)
    aside = bench.rng.normal(size=3)
    bench.hold(mass_kg, com_m + SLIP_M * aside / np.linalg.norm(aside))
    bench.read(0.25)
    return scale.weigh()


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=int, default=200)
    parser.add_argument("--others", type=int, default=20)
    options = parser.parse_args()
    good = True

    def show(name: str, found: Any, passed: bool) -> None:
        nonlocal good
        good &= passed
        click.echo(f"{'ok ' if passed else 'NOT'} {name}: {found}")

    with Station("robotous-serial", OPTIONS) as station:
        cell = replace(station.cell, sensor=replace(station.cell.sensor, height_mm=None))
        calibration = calibrated_from(station.truth)
        with CompensatedStream(cell, calibration) as stream:
            bench = Bench(station, stream, 1)
            bench.read(2.0)
            found = weights(bench, options.weights, zero=True)
            clean = found["weighed"] == options.weights and found["worst"] < 4 and found["median sigma g"] <= 1
            show("after a zero", _rounded(found), clean and 0.9 <= found["rms error / sigma"] <= 1.1)
            for name, disturb in (("cable", cable), ("push", push), ("two parts", two_parts), ("slip", slip)):
                counts = disturbed(bench, options.others, lambda scale, disturb=disturb: disturb(bench, scale))  # type: ignore[misc]
                show(name, dict(counts), not counts["clean"])
            bench.hold(0.0, bench.com_m)
            station.control(do="drift", force_N=[0.29, -0.29, 0.29], seconds=0.1)
        with CompensatedStream(cell, calibration) as stream:  # without a tare
            bench.stream = stream
            bench.read(1.0)
            found = weights(bench, options.weights // 4, zero=False)
            show("no zero, 0.5 N of drift", _rounded(found), found["worst"] < 2)
    return 0 if good else 1


def _rounded(found: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 2) for name, value in found.items()}


if __name__ == "__main__":
    sys.exit(main())
