"""Faults in poses and wrenches: is the cause named first, does its advice lead to the truth, are sound sessions quiet?

    uv run python -m tests.benchmarks.faults [--runs 100] [--sound 1000] [--only WORD] [--poses haar]

Prints for each fault, with 24 and 12 poses, with and without measured noise: how often its name came first, how often
the verdict was good, and how often the first reason, followed word by word, led to the truth.
"""

import argparse
import os
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, NotObservable, Parameters, read_csv, solve
from ftcalib.errors import BadDataset
from ftcalib.known import Known
from ftcalib.model import STANDARD_GRAVITY_M_S2, UP_IN_BASE, Array
from ftdrive.checks.plausibility import judged
from tests.benchmarks import scenarios as sim
from tests.benchmarks.scenarios import Rng, Truth

NOISE = sim.sigma(400)
MASS_KG = sim.WEIGHT_N / STANDARD_GRAVITY_M_S2
STEPS = 3
"""Faults that may be named one after the other, such as two units."""
ROTATION_RAD, WEIGHT_SHARE = np.deg2rad(1.0), 0.01
"""An answer this close is the truth: mounting, and the wrench over all orientations, torque at the centre of mass."""
LBF_N, KGF_N, LBF_IN_NM = 4.4482216, 9.80665, 0.11298483
HEIGHT_MM = 40.0
ALL_NAMES = ("inverted", "quaternion", "base axes", "each wrench", "axes disagree", "reversed", "reaction", "N·mm",
             "forces in", "stuck", "identical", "one tool", "other poses", "outside the tool", "hang on",
             "[workcell]")  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A session as its user hands it in."""

    truth: Truth
    R: Array
    wrench: Array
    sigma: Array = field(default_factory=lambda: NOISE)
    known: Known | None = None
    payload_kg: float | None = None
    up: Array = field(default_factory=lambda: UP_IN_BASE)
    unit_rad: float = 1.0
    """Of the rotation vectors in the file."""
    setup: dict[str, Any] = field(default_factory=dict)
    """The described cell, as `ftdrive.checks.plausibility` takes it."""
    rng: Rng = field(default_factory=np.random.default_rng)
    """Draws what a fault leaves open."""


# Faults


def quaternions(case: Case, shift: int = 1) -> Case:
    numbers = np.roll(Rotation.from_matrix(case.R).as_quat(), shift, axis=1)
    return replace(case, R=Rotation.from_quat(numbers).as_matrix())


def transposed(case: Case) -> Case:
    return replace(case, R=np.swapaxes(case.R, 1, 2))


def in_degrees(case: Case) -> Case:
    return replace(case, unit_rad=np.deg2rad(1.0))


def shifted(case: Case, by: int = 1) -> Case:
    early, late = slice(None, -1), slice(1, None)
    own, other = (late, early) if by > 0 else (early, late)
    return replace(case, R=case.R[own], wrench=case.wrench[other])


def elsewhere(case: Case, rows: Callable[[int, Rng], NDArray[Any]]) -> Case:
    """Pair the wrenches with other poses."""
    return replace(case, wrench=case.wrench[rows(len(case.R), case.rng)])


def mirrored(case: Case, S: Array) -> Case:
    """Give the orientations in left-handed axes."""
    return replace(case, R=S @ case.R @ S)


def as_euler_angles(case: Case) -> Case:
    """Read roll, pitch and yaw as a rotation vector."""
    angles = Rotation.from_matrix(case.R).as_euler("xyz")
    return replace(case, R=Rotation.from_rotvec(angles).as_matrix())


def axes(case: Case, *, Q: Array, groups: str) -> Case:
    wrench = case.wrench.copy()
    for k, group in enumerate("FT"):
        if group in groups:
            wrench[:, 3 * k : 3 * k + 3] = wrench[:, 3 * k : 3 * k + 3] @ Q.T
    return replace(case, wrench=wrench)


def turned(wrench: Array, R: Array) -> Array:
    return np.concatenate([np.einsum("nij,nj->ni", R, part) for part in (wrench[:, :3], wrench[:, 3:])], axis=1)


def in_base(case: Case, *, bias: bool = True) -> Case:
    R_base_sensor = case.R @ case.truth.R.T
    if not bias:
        t = case.truth
        wrench = case.wrench - np.concatenate([t.F0, t.T0])
        case = replace(case, wrench=wrench, truth=replace(t, F0=np.zeros(3), T0=np.zeros(3)))
    return replace(case, wrench=turned(case.wrench, R_base_sensor))


def scaled(case: Case, *, force: float = 1.0, torque: float = 1.0) -> Case:
    factor = np.repeat([force, torque], 3)
    return replace(case, wrench=case.wrench / factor, sigma=case.sigma / factor)


def stuck(case: Case) -> Case:
    wrench, channel = case.wrench.copy(), case.rng.integers(6)
    wrench[:, channel] = wrench[0, channel]
    return replace(case, wrench=wrench)


def copied(case: Case) -> Case:
    rows = np.append(np.arange(len(case.R)), case.rng.choice(len(case.R), 2, replace=False))
    return replace(case, R=case.R[rows], wrench=case.wrench[rows])


def stale(case: Case) -> Case:
    wrench, row = case.wrench.copy(), case.rng.integers(1, len(case.R))
    wrench[row] = wrench[row - 1]
    return replace(case, wrench=wrench)


def drifted(case: Case) -> Case:
    line = np.linspace(-1, 1, len(case.R))[:, None]
    return replace(case, wrench=case.wrench + line * np.append(sim.direction(case.rng), np.zeros(3)))


def with_mass(case: Case) -> Case:
    return replace(case, known=Known(mass_kg=MASS_KG, mass_tolerance_kg=0.01))


def with_payload(case: Case) -> Case:
    return replace(case, payload_kg=MASS_KG * case.rng.uniform(0.9, 1.1))


def with_tool(case: Case, **different: object) -> Case:
    """Describe the tool: its centre of mass in the middle of a cylinder."""
    length_mm = HEIGHT_MM + 2e3 * float(case.truth.P @ case.truth.R[:, 2])
    tool = {"cylinders_mm": [[0.0, length_mm, 100.0]], "height_mm": HEIGHT_MM, "mounting": "floor"}
    return replace(case, setup=tool | different)


def with_tool_mass(case: Case) -> Case:
    return with_tool(case, cylinders_mm=(), tool_mass_kg=MASS_KG * case.rng.uniform(0.9, 1.1))


def with_mounting(case: Case) -> Case:
    return replace(case, known=Known(R_flange_sensor=case.truth.R.T))


def both(first: Callable[..., Case], second: Callable[..., Case], **arguments: object) -> Callable[[Case], Case]:
    return lambda case: second(first(case), **arguments)


SWAP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
CYCLE = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
MIRROR = np.diag([1.0, -1, 1])
MIRRORED = "one axis is reversed or two are swapped"
FAULTS: dict[str, tuple[Callable[[Case], Case], str]] = {
    "transposed": (transposed, "orientations look inverted"),
    "wxyz read as xyzw": (partial(quaternions, shift=1), r"quaternions look like \(w, x, y, z\)"),
    "xyzw read as wxyz": (partial(quaternions, shift=-1), r"quaternions look like \(x, y, z, w\)"),
    "rotation vectors in degrees": (in_degrees, "look like degrees"),
    "wrench of the previous pose": (partial(shifted, by=1), "each wrench looks like that of the pose before"),
    "wrench of the next pose": (partial(shifted, by=-1), "each wrench looks like that of the pose after"),
    "x, y swapped in force": (partial(axes, Q=SWAP, groups="F"), r"axes disagree.*from \(y, x, z\)"),
    "x, y swapped in torque": (partial(axes, Q=SWAP, groups="T"), r"axes disagree.*from \(y, x, z\)"),
    "x, y swapped in both": (partial(axes, Q=SWAP, groups="FT"), MIRRORED),
    "cyclic axes of force": (partial(axes, Q=CYCLE, groups="F"), r"axes disagree.*from \(z, x, y\)"),
    "cyclic axes of torque": (partial(axes, Q=CYCLE, groups="T"), r"axes disagree.*from \(z, x, y\)"),
    "cyclic in both, mounting known": (
        both(with_mounting, axes, Q=CYCLE, groups="FT"), r"mounting.*from \(z, x, y\)"),
    "x, y swapped in both, mounting known": (
        both(with_mounting, axes, Q=SWAP, groups="FT"), r"mounting.*from \(y, x, z\)"),
    "y reversed in both": (partial(axes, Q=MIRROR, groups="FT"), MIRRORED),
    "y reversed in force": (partial(axes, Q=MIRROR, groups="F"), "force y reversed"),
    "y reversed in torque": (partial(axes, Q=MIRROR, groups="T"), "torque y reversed"),
    "torques reversed": (partial(axes, Q=-np.eye(3), groups="T"), "torques are reversed"),
    "forces reversed": (partial(axes, Q=-np.eye(3), groups="F"), "forces are reversed"),
    "reaction": (partial(axes, Q=-np.eye(3), groups="FT"), "reaction"),
    "base axes": (in_base, "base axes"),
    "base axes, without bias": (partial(in_base, bias=False), "base axes"),
    "torque in N·mm": (partial(scaled, torque=1e-3), r"as with torques in N·mm"),
    "torque in lbf·in": (partial(scaled, torque=LBF_IN_NM), r"as with torques in lbf·in"),
    "lbf and lbf·in": (partial(scaled, force=LBF_N, torque=LBF_IN_NM), r"forces in lbf and torques in lbf·in"),
    "lbf, mass known": (both(with_mass, scaled, force=LBF_N), "forces in lbf"),
    "kgf, mass known": (both(with_mass, scaled, force=KGF_N), "forces in kgf"),
    "lbf and lbf·in, mass known": (both(with_mass, scaled, force=LBF_N, torque=LBF_IN_NM), "forces in lbf"),
    "lbf, payload known": (both(with_payload, scaled, force=LBF_N), "forces in lbf"),
    "kgf, payload known": (both(with_payload, scaled, force=KGF_N), "forces in kgf"),
    "kgf and kgf·m, payload known": (both(with_payload, scaled, force=KGF_N, torque=KGF_N), "forces in kgf"),
    "mN": (partial(scaled, force=1e-3), "forces in mN"),
    "kN": (partial(scaled, force=1e3), "forces in kN"),
    "mN and N·mm": (partial(scaled, force=1e-3, torque=1e-3), "forces in mN and torques in N·mm"),
    "kN and kN·m": (partial(scaled, force=1e3, torque=1e3), "forces in kN and torques in kN·m"),
    "mN and N·mm, mass known": (both(with_mass, scaled, force=1e-3, torque=1e-3), "forces in mN and torques in N·mm"),
    "mN and N·mm, payload known": (
        both(with_payload, scaled, force=1e-3, torque=1e-3), "forces in mN and torques in N·mm"),
    "lbf, tool described": (both(with_tool, scaled, force=LBF_N), "outside the tool.*forces in lbf"),
    "lbf and lbf·ft, tool described": (
        both(with_tool, scaled, force=LBF_N, torque=12 * LBF_IN_NM), "outside the tool.*lbf·ft"),
    "lbf and lbf·in, tool mass": (both(with_tool_mass, scaled, force=LBF_N, torque=LBF_IN_NM), "forces in lbf"),
    "lbf and lbf·ft, tool mass": (both(with_tool_mass, scaled, force=LBF_N, torque=12 * LBF_IN_NM), "forces in lbf"),
    "kgf and kgf·m, tool mass": (both(with_tool_mass, scaled, force=KGF_N, torque=KGF_N), "forces in kgf"),
    "torques reversed, tool described": (
        both(with_tool, axes, Q=-np.eye(3), groups="T"), "outside the tool|torques are reversed"),
    "orientations in left-handed axes": (partial(mirrored, S=MIRROR), "orientations are mirrored"),
    "x, y swapped in orientations": (partial(mirrored, S=SWAP), "orientations are mirrored"),
    "conjugate quaternions in another order": (
        both(with_tool, lambda case: quaternions(transposed(case))), r"\[workcell\] mounting|outside the tool"),
    "wrench of two poses before": (partial(elsewhere, rows=lambda n, _: np.roll(np.arange(n), 2)), "other poses"),
    "wrenches in reverse order": (partial(elsewhere, rows=lambda n, _: np.arange(n)[::-1]), "other poses"),
    "wrenches in any order": (partial(elsewhere, rows=lambda n, rng: rng.permutation(n)), "other poses"),
    "Euler angles read as rotation vectors": (as_euler_angles, "other poses, or the orientations"),
    "one channel constant": (stuck, "stuck"),
    "rows copied": (copied, "identical wrenches and orientations"),
    "wrench not updated once": (stale, "identical wrenches in different orientations"),
    "drift of 2 N": (drifted, r"drifted by (1\.[89]|2(\.[12])?) N"),
}  # fmt: skip


# Advice


UNITS = {"lbf": LBF_N, "kgf": KGF_N, "N·mm": 1e-3, "lbf·in": LBF_IN_NM, "lbf·ft": 12 * LBF_IN_NM, "kgf·m": KGF_N,
         "kgf·cm": KGF_N / 100, "mN": 1e-3, "kN": 1e3, "kN·m": 1e3}  # fmt: skip


def in_flange(case: Case) -> Case:
    """Wrench turned from base to flange axes, and what is true in these."""
    R, t = case.truth.R.T, case.truth
    truth = Truth(np.eye(3), t.b, R @ t.F0, R @ t.P, R @ t.T0)
    return replace(case, wrench=turned(case.wrench, np.swapaxes(case.R, 1, 2)), truth=truth)


def taken_from(text: str) -> Array:
    """Matrix that undoes the order in words: "y reversed", or "x, y, z taken from (y, x, z)"."""
    if text.endswith("reversed"):
        return np.diag([-1.0 if axis in text.removesuffix(" reversed").split(" and ") else 1.0 for axis in "xyz"])
    Q = np.zeros((3, 3))
    for row, channel in enumerate(text.rpartition("(")[2].rstrip(")").split(", ")):
        Q[row, "xyz".index(channel[-1])] = -1 if channel.startswith("-") else 1
    return Q


ORDER = r"((?:[xyz](?: and [xyz])* reversed)|(?:x, y, z taken from \([-xyz, ]+\)))"
UNIT = r"(?:forces in (lbf|kgf|mN|kN))?(?: and )?(?:torques in (\S+·\w+))?"


def followed(reason: str, case: Case, clean: Case) -> list[Case]:
    """Do what the reason says; several cases if it leaves a choice."""
    if "look inverted" in reason:
        return [transposed(case)]
    if found := re.search(r"look like \((.*)\) that were", reason):
        return [quaternions(case, -1 if found[1].startswith("w") else 1)]
    if found := re.search("that of the pose (before|after) it", reason):
        return [shifted(case, by=-1 if found[1] == "before" else 1)]
    if "base axes" in reason:
        return [in_flange(case)]
    if "look like degrees" in reason:
        return [replace(case, unit_rad=1.0)]
    if "axes disagree" in reason or "mounting of the sensor" in reason:
        return [
            axes(case, Q=taken_from(order), groups={"force": "F", "torque": "T", "wrench": "FT"}[group])
            for group, order in re.findall(f"(force|torque|wrench) {ORDER}", reason)
        ]
    if "other poses" in reason or "[workcell] mounting" in reason:
        return [clean]
    if "orientations are mirrored" in reason:
        return [axes(case, Q=-np.eye(3), groups="F"), *(mirrored(case, S) for S in (MIRROR, SWAP))]
    if "forces are reversed" in reason or "torques are reversed" in reason:
        return [axes(case, Q=-np.eye(3), groups="F" if "forces are" in reason else "T")]
    if "pulls upwards" in reason:
        signs = [np.diag(np.where(np.arange(3) == k, -1.0, 1.0)) for k in range(3)]
        swaps = [np.eye(3)[[1, 0, 2]], np.eye(3)[[2, 1, 0]], np.eye(3)[[0, 2, 1]]]
        return [axes(case, Q=Q, groups="FT") for Q in (-np.eye(3), *signs, *swaps)]
    units = [
        scaled(case, force=1 / UNITS.get(force, 1.0), torque=1 / UNITS.get(torque, 1.0))
        for force, torque in re.findall(UNIT, reason)
        if force or torque
    ]
    if units:
        return units
    if found := re.search(r"poses ([\d, ]+) have identical wrenches( and orientations)?", reason):
        rows = [int(row) - 1 for row in found[1].split(", ")]
        kept = np.delete(np.arange(len(case.R)), rows[1:] if found[2] else rows)
        return [replace(case, R=case.R[kept], wrench=case.wrench[kept])]
    if "stuck" in reason or "drifted by" in reason:
        return [clean]
    return []


def leads_to_the_truth(reason: str, case: Case, clean: Case, *, measured: bool) -> bool:
    """Follow the first reason, and that of the next solve, until nothing more is advised."""
    cases = followed(reason, case, clean)
    for _ in range(STEPS):
        following = []
        for one in cases:
            parameters, reasons, good = answer(one, measured=measured)
            if good and parameters is not None and close(one.truth, parameters):
                return True
            following += followed(reasons[0], one, clean) if reasons else []
        cases = following
    return False


def close(truth: Truth, estimate: Parameters) -> bool:
    x = sim.error(truth, estimate)
    force_N, torque_Nm = np.sqrt(sim.prediction_square(truth, estimate))
    return bool(
        np.linalg.norm(x[:3]) < ROTATION_RAD
        and force_N < WEIGHT_SHARE * sim.WEIGHT_N
        and torque_Nm < WEIGHT_SHARE * sim.WEIGHT_N * sim.ARM_M
    )


# Sessions


def session(rng: Rng, n: int, poses: str = "haar") -> Case:
    """Simulate a tool that hangs outside the flange, on a sensor mounted in any way."""
    truth = sim.tool(rng)
    outwards = truth.R[:, 2]
    truth = replace(truth, P=sim.ARM_M * outwards + 0.02 * sim.direction(rng))
    R = sim.poses(f"{poses}{n}", rng)
    return Case(truth, R, sim.readings(truth, R) + NOISE * rng.normal(size=(n, 6)), rng=rng)


def solved(case: Case, *, measured: bool) -> CalibrationResult:
    n = len(case.R)
    cov = np.tile(np.diag(case.sigma**2), (n, 1, 1)) if measured else None
    dataset = CalibrationDataset(case.R, case.wrench, cov, np.zeros(n, np.int64), np.arange(float(n)))
    if case.unit_rad != 1.0:
        dataset = from_file(case)
    result = solve(dataset, known=case.known, payload_kg=case.payload_kg, up_in_base=case.up)
    return judged(replace(result, provenance={"setup": case.setup}))


def from_file(case: Case) -> CalibrationDataset:
    vectors = Rotation.from_matrix(case.R).as_rotvec() / case.unit_rad
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "poses.csv"
        table = np.concatenate([vectors, case.wrench], axis=1)
        np.savetxt(path, table, delimiter=",", header="rx,ry,rz,fx,fy,fz,tx,ty,tz", comments="")
        return read_csv(path)


def answer(case: Case, *, measured: bool) -> tuple[Parameters | None, tuple[str, ...], bool]:
    """Parameters, reasons, and whether the verdict is good."""
    try:
        result = solved(case, measured=measured)
    except (NotObservable, BadDataset) as exc:
        return None, (str(exc),), False
    return result.parameters, result.reasons, result.verdict == "good"


def faulty(job: tuple[str, int, bool, int, str]) -> tuple[bool, bool, bool, str]:
    """Whether the fault was named first, the verdict good, and the advice right; and the first reason."""
    name, n, measured, seed, poses = job
    spoil, says = FAULTS[name]
    rng = np.random.default_rng([seed, n])
    clean = session(rng, n, poses)
    case = spoil(clean)
    _, reasons, good = answer(case, measured=measured)
    reason = reasons[0] if reasons else "nothing"
    named = bool(re.search(says, reason))
    return named, good, leads_to_the_truth(reason, case, clean, measured=measured), reason


def sound(seed: int) -> str | None:
    """Name the false cause, if any: any mounting of sensor and base, tilt, distance of the load, gain, drift."""
    rng = np.random.default_rng([seed, 1])
    tilt, n = int(rng.uniform(25, 90)), int(rng.choice([8, 12, 24]))
    truth, base = session(rng, n).truth, Rotation.random(rng=rng)
    truth = replace(truth, b=base.apply(truth.b), P=truth.P * rng.uniform(0.4, 2.0))
    R = base.as_matrix() @ sim.poses(f"cone{tilt}_{n}", rng)
    wrench = sim.readings(truth, R) + NOISE * rng.normal(size=(n, 6))
    wrench[:, :3] += (wrench[:, :3] - truth.F0) @ (rng.uniform(0, 0.01) * rng.normal(size=(3, 3))).T
    path, _ = sim.walk(n, rng.uniform(0, 0.1) / np.sqrt(n), rng)
    payload_kg = MASS_KG * rng.uniform(0.8, 1.2) + rng.uniform(0, 0.3)
    case = Case(truth, R, wrench + path, payload_kg=payload_kg, up=base.apply([0.0, 0.0, 1.0]))
    height_mm = None if rng.integers(2) else HEIGHT_MM
    tool_mass_kg, sensor_mass_kg = MASS_KG * rng.uniform(0.8, 1.2), None
    cell = {"tool_mass_kg": tool_mass_kg, "payload_kg": payload_kg, "sensor_mass_kg": sensor_mass_kg}
    case = with_tool(case, mounting=None, height_mm=height_mm, **cell)
    _, reasons, _ = answer(case, measured=bool(rng.integers(2)))
    return next((name for name in ALL_NAMES if name in " | ".join(reasons)), None)


def main() -> int:
    parser = argparse.ArgumentParser(description="Faults and their names.")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--sound", type=int, default=1000)
    parser.add_argument("--only", default="", help="faults whose name this finds, a regular expression")
    parser.add_argument("--poses", default="haar", help="haar, or cone60_: the tool within 60° of down")
    options = parser.parse_args()
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
    failed = 0
    write = partial(print, flush=True)
    with get_context("spawn").Pool(2) as pool:
        for name in (name for name in FAULTS if re.search(options.only, name)):
            for n in (24, 12):
                for measured in (True, False):
                    jobs = [(name, n, measured, seed, options.poses) for seed in range(options.runs)]
                    found = pool.map(faulty, jobs, chunksize=max(1, min(10, options.runs // 2)))
                    named, good, truth = np.sum([one[:3] for one in found], axis=0).tolist()
                    passed = min(named, truth) >= 0.95 * options.runs and not good
                    failed += not passed
                    noise = "measured" if measured else "unknown"
                    seen = Counter(one[3][:90] for one in found if not (one[0] and one[2]) or one[1])
                    write(f"{name:37}{n:3} poses, noise {noise:8}  named first {named:4}  good {good:3}"
                          f"  truth {truth:4}  {'pass' if passed else 'FAIL'}"
                          + (f"  {seen.most_common(2)}" if seen else ""))  # fmt: skip
        if options.sound:
            causes = pool.map(sound, range(options.sound), chunksize=10)
            wrong = Counter(cause for cause in causes if cause)
            passed = sum(wrong.values()) <= 0.01 * options.sound
            failed += not passed
            write(
                f"sound sessions with a false cause: {dict(wrong)} of {options.sound}  {'pass' if passed else 'FAIL'}"
            )
    return failed


if __name__ == "__main__":
    sys.exit(main())
