"""Whether sigmas and shown errors hold under what real sensors do: error over sigma, coverage, the next use, cost.

    python -m tests.benchmarks.honest_sigmas                                  # 400 sessions a cell, about an hour
    python -m tests.benchmarks.honest_sigmas --sessions 100 --cells white gain --poses 24
    python -m tests.benchmarks.honest_sigmas --cells white --range wrist --noise unknown --seed 7

The generator is its own: of the project it uses `solve` and what a caller hands it. A tool of 0.6 to 2.5 kg, 0.01 N and
0.4 mN·m of noise a pose, and one disturbance:

gain         3x3 gain of the force, entries of 2 %, and cross-talk from force to torque, 1 % of 50 mm
walk         bias walks by 0.02 N and 0.8 mN·m a pose
orientation  0.05° an axis
hysteresis   each reading lags by 0.2 % of the last swing of its axis
warm-up      bias changes by 0.5 N and 20 mN·m, exponentially, with a third of the tour as time constant
cable        a spring about the flange axes, 0.05 N·m at half a turn
bumps        two poses with 1 N and 0.05 N·m
all          gain, walk, orientation and hysteresis
far          gain of 1 to 3 %, centre of mass at 20 to 200 mm

Columns: for each reported parameter root mean square of error / sigma over all sessions, and in brackets the share
within two sigmas where GOOD or USABLE is printed; true error of the next use over the shown one, median over the
sessions, force and torque, for poses that continue the tour and for any orientation at its end; largest true error of
the next use in medians of the cell; false alarms in % of a verification with six poses that continue the tour, 1 %
expected at most; sessions accepted, refused, and with a number that is not finite, a negative eigenvalue or a
traceback; milliseconds of CPU, mean and largest. The true bias is the mean over the tour.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationDataset, CalibrationResult, NotObservable, solve
from ftcalib.after.verification import verify
from tests.benchmarks.common import restart_with_one_thread, show

Array = NDArray[np.float64]

SIGMA = np.repeat([0.01, 0.4e-3], 3)
G_M_S2 = 9.80665
CELLS = {
    "white": (),
    "gain": ("gain",),
    "walk": ("walk",),
    "orientation": ("orientation",),
    "hysteresis": ("hysteresis",),
    "warm-up": ("warm-up",),
    "cable": ("cable",),
    "bumps": ("bumps",),
    "all": ("gain", "walk", "orientation", "hysteresis"),
    "far": ("gain", "far"),
}
NEXT = 12
"""Poses that continue the tour, and poses at its end."""
PARAMETERS = ("R", "F_b", "mass", "tilt", "F0", "P", "T0")


def cross(v: Array) -> Array:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    zero = np.zeros(v.shape[:-1])
    x, y, z = np.moveaxis(v, -1, 0)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape, 3)


def turned(v: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    K = cross(v) / np.where(angle > 0, angle, 1.0)
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def vector_of(R: Array) -> Array:
    """Rotation vectors (..., 3) of rotation matrices, away from half a turn."""
    angle = np.arccos(np.clip((np.trace(R, axis1=-2, axis2=-1) - 1) / 2, -1, 1))[..., None]
    axial = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    return np.asarray(axial / 2 * np.where(angle > 1e-6, angle / np.maximum(np.sin(angle), 1e-9), 1.0))


def orientations(rng: np.random.Generator, n: int, where: str) -> Array:
    """R_base_flange (n, 3, 3): any, or three wrist joints within 60° of a tool that points down."""
    if where == "any":
        q = rng.normal(size=(n, 4))
        q /= np.linalg.norm(q, axis=1)[:, None]
        w, v = q[:, :1, None], q[:, 1:]
        return np.asarray(
            (w**2 - (v**2).sum(axis=1)[:, None, None]) * np.eye(3) + 2 * v[..., None] * v[:, None] + 2 * w * cross(v)
        )
    a = np.deg2rad(60) * rng.uniform(-1, 1, (3, n))
    x, y, z = (turned(angle[:, None] * axis) for angle, axis in zip(a, np.eye(3), strict=True))
    return np.asarray(np.diag([1.0, -1, -1]) @ x @ y @ z)


@dataclass
class Session:
    """One tour with its truth, continued by the next use."""

    rng: np.random.Generator
    n: int
    where: str
    acts: tuple[str, ...]
    R: Array = field(init=False)
    readings: Array = field(init=False)
    end: tuple[Array, Array] = field(init=False)
    """Orientations and readings at the end of the tour."""

    def __post_init__(self) -> None:
        rng, acts = self.rng, self.acts
        self.R_flange_sensor = turned(rng.normal(size=3) * np.deg2rad([2, 2, 60]))
        self.F_b = rng.uniform(0.6, 2.5) * G_M_S2 * turned(rng.normal(size=3) * np.deg2rad(1.0))[:, 2] * -1
        self.P = np.array([*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.02, 0.1)])
        self.bias = rng.normal(size=6) * np.repeat([5.0, 0.3], 3)
        gain = 0.02
        if "far" in acts:
            gain = rng.uniform(0.01, 0.03)
            self.P *= rng.uniform(0.02, 0.2) / np.linalg.norm(self.P)
        self.K = np.eye(3) + gain * rng.normal(size=(3, 3)) if "gain" in acts else np.eye(3)
        self.C = 0.01 * 0.05 * rng.normal(size=(3, 3)) if "gain" in acts else np.zeros((3, 3))
        n, more = self.n, self.n + NEXT
        self.R = orientations(rng, more, self.where)
        R_end = orientations(rng, NEXT, self.where)
        moving = np.zeros((more, 6))
        if "walk" in acts:
            moving += np.cumsum(np.repeat([0.02, 0.8e-3], 3) * rng.normal(size=(more, 6)), axis=0)
        if "warm-up" in acts:
            direction = rng.normal(size=(2, 3))
            direction *= np.array([[0.5], [0.02]]) / np.linalg.norm(direction, axis=1)[:, None]
            moving += (1 - np.exp(-3 * np.arange(more) / n))[:, None] * direction.ravel()
        self.bias += moving[:n].mean(axis=0)
        moving -= moving[:n].mean(axis=0)
        before = orientations(rng, 1, self.where)
        self.readings = self.read(self.R, before) + moving
        self.end = R_end, self.read(R_end, self.R[n - 1 : n]) + moving[n - 1]
        if "bumps" in acts:
            self.readings[rng.choice(n, 2, replace=False)] += rng.normal(size=(2, 6)) * np.repeat([1.0, 0.05], 3)

    def read(self, R: Array, before: Array) -> Array:
        """Readings (n, 6) of the free tool at orientations, after one `before` them."""
        true = np.concatenate([before, R])
        if "orientation" in self.acts:
            true = true @ turned(np.deg2rad(0.05) * self.rng.normal(size=(len(true), 3)))
        u = np.einsum("nji,j->ni", true @ self.R_flange_sensor, self.F_b)
        y = np.concatenate([u @ self.K.T, np.cross(self.P, u) + u @ self.C.T], axis=1)
        if "cable" in self.acts:
            y[:, 3:] += 0.05 / np.pi * vector_of(np.diag([1.0, -1, -1]) @ true)
        if "hysteresis" in self.acts:
            y[1:] -= 0.002 * np.diff(y, axis=0)
        return np.asarray(y[1:] + self.bias + SIGMA * self.rng.normal(size=(len(R), 6)))

    def dataset(self, *, measured: bool) -> CalibrationDataset:
        """The poses of the tour."""
        cov = np.tile(np.diag(SIGMA**2), (self.n, 1, 1)) if measured else None
        samples = np.full(self.n, 500 if measured else 0)
        return CalibrationDataset(
            self.R[: self.n], self.readings[: self.n], cov, samples, np.arange(0.0, 10.0 * self.n, 10.0)
        )

    def errors(self, result: CalibrationResult) -> Iterator[tuple[str, Array]]:
        """Give each parameter with its errors in sigmas."""
        sigma = result.sigma
        R_error = vector_of(self.R_flange_sensor.T @ result.R_flange_sensor)
        yield "R", self.R_flange_sensor @ R_error / sigma["R_flange_sensor"]
        yield "F_b", (result.gravity_force_base_N - self.F_b) / sigma["gravity_force_base_N"]
        yield "mass", np.atleast_1d((result.mass_kg - np.linalg.norm(self.F_b) / G_M_S2) / sigma["mass_kg"])
        x, y, z = -self.F_b / np.linalg.norm(self.F_b)
        tilt = np.array([np.arctan2(-y, np.hypot(x, z)), np.arctan2(x, z)])
        found = np.array([result.tilt_alpha_rad, result.tilt_beta_rad])
        yield "tilt", np.sin(found - tilt) / np.array([sigma["tilt_alpha_rad"], sigma["tilt_beta_rad"]])
        yield "F0", (result.force_bias_N - self.bias[:3]) / sigma["force_bias_N"]
        yield "P", (result.p_sensor_com_m - self.P) / sigma["p_sensor_com_m"]
        yield "T0", (result.torque_bias_Nm - self.bias[3:]) / sigma["torque_bias_Nm"]

    def is_false_alarm(self, result: CalibrationResult, data: CalibrationDataset) -> bool:
        """Whether a verification with six poses that continue the tour finds a change, although nothing changed."""
        new = slice(self.n, self.n + 6)
        cov = np.tile(np.diag(SIGMA**2), (6, 1, 1))
        return verify(result, self.R[new], self.readings[new], cov, fitted=data).p_value < 0.01

    def next_use(self, result: CalibrationResult) -> Array:
        """Mean square true error (2, 2) of poses that continue the tour, and at its end: force, torque."""
        rows = []
        for R, y in ((self.R[self.n :], self.readings[self.n :]), self.end):
            rest = result.compensate(y, R)
            rows.append([np.mean(np.sum(rest[:, c] ** 2, axis=1)) for c in (slice(3), slice(3, 6))])
        return np.array(rows)


def is_sound(result: CalibrationResult) -> bool:
    """Whether the numbers are finite and the covariance is positive definite, and the result can be written."""
    C = result.covariance if result.response is None else result.response.covariance
    seen = np.diag(C) > 0
    d = np.sqrt(np.diag(C)[seen])
    eigenvalues = np.linalg.eigvalsh(C[np.ix_(seen, seen)] / np.outer(d, d))
    json.dumps(result.to_dict(), allow_nan=False)
    return bool(seen[:15].all() and eigenvalues[0] > 0 and all(np.isfinite(s).all() for s in result.sigma.values()))


def cell(name: str, n: int, where: str, *, measured: bool, sessions: int, seed: int) -> str:
    """Run the sessions of a cell and format its row."""
    scaled: dict[str, list[Array]] = {p: [] for p in PARAMETERS}
    within: dict[str, list[Array]] = {p: [] for p in PARAMETERS}
    true, shown, alarms, ms, unsound, refused, accepted = [], [], [], [], [], 0, 0
    for k in range(sessions):
        identity = [seed, k, n, list(CELLS).index(name), where == "any", measured]
        session = Session(np.random.default_rng(identity), n, where, CELLS[name])
        data = session.dataset(measured=measured)
        start = time.process_time()
        try:
            result = solve(data)
            sound = is_sound(result)
        except NotObservable:
            refused += 1
            continue
        except Exception as exc:  # what a user would see as a traceback is counted
            unsound.append((k, f"{type(exc).__name__}: {exc}"))
            continue
        ms.append(1e3 * (time.process_time() - start))
        if not sound:
            unsound.append((k, "covariance"))
            continue
        passed = result.verdict != "rejected"
        accepted += passed
        for parameter, z in session.errors(result):
            scaled[parameter].append(z)
            if passed:
                within[parameter].append((np.abs(z) < 2).astype(float))
        if passed:
            true.append(session.next_use(result))
            alarms.append(session.is_false_alarm(result, data))
            # What noise explains is shown without the noise of a reading, which the next use has too.
            noise = np.sum(SIGMA.reshape(2, 3) ** 2, axis=1) if result.noise_explains else 0.0
            shown.append(result.likely_error() ** 2 + noise)
    for k, why in unsound:
        sys.stderr.write(f"{name} {n} {where} measured={measured} seed {seed} session {k}: {why}\n")
    ratio = {p: float(np.sqrt(np.mean(np.square(z)))) if z else np.nan for p, z in scaled.items()}
    cover = {p: 100 * float(np.mean(z)) if z else np.nan for p, z in within.items()}
    use, worst = np.full((2, 2), np.nan), np.nan
    if true:
        of_next = np.sqrt(np.array(true)[:, 0])
        worst = float(np.max(of_next / np.median(of_next, axis=0)))
        use = np.sqrt(np.median(np.array(true) / np.array(shown)[:, None], axis=0))
    figures = " ".join(f"{ratio[p]:5.2f} ({cover[p]:3.0f})" for p in PARAMETERS)
    next_use = " ".join(f"{part[0]:5.2f} {part[1]:5.2f}" for part in use)
    alarm = 100 * float(np.mean(alarms)) if alarms else np.nan
    source = "given" if measured else "unknown"
    cost = f"{np.mean(ms) if ms else np.nan:6.1f} {max(ms, default=np.nan):6.0f}"
    counts = f"{accepted:4} {refused:3} {len(unsound):3}"
    return f"{name:11} {n:3} {where:5} {source:7} {figures}  {next_use} {worst:5.1f} {alarm:6.1f}  {counts} {cost}"


def main() -> int:
    """Print the table; sessions without a sound result go to stderr."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=400, help="per cell")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cells", nargs="+", choices=CELLS, default=list(CELLS))
    parser.add_argument("--poses", nargs="+", type=int, default=[24, 12])
    parser.add_argument("--range", nargs="+", choices=("any", "wrist"), default=["any", "wrist"], dest="where")
    parser.add_argument("--noise", nargs="+", choices=("given", "unknown"), default=["given", "unknown"])
    options = parser.parse_args()
    heads: list[Any] = [f"{p:>11}" for p in PARAMETERS]
    sys.stdout.write(
        f"{'cell':11} {'n':>3} {'range':5} {'noise':7} {' '.join(heads)}  {'next use':>11} {'at the end':>11}"
        " worst alarms  kept ref bad   ms    most\n"
    )
    for name, n, where, noise in product(options.cells, options.poses, options.where, options.noise):
        row = cell(name, n, where, measured=noise == "given", sessions=options.sessions, seed=options.seed)
        show(row)
    return 0


if __name__ == "__main__":
    restart_with_one_thread()
    sys.exit(main())
