"""Starts that `rotation_minima.minima` needs, tightness of its certificate, and the duration of both.

Run `OPENBLAS_NUM_THREADS=1 python tests/benchmarks/so3_study.py [problems]`; the 16000 of the default take 15 minutes.
"""

import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from functools import partial
from itertools import permutations, product

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from ftcalib.likelihood import rotation_minima
from ftcalib.model import Array

SETS = ("srom24", "haar24", "haar12", "haar6", "cone60", "cone40", "cone20", "ball60", "ball40", "ball20")
TIES = ("3 poses", "4 half turns", "rim of a cone", "diagonal Q", "yaw only", "nearly yaw only", "ball0.5")
GENERIC = ("Wishart", "low rank", "spectrum 1e-4..1", "indefinite", "integers")
SNRS = (3, 5, 10, 30, 100, np.inf)
STARTS = (12, 24, 48, 60, 120, 240)
RANDOM_STARTS = 300


def orientations(name: str, rng: np.random.Generator) -> Array:
    """R_base_flange of a pose set: 24 poses if the name has no number; cones and balls are about straight down."""
    if name == "srom24":
        signed = [np.diag(s)[list(p)] for p in permutations(range(3)) for s in product((1.0, -1.0), repeat=3)]
        return np.array([R for R in signed if np.linalg.det(R) > 0])
    if name.startswith("haar"):
        return Rotation.random(int(name[4:]), rng=rng).as_matrix()
    angle, down = np.deg2rad(float(name[4:])), Rotation.from_rotvec([np.pi, 0, 0])
    if name.startswith("ball"):
        axis = rng.normal(size=(24, 3))
        axis *= angle * np.cbrt(rng.uniform(size=(24, 1))) / np.linalg.norm(axis, axis=1, keepdims=True)
        return (down * Rotation.from_rotvec(axis)).as_matrix()
    tilt, azimuth, spin = np.arccos(rng.uniform(np.cos(angle), 1, 24)), *rng.uniform(0, 2 * np.pi, (2, 24))
    lean = Rotation.from_rotvec(np.stack((tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0 * tilt), axis=1))
    return (lean * down * Rotation.from_rotvec(np.stack((0 * spin, 0 * spin, spin), axis=1))).as_matrix()


def calibration(R_base_flange: Array, snr: float, rng: np.random.Generator) -> Array:
    """Q of simulated forces: random mount and bias, base level within a few degrees, weight 1 N."""
    gravity = np.array([*np.deg2rad(2) * rng.normal(size=2), -1])
    force = R_base_flange.swapaxes(1, 2) @ gravity @ Rotation.random(rng=rng).as_matrix() + rng.normal(size=3)
    return rotation_minima.force_cost(R_base_flange, force + rng.normal(size=force.shape) / snr, np.ones(len(force)))


def tie(name: str, rng: np.random.Generator) -> Array:
    """Q with several minima of equal or nearly equal cost, or a curve of them."""
    if name == "diagonal Q":
        return np.diag(rng.uniform(size=9))
    if name == "3 poses":
        return calibration(orientations("haar3", rng), np.inf, rng)
    if name == "ball0.5":
        R = orientations(name, rng)
    elif name == "4 half turns":
        turns = [Rotation.identity(), *(Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3))]
        R = (Rotation.random(rng=rng) * Rotation.concatenate(turns)).as_matrix()
    else:
        turn = Rotation.from_rotvec(np.outer(rng.uniform(0, 2 * np.pi, 8), [0, 0, 1]))
        tilt = Rotation.from_rotvec([np.deg2rad(140), 0, 0])
        jitter = Rotation.from_rotvec((name == "nearly yaw only") * 10 ** rng.uniform(-6, -2) * rng.normal(size=(8, 3)))
        R = (turn * tilt * turn.inv() if name == "rim of a cone" else tilt * turn * jitter).as_matrix()
    return calibration(R, rng.choice(SNRS), rng)


def generic(name: str, rng: np.random.Generator) -> Array:
    """Generic Q, unlike those of a calibration."""
    G = rng.normal(size=(9, 9))
    if name == "low rank":
        G = G[:, : rng.integers(1, 9)]
    elif name == "spectrum 1e-4..1":
        G = np.linalg.qr(G)[0] * 10 ** rng.uniform(-2, 0, 9)
    elif name == "indefinite":
        G = G + G.T
        return np.asarray(G - np.linalg.eigvalsh(G)[0] * np.eye(9))
    elif name == "integers":
        G = rng.integers(-3, 4, (9, 9)).astype(float)
    return np.asarray(G @ G.T)


