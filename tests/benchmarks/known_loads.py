"""Contacts decoded by the matrix of a sensor: error against sigma, with and without known loads, and mistakes.

    uv run python -m tests.benchmarks.known_loads [--quick] [--only PART]

Sensors: tests/loaded_sensor.py, seeds from 0 up, 60 a row (mistakes 50, right ones 200; with --quick 10 and 30).
Contacts: 40 a sensor, 30 to 100 N at the tip (200 mm from the flange), any direction. Prints one row a figure; the exit
code is the number of failed rows.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from ftcalib import CalibrationDataset, NotObservable, Setup, solve
from ftcalib.loads.check import check_hung_load
from ftcalib.loads.model import KnownLoad, LoadRun
from ftcalib.loads.solve import solve_loads
from ftcalib.sensor_matrix import SensorMatrix
from tests.benchmarks.common import Array, Lab, Row, band, most, run
from tests.loaded_sensor import (
    LEVER_M,
    PROTOCOLS,
    SIDE_M,
    TIP_M,
    TOOL,
    TOOL_COM_M,
    TOOL_KG,
    LoadedSensor,
    Pull,
    Set,
    with_load,
)

SENSORS = 60
# With this the analytic errors of tools that were weighed, or not, are those of the note on known loads, section 6.
FARTHER_COM_M = np.array([0.004, 0.01, 0.08])
# Error of the force at the tip, rms.
LIMITS_PERCENT = {"hung, tip": 0.30, "hung, side and tip": 0.35, "bar, gripped twice": 0.38}


def judged(
    sensor: LoadedSensor,
    matrix: SensorMatrix,
    tool: CalibrationDataset,
    weighed_kg: tuple[float, float] | None = None,
    torque_Nm: float = 0.0,
    most_N: float = 100.0,
) -> dict[str, object]:
    """Return errors of decoded contacts and their sigmas, after the calibration of the tool."""
    setup = Setup() if weighed_kg is None else Setup(tool_mass_kg=weighed_kg[0], tool_mass_sigma_kg=weighed_kg[1])
    result = replace(solve(tool, setup=setup), sensor=matrix)
    if result.verdict == "rejected":
        raise NotObservable("the calibration of the tool is rejected")
    contact = result.contact
    true, read = sensor.contacts(40, torque_Nm, most_N)
    R = result.R_flange_sensor
    e = contact.decode(read) - np.concatenate([part @ R for part in np.split(true, 2, axis=1)], axis=1)
    C = contact.covariance(contact.decode(read))
    sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    force = np.linalg.norm(true[:, :3], axis=1)
    return {
        "square": np.mean(e**2 / sigma**2, axis=0),
        "within": np.mean(np.abs(e) < 1.96 * sigma, axis=0),
        "force": np.sqrt(np.mean((np.linalg.norm(e[:, :3], axis=1) / force) ** 2)),
        "force_N": np.sqrt(np.mean(np.sum(e[:, :3] ** 2, axis=1))),
        "torque_Nm": np.sqrt(np.mean(np.sum(e[:, 3:] ** 2, axis=1))),
        "sigma_N": np.sqrt(np.mean(np.sum(sigma[:, :3] ** 2, axis=1))),
    }


def with_loads(name: str, seed: int, *, not_linear: float = 0.0, **contacts: float) -> dict[str, object]:
    """Decode by the matrix of a protocol."""
    sensor = LoadedSensor(seed, not_linear=not_linear)
    runs = sensor.runs(PROTOCOLS[name])
    solution = solve_loads(runs, SensorMatrix.usual(lever_m=LEVER_M), tool_mass_kg=sensor.weighed_tool_kg())
    found = judged(sensor, solution.sensor, runs[0].dataset, None, **contacts)
    return {**found, "refused": solution.verdict == "rejected"}


def without_loads(gain: float, seed: int, *, weighed: bool = False, com_m: Array = TOOL_COM_M) -> dict[str, object]:
    """Decode by what the tool alone shows."""
    sensor = LoadedSensor(seed, gain)
    tool = sensor.dataset(24, [(TOOL_KG, com_m)], hung=False)
    weighed_kg = sensor.weighed_tool_kg() if weighed else None
    return judged(sensor, SensorMatrix.usual(lever_m=LEVER_M), tool, weighed_kg)


def protocols(lab: Lab) -> Iterator[Row]:
    """Each protocol of the note."""
    n = lab.count(SENSORS, 12)
    for name in PROTOCOLS:
        for torque_Nm in (0.0, 5.0):
            found = lab.simulate(partial(with_loads, name, torque_Nm=torque_Nm), n)
            label = f"{name}{', 5 N·m more' if torque_Nm else ''}"
            yield from figures(label, found, n, 0.85, 1.2)
            limit = (
                LIMITS_PERCENT.get(name, np.inf) if not torque_Nm or name[-3:] != "tip" or "side" in name else np.inf
            )
            percent = 100 * float(np.sqrt(np.mean(found["force"] ** 2)))
            yield most(f"{label}: error of the force", percent, limit, n, " %")
            torque = float(np.sqrt(np.mean(found["torque_Nm"] ** 2)))
            yield most(f"{label}: error of the torque", torque, np.inf, n, " N·m")
            yield most(f"{label}: refused", 100 * float(np.mean(found["refused"])), 2.0, n, " %")
    found = lab.simulate(partial(with_loads, "hung, side and tip", not_linear=0.003, most_N=60.0), n)
    yield from figures("hung, side and tip, .3 % of range not linear, to 60 N", found, n, 0.7, 1.3)


def figures(label: str, found: dict[str, Array], n: int, low: float, high: float) -> Iterator[Row]:
    """Error over sigma and the share within the interval of 95 %."""
    square = found["square"]
    force, torque = (float(np.sqrt(np.mean(square[:, part]))) for part in (slice(3), slice(3, 6)))
    yield band(f"{label}: error / sigma of the force", force, low, high, n)
    yield band(f"{label}: error / sigma of the torque", torque, low, high, n)
    yield band(f"{label}: within 95 %", 100 * float(np.mean(found["within"])), 92.0, np.inf, n, " %")


def assumed(lab: Lab) -> Iterator[Row]:
    """Without loads: gains of 1, 2 and 5 % under the usual prior of 2 %, the tool weighed or not."""
    n = lab.count(SENSORS, 12)
    for gain, weighed in product((0.01, 0.02, 0.05), (False, True)):
        found = lab.simulate(partial(without_loads, gain, weighed=weighed), n)
        square, name = found["square"], f"tool{' weighed' if weighed else ''}, gain {100 * gain:g} %"
        for label, part in (("force", slice(3)), ("torque", slice(3, 6))):
            ratio = float(np.sqrt(np.mean(square[:, part])))
            yield band(f"{name}: error / sigma of the {label}", ratio, 0.5, 1.3, n)
        percent = 100 * float(np.sqrt(np.mean(found["force"] ** 2)))
        yield most(f"{name}: error of the force", percent, 3.0 * gain / 0.02 * 1.25, n, " %")
        yield most(f"{name}: stated", float(np.sqrt(np.mean(found["sigma_N"] ** 2))), np.inf, n, " N")

    found = lab.simulate(partial(without_loads, 0.02, weighed=True, com_m=FARTHER_COM_M), n)
    percent = 100 * float(np.sqrt(np.mean(found["force"] ** 2)))
    yield most("tool weighed, centre of mass at 80 mm, gain 2 %: error of the force", percent, 2.4, n, " %")


def checked(poses: int, seed: int) -> dict[str, object]:
    """Check a sensor that reads 1 % too much by 1 kg at the tip, after a tare."""
    sensor = LoadedSensor(seed, 0.0)
    sensor.E = 0.01 * np.eye(6)
    tool, hung = sensor.runs([TOOL, Set("tip", poses, 1.0, TIP_M, hung=True)])
    result = solve(tool.dataset)
    assert hung.dataset.wrench_cov is not None
    u = sensor.gravity @ hung.dataset.R_base_flange
    s = TOOL_KG * TOOL_COM_M + TIP_M
    free = sensor.read(np.concatenate([(TOOL_KG + 1.0) * u, np.cross(s, u)], axis=1))
    tared = (hung.dataset.wrench - free).mean(axis=0) - result.parameters.bias
    found = check_hung_load(
        result,
        result,
        KnownLoad("tip", 1.0, 0.001, (0.0, 0.0, 0.2)),
        (hung.dataset.R_base_flange, hung.dataset.wrench - tared, hung.dataset.wrench_cov),
        drift=np.zeros(6),
        p_flange_sensor_m=np.zeros(3),
    )
    off = (found.scale_error - 0.01) / found.scale_sigma
    return {"sigma": found.scale_sigma, "off": off, "found": found.is_significant, "off_mm": 1e3 * found.off_m}


def check(lab: Lab) -> Iterator[Row]:
    """One weight on a string."""
    n = lab.count(SENSORS, 12)
    for poses in (1, 4):
        found = lab.simulate(partial(checked, poses), n)
        label = f"check with 1 kg, {poses} pose{'s' if poses > 1 else ''}"
        yield most(f"{label}: sigma of the scale", 100 * float(np.median(found["sigma"])), 0.5, n, " %")
        yield most(f"{label}: error / sigma", float(np.sqrt(np.mean(found["off"] ** 2))), 1.3, n)
        yield band(f"{label}: 1 % found (2 sigma)", 100 * float(np.mean(found["found"])), 90.0, np.inf, n, " %")


Changed = Callable[[LoadedSensor, list[LoadRun]], list[LoadRun]]


def _dwells(runs: list[LoadRun], row: int, change: Callable[[Array], Array]) -> list[LoadRun]:
    """Return the runs with other readings in one of them."""
    dataset = runs[row].dataset
    other = replace(dataset, wrench=change(np.array(dataset.wrench)))
    return [*runs[:row], replace(runs[row], dataset=other), *runs[row + 1 :]]


def _again(
    sensor: LoadedSensor, runs: list[LoadRun], row: int, mass_kg: float, place_m: Array, pull: Pull | None = None
) -> list[LoadRun]:
    """Return the runs with a load that truly is another, at another place."""
    dataset = sensor.dataset(12, [(TOOL_KG, TOOL_COM_M), (mass_kg, place_m)], hung=True, pull=pull)
    return [*runs[:row], replace(runs[row], dataset=dataset), *runs[row + 1 :]]


def _touched(wrench: Array) -> Array:
    wrench[[3, 8]] += [1.0, -0.5, 0.8, 0.05, 0.08, 0.02], [-0.6, 1.0, 0.3, 0.06, -0.05, 0.03]
    return wrench


def _bumped(wrench: Array) -> Array:
    wrench[6:] += [0.5, -0.4, 0.3, 0.02, 0.02, -0.01]
    return wrench


def _slipped(sensor: LoadedSensor, runs: list[LoadRun]) -> list[LoadRun]:
    one = sensor.dataset(12, [(TOOL_KG, TOOL_COM_M), (2.0, SIDE_M)], hung=True)
    u = sensor.gravity @ one.R_base_flange[7:]
    moved = np.concatenate([0 * u, np.cross(2.0 * np.array([0, 0.006, 0]), u)], axis=1)
    wrench = np.array(one.wrench)
    wrench[7:] += sensor.read(moved)
    return [runs[0], replace(runs[1], dataset=replace(one, wrench=wrench)), *runs[2:]]


MISTAKES: dict[str, tuple[set[str], Changed]] = {
    "mass 5 % off": ({"load_mass"}, lambda _, r: with_load(r, 1, mass_kg=2.1, mass_sigma_kg=0.0021)),
    "mass in lb": (
        {"load_in_pounds", "load_in_kilograms"},
        lambda _, r: with_load(r, 1, mass_kg=4.409, mass_sigma_kg=0.0044),
    ),
    "mass in lb, converted": (
        {"load_in_pounds", "load_in_kilograms"},
        lambda _, r: with_load(r, 2, mass_kg=0.907, mass_sigma_kg=0.0009),
    ),
    "wrong hole, 40 mm": ({"load_place"}, lambda s, r: _again(s, r, 1, 2.0, SIDE_M + np.array([0.04, 0, 0]))),
    "points swapped": ({"loads_swapped"}, lambda s, r: _again(s, _again(s, r, 1, 2.0, TIP_M), 2, 2.0, SIDE_M)),
    "load not attached": ({"load_absent"}, lambda s, r: _again(s, r, 1, 1e-6, SIDE_M)),
    "slipped 6 mm": ({"load_moved"}, _slipped),
    "touched in two poses": ({"load_touched"}, lambda _, r: _dwells(r, 1, _touched)),
    "bump": ({"load_bias_stepped"}, lambda _, r: _dwells(r, 1, _bumped)),
    "pulled sideways, .6 N": (
        {"load_pulled"},
        lambda s, r: _again(s, r, 1, 2.0, SIDE_M, pull=Pull(np.array([0.5, 0.33, 0.0]), SIDE_M)),
    ),
}


def with_mistake(name: str, seed: int) -> dict[str, object]:
    """Solve runs with one mistake."""
    sensor = LoadedSensor(seed)
    runs = sensor.runs(PROTOCOLS["hung, side and tip"])
    tool_kg, sigma_kg = sensor.weighed_tool_kg()
    accepted: set[str] = set()
    if name == "tool mass 10 % off":
        accepted, tool_kg = {"load_tool_mass"}, 1.1 * tool_kg
    elif name:
        accepted, change = MISTAKES[name]
        runs = change(sensor, runs)
    solution = solve_loads(runs, SensorMatrix.usual(lever_m=LEVER_M), tool_mass_kg=(tool_kg, sigma_kg))
    first = solution.findings[0].code if solution.findings else ""
    return {"first": first in accepted, "saved": solution.verdict != "rejected", "named": bool(first)}


def mistakes(lab: Lab) -> Iterator[Row]:
    """Each mistake of the note, and right runs."""
    n = lab.count(50, 8)
    for name in [*MISTAKES, "tool mass 10 % off"]:
        found = lab.simulate(partial(with_mistake, name), n, seed=1000)
        yield band(f"{name}: named first", 100 * float(np.mean(found["first"])), 90.0, np.inf, n, " %")
        yield most(f"{name}: saved", 100 * float(np.mean(found["saved"])), 0.0, n, " %")
    n = lab.count(200, 20)
    found = lab.simulate(partial(with_mistake, ""), n, seed=2000)
    yield most("right runs: a mistake is named", 100 * float(np.mean(found["named"])), 0.5, n, " %")


if __name__ == "__main__":
    sys.exit(run({"protocols": protocols, "assumed": assumed, "check": check, "mistakes": mistakes}, __doc__ or ""))
