"""Faults in poses and wrenches: is the cause named first, does its advice lead to the truth, are sound sessions quiet?

    uv run python -m tests.benchmarks.faults [--runs 100] [--sound 1000] [--only WORD] [--poses haar]

Prints for each fault, with 24 and 12 poses, with and without measured noise: how often its name came first, how often
the verdict was good, and how often the first finding, followed by its values, led to the truth.
"""

import argparse
import json
import os
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import (
    CalibrationDataset,
    CalibrationResult,
    Finding,
    NotObservable,
    Parameters,
    Setup,
    read_csv,
    solve,
)
from ftcalib.errors import BadDataset
from ftcalib.known import Known
from ftcalib.model import STANDARD_GRAVITY_M_S2, Array
from tests.benchmarks import scenarios as sim
from tests.benchmarks.scenarios import Rng, Truth

NOISE = sim.sigma(400)
MASS_KG = sim.WEIGHT_N / STANDARD_GRAVITY_M_S2
STEPS = 3
"""Faults that may be named one after the other, such as two units."""
ROTATION_RAD, WEIGHT_SHARE = np.deg2rad(1.0), 0.01
"""An answer this close is the truth: mounting, and the wrench over all orientations, torque at the centre of mass."""
LBF_N, KGF_N, LBF_IN_NM = 4.4482216, 9.80665, 0.11298483
HEIGHT_M = 0.04
NO_MISTAKE = {"noise_unknown", "noise_exceeded", "drift", "residuals_alike", "pose_deviates", "poses_rejected",
              "poses_unchecked", "gain_x", "gain_y", "gain_z", "axes_mixed", "cross_talk", "response_small",
              "force_error", "torque_error", "second_solution", "base_leans"}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A session as its user hands it in."""

    truth: Truth
    R: Array
    wrench: Array
    sigma: Array = field(default_factory=lambda: NOISE)
    known: Known | None = None
    unit_rad: float = 1.0
    """Of the rotation vectors in the file."""
    setup: dict[str, Any] = field(default_factory=dict)
    """The described cell, as `ftcalib.Setup` takes it."""
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
    return replace(case, setup={"payload_kg": MASS_KG * case.rng.uniform(0.9, 1.1)})


def with_tool(case: Case, **different: object) -> Case:
    """Describe the tool: its centre of mass in the middle of a cylinder."""
    length_m = HEIGHT_M + 2 * float(case.truth.P @ case.truth.R[:, 2])
    tool = {"cylinders_m": [(0.0, length_m, 0.1)], "sensor_height_m": HEIGHT_M, "up_in_base": (0, 0, 1)}
    return replace(case, setup=tool | different)


def with_tool_mass(case: Case) -> Case:
    return with_tool(case, cylinders_m=(), tool_mass_kg=MASS_KG * case.rng.uniform(0.9, 1.1))


def with_mounting(case: Case) -> Case:
    return replace(case, known=Known(R_flange_sensor=case.truth.R.T))


def both(first: Callable[..., Case], second: Callable[..., Case], **arguments: object) -> Callable[[Case], Case]:
    return lambda case: second(first(case), **arguments)


SWAP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
CYCLE = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
MIRROR = np.diag([1.0, -1, 1])
YXZ, ZXY = r'\["y", "x", "z"\]', r'\["z", "x", "y"\]'
# Each with a pattern for code and values of the first finding.
FAULTS: dict[str, tuple[Callable[[Case], Case], str]] = {
    "transposed": (transposed, "orientations_inverted"),
    "wxyz read as xyzw": (partial(quaternions, shift=1), 'quaternion_order.*"order": "w, x, y, z"'),
    "xyzw read as wxyz": (partial(quaternions, shift=-1), 'quaternion_order.*"order": "x, y, z, w"'),
    "rotation vectors in degrees": (in_degrees, "look like degrees"),
    "wrench of the previous pose": (partial(shifted, by=1), "pairing_shifted.*before"),
    "wrench of the next pose": (partial(shifted, by=-1), "pairing_shifted.*after"),
    "x, y swapped in force": (partial(axes, Q=SWAP, groups="F"), f"axes_disagree.*{YXZ}"),
    "x, y swapped in torque": (partial(axes, Q=SWAP, groups="T"), f"axes_disagree.*{YXZ}"),
    "x, y swapped in both": (partial(axes, Q=SWAP, groups="FT"), "weight_upwards"),
    "cyclic axes of force": (partial(axes, Q=CYCLE, groups="F"), f"axes_disagree.*{ZXY}"),
    "cyclic axes of torque": (partial(axes, Q=CYCLE, groups="T"), f"axes_disagree.*{ZXY}"),
    "cyclic in both, mounting known": (
        both(with_mounting, axes, Q=CYCLE, groups="FT"), f"known_mounting.*{ZXY}"),
    "x, y swapped in both, mounting known": (
        both(with_mounting, axes, Q=SWAP, groups="FT"), f"known_mounting.*{YXZ}"),
    "y reversed in both": (partial(axes, Q=MIRROR, groups="FT"), "weight_upwards"),
    "y reversed in force": (partial(axes, Q=MIRROR, groups="F"), '"force", \\["x", "-y", "z"\\]'),
    "y reversed in torque": (partial(axes, Q=MIRROR, groups="T"), '"torque", \\["x", "-y", "z"\\]'),
    "torques reversed": (partial(axes, Q=-np.eye(3), groups="T"), "torques_reversed"),
    "forces reversed": (partial(axes, Q=-np.eye(3), groups="F"), "forces_reversed"),
    "reaction": (partial(axes, Q=-np.eye(3), groups="FT"), "weight_upwards"),
    "base axes": (in_base, "wrench_in_base"),
    "base axes, without bias": (partial(in_base, bias=False), "wrench_in_base|constant_force"),
    "torque in N·mm": (partial(scaled, torque=1e-3), '"N", "N·mm"'),
    "torque in lbf·in": (partial(scaled, torque=LBF_IN_NM), '"N", "lbf·in"'),
    "lbf and lbf·in": (partial(scaled, force=LBF_N, torque=LBF_IN_NM), '"lbf", "lbf·in"'),
    "lbf, mass known": (both(with_mass, scaled, force=LBF_N), 'units.*"lbf"'),
    "kgf, mass known": (both(with_mass, scaled, force=KGF_N), 'units.*"kgf"'),
    "lbf and lbf·in, mass known": (both(with_mass, scaled, force=LBF_N, torque=LBF_IN_NM), 'units.*"lbf"'),
    "lbf, payload known": (both(with_payload, scaled, force=LBF_N), 'units.*"lbf"'),
    "kgf, payload known": (both(with_payload, scaled, force=KGF_N), 'units.*"kgf"'),
    "kgf and kgf·m, payload known": (both(with_payload, scaled, force=KGF_N, torque=KGF_N), 'units.*"kgf"'),
    "mN": (partial(scaled, force=1e-3), 'units.*"mN"'),
    "kN": (partial(scaled, force=1e3), 'units.*"kN"'),
    "mN and N·mm": (partial(scaled, force=1e-3, torque=1e-3), '"mN", "N·mm"'),
    "kN and kN·m": (partial(scaled, force=1e3, torque=1e3), '"kN", "kN·m"'),
    "mN and N·mm, mass known": (both(with_mass, scaled, force=1e-3, torque=1e-3), '"mN", "N·mm"'),
    "mN and N·mm, payload known": (
        both(with_payload, scaled, force=1e-3, torque=1e-3), '"mN", "N·mm"'),
    "lbf, tool described": (both(with_tool, scaled, force=LBF_N), 'com_outside_tool.*"lbf"'),
    "lbf and lbf·ft, tool described": (
        both(with_tool, scaled, force=LBF_N, torque=12 * LBF_IN_NM), "com_outside_tool.*lbf·ft"),
    "lbf and lbf·in, tool mass": (both(with_tool_mass, scaled, force=LBF_N, torque=LBF_IN_NM), 'units.*"lbf"'),
    "lbf and lbf·ft, tool mass": (both(with_tool_mass, scaled, force=LBF_N, torque=12 * LBF_IN_NM), 'units.*"lbf"'),
    "kgf and kgf·m, tool mass": (both(with_tool_mass, scaled, force=KGF_N, torque=KGF_N), 'units.*"kgf"'),
    "torques reversed, tool described": (
        both(with_tool, axes, Q=-np.eye(3), groups="T"), "com_outside_tool|torques_reversed"),
    "orientations in left-handed axes": (partial(mirrored, S=MIRROR), "forces_reversed"),
    "x, y swapped in orientations": (partial(mirrored, S=SWAP), "forces_reversed"),
    "conjugate quaternions in another order": (
        lambda case: quaternions(transposed(case)), "mounting_undeclared|weight_upwards|gravity_tilted"),
    "conjugate quaternions in another order, tool described": (
        both(with_tool, lambda case: quaternions(transposed(case))), "gravity_off_mounting|com_outside_tool"),
    "wrench of two poses before": (
        partial(elsewhere, rows=lambda n, _: np.roll(np.arange(n), 2)), "pairing_or_rotations"),
    "wrenches in reverse order": (partial(elsewhere, rows=lambda n, _: np.arange(n)[::-1]), "pairing_or_rotations"),
    "wrenches in any order": (partial(elsewhere, rows=lambda n, rng: rng.permutation(n)), "pairing_or_rotations"),
    "Euler angles read as rotation vectors": (as_euler_angles, "pairing_or_rotations"),
    "one channel constant": (stuck, "stuck_channels"),
    "rows copied": (copied, "repeated_poses"),
    "wrench not updated once": (stale, "repeated_wrenches"),
    "drift of 2 N": (drifted, 'drift.*"force_N": (1\\.[89]|2\\.[012])'),
}  # fmt: skip


# Advice


UNITS = {"lbf": LBF_N, "kgf": KGF_N, "N·mm": 1e-3, "lbf·in": LBF_IN_NM, "lbf·ft": 12 * LBF_IN_NM, "kgf·m": KGF_N,
         "kgf·cm": KGF_N / 100, "mN": 1e-3, "kN": 1e3, "kN·m": 1e3}  # fmt: skip


def in_flange(case: Case) -> Case:
    """Wrench turned from base to flange axes, and what is true in these."""
    R, t = case.truth.R.T, case.truth
    truth = Truth(np.eye(3), t.b, R @ t.F0, R @ t.P, R @ t.T0)
    return replace(case, wrench=turned(case.wrench, np.swapaxes(case.R, 1, 2)), truth=truth)


def taken_from(channels: list[str]) -> Array:
    """Matrix that undoes an order of channels, such as ["y", "-x", "z"]."""
    Q = np.zeros((3, 3))
    for row, channel in enumerate(channels):
        Q[row, "xyz".index(channel[-1])] = -1 if channel.startswith("-") else 1
    return Q


def followed(finding: Finding | str, case: Case, clean: Case) -> list[Case]:
    """Do what the finding says; several cases if it leaves a choice."""
    if isinstance(finding, str):
        return [replace(case, unit_rad=1.0)] if "look like degrees" in finding else []
    code, values = finding.code, finding.values
    signs = [np.diag(np.where(np.arange(3) == k, -1.0, 1.0)) for k in range(3)]
    swaps = [np.eye(3)[[1, 0, 2]], np.eye(3)[[2, 1, 0]], np.eye(3)[[0, 2, 1]]]
    if code == "orientations_inverted":
        return [transposed(case)]
    if code == "quaternion_order":
        return [quaternions(case, -1 if values["order"].startswith("w") else 1)]
    if code == "pairing_shifted":
        return [shifted(case, by=-1 if values["neighbour"] == "before" else 1)]
    if code in {"wrench_in_base", "constant_force"}:
        return [in_flange(case)]
    if code in {"axes_disagree", "known_mounting"}:
        groups = {"force": "F", "torque": "T", "wrench": "FT"}
        return [axes(case, Q=taken_from(order), groups=groups[group]) for group, order in values["corrections"]]
    if code == "forces_reversed":
        return [axes(case, Q=-np.eye(3), groups="F"), *(mirrored(case, S) for S in (MIRROR, SWAP))]
    if code == "torques_reversed":
        return [axes(case, Q=-np.eye(3), groups="T")]
    if code == "weight_upwards":
        return [clean, *(axes(case, Q=Q, groups="FT") for Q in (-np.eye(3), *signs, *swaps))]
    if code in {"repeated_poses", "repeated_wrenches"}:
        rows = [row - 1 for row in values["poses"]]
        kept = np.delete(np.arange(len(case.R)), rows[1:] if code == "repeated_poses" else rows)
        return [replace(case, R=case.R[kept], wrench=case.wrench[kept])]
    if "units" in values:
        return [
            scaled(case, force=1 / UNITS.get(force, 1.0), torque=1 / UNITS.get(torque, 1.0))
            for force, torque in values["units"]
        ]
    look_again = {"pairing_or_rotations", "gravity_off_mounting", "mounting_undeclared", "stuck_channels", "drift"}
    return [clean] if code in look_again else []


def leads_to_the_truth(finding: Finding | str, case: Case, clean: Case, *, measured: bool) -> bool:
    """Follow the first finding, and that of the next solve, until nothing more is advised."""
    cases = followed(finding, case, clean)
    for _ in range(STEPS):
        following = []
        for one in cases:
            parameters, findings, good = answer(one, measured=measured)
            if good and parameters is not None and close(one.truth, parameters):
                return True
            following += followed(findings[0], one, clean) if findings else []
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
    return solve(dataset, known=case.known, setup=Setup(**case.setup))


def from_file(case: Case) -> CalibrationDataset:
    vectors = Rotation.from_matrix(case.R).as_rotvec() / case.unit_rad
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "poses.csv"
        table = np.concatenate([vectors, case.wrench], axis=1)
        np.savetxt(path, table, delimiter=",", header="rx,ry,rz,fx,fy,fz,tx,ty,tz", comments="")
        return read_csv(path)


def answer(case: Case, *, measured: bool) -> tuple[Parameters | None, Sequence[Finding | str], bool]:
    """Parameters, findings or an error, and whether the verdict is good."""
    try:
        result = solved(case, measured=measured)
    except NotObservable as exc:
        return None, (exc.finding or str(exc),), False
    except BadDataset as exc:
        return None, (str(exc),), False
    return result.parameters, result.findings, result.verdict == "good"


def as_text(finding: Finding | str) -> str:
    if isinstance(finding, str):
        return finding
    return f"{finding.code} {json.dumps(dict(finding.values), ensure_ascii=False)}"


def faulty(job: tuple[str, int, bool, int, str]) -> tuple[bool, bool, bool, str]:
    """Whether the fault was named first, the verdict good, and the advice right; and the first finding."""
    name, n, measured, seed, poses = job
    spoil, says = FAULTS[name]
    rng = np.random.default_rng([seed, n])
    clean = session(rng, n, poses)
    case = spoil(clean)
    _, findings, good = answer(case, measured=measured)
    first = findings[0] if findings else "nothing"
    named = bool(re.search(says, as_text(first)))
    return named, good, leads_to_the_truth(first, case, clean, measured=measured), as_text(first)


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
    height_m = None if rng.integers(2) else HEIGHT_M
    up = base.apply([0.0, 0.0, 1.0]).tolist()
    cell = {"tool_mass_kg": MASS_KG * rng.uniform(0.8, 1.2), "payload_kg": payload_kg, "up_in_base": up}
    case = with_tool(Case(truth, R, wrench + path), sensor_height_m=height_m, **cell)
    _, findings, _ = answer(case, measured=bool(rng.integers(2)))
    return next((one if isinstance(one, str) else one.code for one in findings if as_code(one) not in NO_MISTAKE), None)


def as_code(finding: Finding | str) -> str:
    return finding if isinstance(finding, str) else finding.code


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
