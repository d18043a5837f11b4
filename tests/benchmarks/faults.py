"""Faults in poses and wrenches: is the cause named first, and is nothing said of sound sessions?

    uv run python tests/benchmarks/faults.py [--runs 100] [--sound 1000]

Prints for each fault, with 24 and 12 poses, with and without measured noise: how often its name comes first, and how
often the verdict was good.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from calib import CalibrationDataset, CalibrationResult, NotObservable, solve
from calib.model import Array
from tests.benchmarks import scenarios as sim
from tests.benchmarks.scenarios import Rng, Truth

NOISE = sim.sigma(400)
Data = tuple[Array, Array]
ALL_NAMES = ("inverted", "quaternion", "base axes", "each wrench", "axes disagree", "reversed", "reaction", "in N·mm",
             "lbf", "kgf", "stuck", "identical")  # fmt: skip


def quaternions(R: Array, wrench: Array, shift: int) -> Data:
    return Rotation.from_quat(np.roll(Rotation.from_matrix(R).as_quat(), shift, axis=1)).as_matrix(), wrench


def shifted(R: Array, wrench: Array, by: int) -> Data:
    return (R[1:], wrench[:-1]) if by > 0 else (R[:-1], wrench[1:])


def axes(R: Array, wrench: Array, Q: Array, groups: str) -> Data:
    wrench = wrench.copy()
    for k, group in enumerate("FT"):
        if group in groups:
            wrench[:, 3 * k : 3 * k + 3] = wrench[:, 3 * k : 3 * k + 3] @ Q.T
    return R, wrench


def in_base(R: Array, wrench: Array, mount: Array) -> Data:
    turned = R @ mount.T
    return R, np.concatenate([np.einsum("nij,nj->ni", turned, part) for part in (wrench[:, :3], wrench[:, 3:])], axis=1)


def scaled(R: Array, wrench: Array, force: float, torque: float) -> Data:
    return R, wrench * np.repeat([force, torque], 3)


def stuck(R: Array, wrench: Array) -> Data:
    wrench = wrench.copy()
    wrench[:, 1] = wrench[0, 1]
    return R, wrench


def copied(R: Array, wrench: Array) -> Data:
    rows = np.append(np.arange(len(R)), [3, 5])
    return R[rows], wrench[rows]


def drifted(R: Array, wrench: Array) -> Data:
    line = np.linspace(-1, 1, len(R))[:, None]
    return R, wrench + line * [0, 0, 1.0, 0, 0, 0]


SWAP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
CYCLE = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
MIRROR = np.diag([1.0, -1, 1])
FAULTS: dict[str, tuple[Callable[..., Data], dict[str, object], str]] = {
    "transposed": (lambda R, y: (np.swapaxes(R, 1, 2), y), {}, "orientations look inverted"),
    "wxyz read as xyzw": (quaternions, {"shift": 1}, "quaternions"),
    "xyzw read as wxyz": (quaternions, {"shift": -1}, "quaternions"),
    "wrench of the previous pose": (shifted, {"by": 1}, "each wrench looks like that of the pose before"),
    "wrench of the next pose": (shifted, {"by": -1}, "each wrench looks like that of the pose after"),
    "x, y swapped in force": (axes, {"Q": SWAP, "groups": "F"}, "axes disagree"),
    "x, y swapped in torque": (axes, {"Q": SWAP, "groups": "T"}, "axes disagree"),
    "x, y swapped in both": (axes, {"Q": SWAP, "groups": "FT"}, "one axis is reversed"),
    "cyclic axes of force": (axes, {"Q": CYCLE, "groups": "F"}, "axes disagree"),
    "cyclic axes of torque": (axes, {"Q": CYCLE, "groups": "T"}, "axes disagree"),
    "y reversed in both": (axes, {"Q": MIRROR, "groups": "FT"}, "one axis is reversed"),
    "y reversed in force": (axes, {"Q": MIRROR, "groups": "F"}, "force y reversed"),
    "y reversed in torque": (axes, {"Q": MIRROR, "groups": "T"}, "torque y reversed"),
    "torques reversed": (axes, {"Q": -np.eye(3), "groups": "T"}, "torques are reversed"),
    "forces reversed": (axes, {"Q": -np.eye(3), "groups": "F"}, "forces are reversed"),
    "reaction": (axes, {"Q": -np.eye(3), "groups": "FT"}, "reaction"),
    "base axes": (in_base, {}, "base axes"),
    "torque in N·mm": (scaled, {"force": 1.0, "torque": 1e3}, "N·mm"),
    "torque in lbf·in": (scaled, {"force": 1.0, "torque": 1 / 0.11298483}, "lbf·in"),
    "one channel constant": (stuck, {}, "stuck"),
    "rows copied": (copied, {}, "identical"),
    "drift of 2 N": (drifted, {}, "drifted by"),
}


def session(rng: Rng, n: int) -> tuple[Truth, Array, Array]:
    """Simulate a tool that hangs outside the flange, on a sensor mounted in any way."""
    truth = sim.tool(rng)
    outwards = truth.R[:, 2]
    P = 0.08 * outwards + 0.02 * sim.direction(rng)
    truth = Truth(truth.R, truth.b, truth.F0, P, truth.T0)
    R = sim.poses(f"haar{n}", rng)
    return truth, R, sim.readings(truth, R) + NOISE * rng.normal(size=(n, 6))


def solved(R: Array, wrench: Array, *, measured: bool) -> CalibrationResult:
    n = len(R)
    cov = np.tile(np.diag(NOISE**2), (n, 1, 1)) if measured else None
    return solve(CalibrationDataset(R, wrench, cov, np.zeros(n, np.int64), np.arange(float(n))))


def sound(seed: int) -> str | None:
    """Give the cause that is named wrongly, if any: any mounting, tilt, gain to 1 %, drift to 0.1 N."""
    rng = np.random.default_rng([seed, 1])
    truth, _, _ = session(rng, 24)
    tilt, n = int(rng.uniform(25, 90)), int(rng.choice([8, 12, 24]))
    R = sim.poses(f"cone{tilt}_{n}", rng)
    u = sim.readings(truth, R)[:, :3] - truth.F0
    wrench = sim.readings(truth, R) + NOISE * rng.normal(size=(n, 6))
    wrench[:, :3] += u @ (rng.uniform(0, 0.01) * rng.normal(size=(3, 3))).T
    path, _ = sim.walk(n, rng.uniform(0, 0.1) / np.sqrt(n), rng)
    try:
        reasons = " | ".join(solved(R, wrench + path, measured=bool(rng.integers(2))).reasons)
    except NotObservable:
        return None
    return next((name for name in ALL_NAMES if name in reasons), None)


def main() -> int:
    parser = argparse.ArgumentParser(description="Faults and their names.")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--sound", type=int, default=1000)
    parser.add_argument("--only", default="", help="faults whose name contains this")
    options = parser.parse_args()
    failed = 0
    write = partial(print, flush=True)
    for name, (spoil, arguments, says) in FAULTS.items():
        if options.only not in name:
            continue
        for n in (24, 12):
            for measured in (True, False):
                first, good, others = 0, 0, Counter[str]()
                for seed in range(options.runs):
                    rng = np.random.default_rng([seed, n])
                    truth, R, wrench = session(rng, n)
                    extra = {"mount": truth.R} if spoil is in_base else {}
                    try:
                        result = solved(*spoil(R, wrench, **arguments, **extra), measured=measured)
                    except NotObservable as exc:
                        first += says in str(exc)
                        if says not in str(exc):
                            others[str(exc)[:60]] += 1
                        continue
                    named = says in result.reasons[0] if result.reasons else False
                    first += named
                    good += result.verdict == "good"
                    if not named:
                        others[result.reasons[0][:60] if result.reasons else "nothing"] += 1
                passed = first >= 0.95 * options.runs and not good
                failed += not passed
                noise = "measured" if measured else "unknown"
                seen = "" if passed else f"  {others.most_common(2)}"
                write(f"{name:28} {n:3} poses, noise {noise:8}  named first {first:4}  good {good:3}"
                      f"  {'pass' if passed else 'FAIL'}{seen}")  # fmt: skip
    if options.sound:
        wrong = Counter(cause for seed in range(options.sound) if (cause := sound(seed)))
        passed = sum(wrong.values()) <= 0.01 * options.sound
        failed += not passed
        write(f"sound sessions with a false cause: {dict(wrong)} of {options.sound}  {'pass' if passed else 'FAIL'}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