def problems(n: int) -> list[tuple[str, Array]]:
    """Half calibrations, an eighth ties, the rest generic."""
    rng = np.random.default_rng(2024)
    found: list[tuple[str, Array]] = []
    for i in range(n):
        if i % 2 == 0:
            name = SETS[i // 2 % len(SETS)]
            found.append((name, calibration(orientations(name, rng), SNRS[i // 20 % len(SNRS)], rng)))
        elif i % 8 == 1:
            name = TIES[i // 8 % len(TIES)]
            found.append((name, tie(name, rng)))
        else:
            name = GENERIC[i // 2 % len(GENERIC)]
            found.append((name, generic(name, rng)))
    return found


def starts_needed(cases: list[tuple[str, Array]]) -> Table:
    """Compare fixed starts with the union of all minima from them and from random starts."""
    rng = np.random.default_rng(1)
    missed_best: dict[tuple[str, int], int] = defaultdict(int)
    missed_any: dict[tuple[str, int], int] = defaultdict(int)
    number: dict[str, int] = defaultdict(int)
    most: dict[str, int] = defaultdict(int)
    for name, Q in cases:
        quartic, _ = rotation_minima._quartic(Q)
        random = rng.normal(size=(RANDOM_STARTS, 4))
        runs = {n: rotation_minima._descend(quartic, rotation_minima._super_fibonacci(n)) for n in STARTS}
        runs[0] = rotation_minima._descend(quartic, random / np.linalg.norm(random, axis=1, keepdims=True))
        q, cost, curvature = (np.concatenate(x) for x in zip(*runs.values(), strict=True))
        best = cost.min()
        isolated: list[int] = []
        for i in np.argsort(cost):
            if curvature[i] > 1e-4 and np.abs(q[isolated] @ q[i]).max(initial=0) < 1 - 1e-6:
                isolated.append(int(i))
        number[name] += 1
        most[name] = max(most[name], len(isolated))
        for n, (q_n, cost_n, _) in runs.items():
            missed_best[name, n] += cost_n.min() > best + 1e-9
            missed_any[name, n] += (np.abs(q[isolated] @ q_n.T).max(axis=1, initial=0) < 1 - 1e-6).any()
    table = Table("problems", "n", "minima", *(str(n) for n in STARTS), f"random {RANDOM_STARTS}")
    for name in (*SETS, *TIES, *GENERIC):
        cells = (f"{missed_best[name, n]} / {missed_any[name, n]}" for n in (*STARTS, 0))
        table.add_row(name, str(number[name]), f"<= {most[name]}", *cells)
    totals = (
        f"{sum(missed_best[m, n] for m in number)} / {sum(missed_any[m, n] for m in number)}" for n in (*STARTS, 0)
    )
    table.add_row("all", str(len(cases)), "", *totals)
    table.title = "problems in which the global / any isolated minimum was missed, by number of starts"
    return table


def certificates(cases: list[tuple[str, Array]]) -> Table:
    """Gap at the best minimum, and at the others over their excess cost."""
    at_best: dict[str, list[float]] = defaultdict(list)
    at_other: dict[str, list[float]] = defaultdict(list)
    for name, Q in cases:
        best, *others = rotation_minima.minima(Q)
        at_best[name].append(rotation_minima.certificate(Q, best.R))
        for other in others[-1:]:
            excess = (other.cost - best.cost) / (np.trace(Q) / 3)
            if excess > 1e-6:
                at_other[name].append(rotation_minima.certificate(Q, other.R) / excess)
    table = Table("problems", "n", "proved (<= 1e-8)", "largest gap", "median gap", "gap / excess of a worse minimum")
    for name, gaps in at_best.items():
        ratio = at_other[name]
        excess = f"{min(ratio):.6f} .. {max(ratio):.6f} ({len(ratio)})" if ratio else "none worse"
        share = f"{100 * np.mean(np.array(gaps) <= 1e-8):.2f} %"
        table.add_row(name, str(len(gaps)), share, f"{max(gaps):.1e}", f"{np.median(gaps):.1e}", excess)
    return table


def peer(Q: Array, starts: int) -> float:
    """Lowest cost that scipy's BFGS finds from random rotation vectors."""

    def cost(rotvec: Array) -> float:
        r = Rotation.from_rotvec(rotvec).as_matrix().ravel()
        return float(r @ Q @ r)

    return min(float(minimize(cost, x.as_rotvec()).fun) for x in Rotation.random(starts, rng=np.random.default_rng(3)))


def timings(cases: list[tuple[str, Array]]) -> Table:
    """Median CPU time of one thread, independent of other load."""

    def median_ms(calls: Iterable[Callable[[], object]]) -> float:
        took = []
        for call in calls:
            start = time.process_time_ns()
            call()
            took.append(time.process_time_ns() - start)
        return float(np.median(took)) / 1e6

    Qs = [Q for name, Q in cases if name in SETS][:400]
    best = [rotation_minima.minima(Q)[0].R for Q in Qs]
    minima_ms = median_ms(partial(rotation_minima.minima, Q) for Q in Qs)
    certificate_ms = median_ms(partial(rotation_minima.certificate, Q, R) for Q, R in zip(Qs, best, strict=True))
    peer_ms = median_ms(partial(peer, Q, 24) for Q in Qs[:10])
    table = Table("step", "median ms", "times minima")
    table.add_row("minima", f"{minima_ms:.2f}", "1")
    table.add_row("certificate", f"{certificate_ms:.2f}", f"{certificate_ms / minima_ms:.2f}")
    table.add_row("scipy BFGS from 24 random starts", f"{peer_ms:.0f}", f"{peer_ms / minima_ms:.0f}")
    rng = np.random.default_rng(0)
    for n in (24, 10_000, 1_000_000):
        R, force, w = Rotation.random(n, rng=rng).as_matrix(), rng.normal(size=(n, 3)), np.ones(n)
        took = median_ms([partial(rotation_minima.force_cost, R, force, w)] * 5)
        table.add_row(f"force_cost, {n} poses", f"{took:.2f}", f"{took / minima_ms:.2f}")
    return table


if __name__ == "__main__":
    cases = problems(int(sys.argv[1]) if len(sys.argv) > 1 else 16000)
    console = Console(width=150)
    console.print(timings(cases))
    console.print(certificates(cases))
    console.print(starts_needed(cases))
