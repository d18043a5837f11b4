"""Whether sigmas and shown errors hold under what real cells do: error over sigma, coverage, the next use, cost.

    python -m tests.benchmarks.honest_sigmas                                  # 100 sessions a cell, an hour or more
    python -m tests.benchmarks.honest_sigmas --cells hidden --sessions 40     # 24, 12, 6 and 4 poses
    python -m tests.benchmarks.honest_sigmas --cells alone --scale 2          # each disturbance, at twice its size
    python -m tests.benchmarks.honest_sigmas --cells white --declared --noise unknown --range wrist --seed 7

The generator is its own: of the project it uses `solve` and what a caller hands it. A tool of 0.6 to 2.5 kg hangs on
an arm with the kinematics of a UR5e. Poses have 0.01 N and 0.4 mN·m of white noise. `CELLS` combines disturbances. The
sizes are sigmas of normal distributions, drawn once per session, except where the list says exact:

common      common gain of all axes
gain        6 x 6 matrix: diagonal, and cross-talk of half of that, where 1 N counts as 50 mN·m
flange      constant error of the arm's orientation at the flange, ° an axis
base        the same at the base; in the workspace, half of its variance is drawn per pose
joints      errors of the joint zeros and of the link twists, ° each
sag         turn of the sensor against the flange, rad per N·m at the flange; half-normal, for each axis
soft        shift of the centre of mass, m an axis: a symmetric matrix times the direction of gravity in sensor axes
cable       torsion spring about the flange axes, N·m at half a turn; exact
quadratic   second-order terms of the reading, relative to the weight, where 1 N counts as 50 mN·m
hysteresis  each reading lags by this part of the last swing of its axis; exact
coloured    noise with a correlation of 0.8 between successive poses, in sigmas of the white noise
play        backlash of each joint, °; the last move selects the side; exact
lean        the base leans towards the arm, ° while the arm is stretched out horizontally; exact
walk        random walk of the bias, in 0.02 N and 0.8 mN·m per pose
warm-up     drift by 0.5 N and 20 mN·m with a third of the tour as time constant; exact
bumps       two poses are off by 1 N and 0.05 N·m
orientation independent error of each pose, ° an axis

Truth: nominal axes of the unloaded sensor against the true flange, weight in the base that does not lean, centre of
mass without shift, reading without load. The bias is that of the last pose where the result has a drift, else the mean
over the tour, and includes the mean of the cable.
The mean pull of a cable is therefore a bias, and is not drawn.

Columns: for each reported parameter the root mean square of error / sigma over all solved sessions, and in brackets the
share of components within 1.96 sigma where the verdict is GOOD or USABLE (95 expected). GOOD in % of the solved
sessions; the share of these with any component of any parameter beyond 3 sigma and beyond 5 sigma, in % (about 4 and 0
by chance). Shown over true error of the next use, force and torque, medians where GOOD or USABLE: poses that continue
the tour, then any orientation with any base joints. False alarms in % of verifications with six poses that continue the
tour (1 expected). Sessions accepted, refused, and unsound (a number that is not finite, a negative eigenvalue or a
traceback). Milliseconds of CPU per solve, mean.
"""

import argparse
import json
import sys
import time
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, NotObservable, Setup, solve
from ftcalib.after.verification import verify
from tests.benchmarks.common import show, two_workers

Array = NDArray[np.float64]

SIGMA = np.repeat([0.01, 0.4e-3], 3)
G_M_S2 = 9.80665
SENSOR_HEIGHT_M = 0.04
X, _, Z = np.eye(3)
DOWN = np.diag([1.0, -1.0, -1.0])
TWISTS = np.deg2rad([90, 0, 0, 90, -90, 0])
LINKS_M = (0.425, 0.3922)
UNITS = np.repeat([1.0, 0.05], 3)  # the sensor's range of torque is 50 mm times that of force
ALONE: dict[str, dict[str, float]] = {
    "joints": {"joints": 0.025},
    "sag": {"sag": 0.3e-3},
    "soft": {"soft": 0.15e-3},
    "gain": {"gain": 0.02},
    "common": {"common": 0.02},
    "load": {"quadratic": 0.002, "hysteresis": 0.002},
    "cable": {"cable": 0.05},
    "coloured": {"coloured": 2.0},
    "play": {"play": 0.05},
    "lean": {"lean": 0.2},
}
ARM = {"flange": 0.06, "base": 0.1, "joints": 0.025}
CELLS: dict[str, dict[str, float]] = {
    "hidden": {**ARM, "common": 0.014, "gain": 0.014, "sag": 0.3e-3, "soft": 0.1e-3, "cable": 0.005},
    "white": {},
    **ALONE,
    "walk": {"walk": 1.0},
    "orientation": {"orientation": 0.05},
    "hysteresis": {"hysteresis": 0.002},
    "warm-up": {"warm-up": 1.0},
    "bumps": {"bumps": 1.0},
    "all": {"gain": 0.02, "walk": 1.0, "orientation": 0.05, "hysteresis": 0.002},
    "far": {"gain": 0.02, "far": 1.0},
}
NEXT = 12  # poses that continue the tour, and poses in the workspace
PARAMETERS = ("R", "F_b", "mass", "tilt", "F0", "P", "T0")


def turned(v: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (3,) or (n, 3)."""
    return np.asarray(Rotation.from_rotvec(v).as_matrix())


def vector_of(R: Array) -> Array:
    """Rotation vectors of rotation matrices (3, 3) or (n, 3, 3)."""
    return np.asarray(Rotation.from_matrix(R).as_rotvec())


def orientations(rng: np.random.Generator, n: int, where: str) -> Array:
    """R_base_flange (n, 3, 3): any, or three wrist joints within 60° of a tool that points down."""
    if where == "any":
        return np.asarray(Rotation.random(n, rng).as_matrix())
    return np.asarray(DOWN @ Rotation.from_euler("XYZ", rng.uniform(-60, 60, (n, 3)), degrees=True).as_matrix())


def forward(q: Array, twists: Array = TWISTS) -> Array:
    """Flange orientations (n, 3, 3) of joint angles (n, 6)."""
    R = np.eye(3)
    for angle, twist in zip(q.T, twists, strict=True):
        R = R @ turned(angle[:, None] * Z) @ turned(twist * X)
    return R


def postures(R: Array, first: Array) -> Array:
    """Joint angles (n, 6) that reach orientations with the first three joints (n, 3) given."""
    # After the first twist, the chain is Rz(q2 + q3 + q4) Ry(-q5) Rz(q6).
    W = np.swapaxes(turned(first[:, :1] * Z) @ turned(TWISTS[0] * X), 1, 2) @ R
    fourth = np.arctan2(W[:, 1, 2], W[:, 0, 2]) - first[:, 1] - first[:, 2]
    fifth = -np.arccos(np.clip(W[:, 2, 2], -1, 1))
    return np.column_stack([first, fourth, fifth, np.arctan2(W[:, 2, 1], -W[:, 2, 0])])


def drifts(rng: np.random.Generator, n: int, size: Mapping[str, float]) -> Array:
    """Change of the bias (n + NEXT, 6) since its mean over the n poses of the tour, for them and those that go on."""
    more = n + NEXT
    moving = size["walk"] * np.cumsum(2 * SIGMA * rng.normal(size=(more, 6)), axis=0)
    direction = rng.normal(size=(2, 3))
    direction *= np.array([[0.5], [0.02]]) / np.linalg.norm(direction, axis=1)[:, None]
    moving += size["warm-up"] * (1 - np.exp(-3 * np.arange(more) / n))[:, None] * direction.ravel()
    noise = rng.normal(size=(more, 6))
    for i in range(1, more):
        noise[i] = 0.8 * noise[i - 1] + 0.6 * noise[i]
    moving += size["coloured"] * SIGMA * noise
    return np.asarray(moving - moving[:n].mean(axis=0))


@dataclass
class Session:
    """One tour with its truth, continued by the next use. All cells make the same draws, so they share tools."""

    rng: np.random.Generator
    n: int
    where: str
    size: Mapping[str, float]
    R: Array = field(init=False)
    readings: Array = field(init=False)
    """Reported orientations and readings of the tour, the poses that continue it, and those of the workspace."""

    def __post_init__(self) -> None:
        rng, n, size = self.rng, self.n, self.size
        self.R_flange_sensor = turned(rng.normal(size=3) * np.deg2rad([2, 2, 60]))
        self.F_b = -rng.uniform(0.6, 2.5) * G_M_S2 * turned(np.deg2rad(1.0) * rng.normal(size=3))[:, 2]
        self.P = np.array([*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.02, 0.1)])
        far = rng.uniform(0.02, 0.2) / np.linalg.norm(self.P)
        self.P *= far if size["far"] else 1.0
        self.bias = rng.normal(size=6) * np.repeat([5.0, 0.3], 3)
        self.scale_error = 0.001 * rng.normal()
        # The first pose precedes the tour, for hysteresis and play.
        R = np.concatenate([orientations(rng, 1 + n + NEXT, self.where), orientations(rng, NEXT, "any")])
        middle = np.array([rng.uniform(-np.pi, np.pi), rng.uniform(-2.3, -0.8), rng.uniform(0.8, 2.3)])
        first = middle + np.deg2rad(30) * rng.uniform(-1, 1, (len(R), 3))
        first[-NEXT:] = rng.uniform([-np.pi, -np.pi, -2.6], [np.pi, 0, 2.6], (NEXT, 3))
        self.R = R[1:]
        moving = drifts(rng, n, size)
        self.at_end = moving[n - 1]
        self.readings = self.read(postures(R, first)) + np.concatenate([moving, np.tile(moving[n - 1], (NEXT, 1))])
        bumps = rng.normal(size=(2, 6)) * np.repeat([1.0, 0.05], 3)
        self.readings[rng.choice(n, 2, replace=False)] += size["bumps"] * bumps

    def true_orientations(self, q: Array) -> Array:
        """R_base_flange (m, 3, 3) of postures (m, 6) whose nominal orientations the arm reports."""
        rng, n, size = self.rng, len(q), self.size
        zeros, twists = np.deg2rad(size["joints"]) * rng.normal(size=(2, 6))
        play = np.deg2rad(size["play"]) / 2 * np.sign(np.diff(q, axis=0, prepend=0.0))
        flange = np.deg2rad(size["flange"]) * rng.normal(size=3)
        base = np.tile(rng.normal(size=3), (n, 1))
        base[-NEXT:] = np.sqrt(0.5) * (base[-NEXT:] + rng.normal(size=(NEXT, 3)))
        reach = (LINKS_M[0] * np.cos(q[:, 1]) + LINKS_M[1] * np.cos(q[:, 1] + q[:, 2])) / sum(LINKS_M)
        to_the_arm = np.column_stack([-np.sin(q[:, 0]), np.cos(q[:, 0]), np.zeros(n)]) * reach[:, None]
        lean = np.deg2rad(size["lean"]) * to_the_arm
        each = np.deg2rad(size["orientation"]) * rng.normal(size=(n, 3))
        arm = forward(q + zeros + play, TWISTS + twists) @ turned(flange) @ turned(each)
        return np.asarray(turned(np.deg2rad(size["base"]) * base + lean) @ arm)

    def read(self, q: Array) -> Array:
        """Readings (m - 1, 6) of the free tool at all postures (m, 6) except the first."""
        rng, size = self.rng, self.size
        R = self.true_orientations(q)
        # The sensor sags under the torque of the weight about the flange.
        compliance = size["sag"] * np.abs(rng.normal(size=3))
        lever = self.R_flange_sensor @ self.P + SENSOR_HEIGHT_M * Z
        sag = compliance * np.cross(lever, np.einsum("nji,j->ni", R, self.F_b))
        u = np.einsum("nji,j->ni", R @ turned(sag) @ self.R_flange_sensor, self.F_b)
        weight = float(np.linalg.norm(self.F_b))
        soft = np.triu(rng.normal(size=(3, 3)))
        P = self.P + size["soft"] * (u / weight) @ (soft + np.triu(soft, 1).T)
        load = np.concatenate([u, np.cross(P, u)], axis=1)
        E = size["gain"] * np.where(np.eye(6) > 0, 1.0, 0.5) * rng.normal(size=(6, 6))
        E = E * np.outer(UNITS, 1 / UNITS) + size["common"] * rng.normal() * np.eye(6)
        second = weight * UNITS * np.einsum("kij,ni,nj->nk", rng.normal(size=(6, 3, 3)), u / weight, u / weight)
        y = load + load @ E.T + size["quadratic"] * second
        y[1:] -= size["hysteresis"] * np.diff(y, axis=0)
        cable = size["cable"] / np.pi * vector_of(DOWN @ R)
        self.bias[3:] += cable[1 : self.n + 1].mean(axis=0)
        y[:, 3:] += cable - cable[1 : self.n + 1].mean(axis=0)
        return np.asarray(y[1:] + self.bias + SIGMA * rng.normal(size=(len(q) - 1, 6)))

    def dataset(self, *, measured: bool) -> CalibrationDataset:
        """The poses of the tour."""
        n = self.n
        cov = np.tile(np.diag(SIGMA**2), (n, 1, 1)) if measured else None
        samples = np.full(n, 500 if measured else 0)
        return CalibrationDataset(self.R[:n], self.readings[:n], cov, samples, np.arange(0.0, 10.0 * n, 10.0))

    def setup(self, *, declared: bool, weighed: bool) -> Setup:
        """What the user declares: nothing, a perfect sensor, or the mass on scales of 0.1 %."""
        kg = float(np.linalg.norm(self.F_b)) / G_M_S2
        mass, sigma = (kg * (1 + self.scale_error), 0.001 * kg) if weighed else (None, None)
        return Setup(tool_mass_kg=mass, tool_mass_sigma_kg=sigma, sensor_accuracy_percent=0.0 if declared else None)

    def errors(self, result: CalibrationResult) -> Iterator[Array]:
        """Give the errors of each of PARAMETERS in sigmas."""
        sigma = result.sigma
        R_error = vector_of(self.R_flange_sensor.T @ result.R_flange_sensor)
        yield self.R_flange_sensor @ R_error / sigma["R_flange_sensor"]
        yield (result.gravity_force_base_N - self.F_b) / sigma["gravity_force_base_N"]
        yield np.atleast_1d((result.mass_kg - np.linalg.norm(self.F_b) / G_M_S2) / sigma["mass_kg"])
        x, y, z = -self.F_b / np.linalg.norm(self.F_b)
        tilt = np.array([np.arctan2(-y, np.hypot(x, z)), np.arctan2(x, z)])
        found = np.array([result.tilt_alpha_rad, result.tilt_beta_rad])
        yield np.sin(found - tilt) / np.array([sigma["tilt_alpha_rad"], sigma["tilt_beta_rad"]])
        bias = self.bias if result.mean_bias is None else self.bias + self.at_end
        yield (result.force_bias_N - bias[:3]) / sigma["force_bias_N"]
        yield (result.p_sensor_com_m - self.P) / sigma["p_sensor_com_m"]
        yield (result.torque_bias_Nm - bias[3:]) / sigma["torque_bias_Nm"]

    def is_false_alarm(self, result: CalibrationResult, data: CalibrationDataset) -> bool:
        """Whether a verification with six poses that continue the tour finds a change, although nothing changed."""
        new = slice(self.n, self.n + 6)
        cov = np.tile(np.diag(SIGMA**2), (6, 1, 1))
        return verify(result, self.R[new], self.readings[new], cov, fitted=data).p_value < 0.01

    def next_use(self, result: CalibrationResult) -> Array:
        """Shown over true error (2, 2): poses that continue the tour, and workspace; force, torque."""
        rest = result.compensate(self.readings[self.n :], self.R[self.n :]).reshape(2, NEXT, 2, 3)
        true = np.mean(np.sum(rest**2, axis=3), axis=1)
        # What noise explains is shown without the noise of a reading, which the next use has too.
        noise = np.sum(SIGMA.reshape(2, 3) ** 2, axis=1) if result.noise_explains else 0.0
        shown = np.array([result.likely_error("next_use"), result.likely_error("workspace")])
        return np.asarray(np.sqrt((shown**2 + noise) / true))


def is_sound(result: CalibrationResult) -> bool:
    """Whether the numbers are finite and the covariance is positive definite, and the result can be written."""
    C = result.covariance if result.response is None else result.response.covariance
    seen = np.diag(C) > 0
    d = np.sqrt(np.diag(C)[seen])
    eigenvalues = np.linalg.eigvalsh(C[np.ix_(seen, seen)] / np.outer(d, d))
    json.dumps(result.to_dict(), allow_nan=False)
    return bool(seen[:15].all() and eigenvalues[0] > 0 and all(np.isfinite(s).all() for s in result.sigma.values()))


Record = tuple[str, list[Array], Array, float, float]  # verdict, errors in sigmas, next use, false alarm, ms


def attempt(name: str, n: int, where: str, noise: str, options: argparse.Namespace, k: int) -> Record | str:
    """Solve session k of a cell; return the text of a fault, which is empty if the solver refused the poses."""
    size = defaultdict(float, {key: options.scale * value for key, value in CELLS[name].items()})
    # Sessions with the same number share tool, poses and draws in all cells.
    rng = np.random.default_rng([options.seed, k, n, zlib.crc32(where.encode())])
    session = Session(rng, n, where, size)
    data = session.dataset(measured=noise == "given")
    start = time.process_time()
    try:
        result = solve(data, setup=session.setup(declared=options.declared, weighed=options.weighed))
        ms = 1e3 * (time.process_time() - start)
        if not is_sound(result):
            return f"session {k}: covariance"
        alarm = float(session.is_false_alarm(result, data))
        return result.verdict, list(session.errors(result)), session.next_use(result), alarm, ms
    except NotObservable:
        return ""
    except Exception as exc:  # what a user would see as a traceback is counted
        return f"session {k}: {type(exc).__name__}: {exc}"


def row(records: list[Record | str]) -> str:
    """Format the figures of a cell."""
    solved = [record for record in records if not isinstance(record, str)]
    if not solved:
        return "none solved"
    kept = [record for record in solved if record[0] != "rejected"]
    good = np.array([max(np.abs(z).max() for z in errors) for verdict, errors, *_ in solved if verdict == "good"])
    figures = []
    for i in range(len(PARAMETERS)):
        ratio = np.sqrt(np.mean([record[1][i] ** 2 for record in solved]))
        cover = np.mean([np.abs(record[1][i]) < 1.96 for record in kept]) if kept else np.nan
        figures.append(f"{ratio:5.2f} ({100 * cover:3.0f})")
    beyond = [100 * np.mean(good > limit) if len(good) else np.nan for limit in (3, 5)]
    use = np.median([record[2] for record in kept], axis=0) if kept else np.full((2, 2), np.nan)
    alarm = 100 * np.mean([record[3] for record in kept]) if kept else np.nan
    refused = records.count("")
    counts = f"{len(kept):4} {refused:3} {len(records) - len(solved) - refused:3}"
    verdicts = f"{100 * len(good) / len(solved):4.0f} {beyond[0]:4.0f} {beyond[1]:4.0f}"
    next_use = "  ".join(f"{part[0]:5.2f} {part[1]:5.2f}" for part in use)
    ms = np.mean([record[4] for record in solved])
    return f"{' '.join(figures)}  {verdicts}   {next_use} {alarm:6.0f}  {counts} {ms:6.0f}"


def main() -> int:
    """Print the table; sessions without a sound result go to stderr."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=100, help="per cell")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cells", nargs="+", choices=[*CELLS, "alone"], default=list(CELLS))
    parser.add_argument("--poses", nargs="+", type=int, help="default 24; 24, 12, 6 and 4 for hidden")
    parser.add_argument("--range", nargs="+", choices=("any", "wrist"), default=["any", "wrist"], dest="where")
    parser.add_argument("--noise", nargs="+", choices=("given", "unknown"), default=["given"])
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the size of every disturbance")
    parser.add_argument("--declared", action="store_true", help="declare a sensor without gain errors")
    parser.add_argument("--weighed", action="store_true", help="declare the mass, on scales of 0.1 %%")
    options = parser.parse_args()
    heads = " ".join(f"{p:>11}" for p in PARAMETERS)
    use = f"{'own region':>13} {'workspace':>12}"
    show(f"{'cell':11} {'n':>3} {'range':5} {'noise':7} {heads}  good  >3s  >5s {use} alarms  kept ref bad     ms")
    names = [name for given in options.cells for name in (ALONE if given == "alone" else [given])]
    with two_workers() as pool:
        for name in names:
            poses = options.poses or ([24, 12, 6, 4] if name == "hidden" else [24])
            for n, where, noise in product(poses, options.where, options.noise):
                cell = partial(attempt, name, n, where, noise, options)
                records = list(pool.imap(cell, range(options.sessions), chunksize=4))
                for fault in filter(None, (record for record in records if isinstance(record, str))):
                    sys.stderr.write(f"{name} {n} {where} {noise} seed {options.seed} {fault}\n")
                show(f"{name:11} {n:3} {where:5} {noise:7} {row(records)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
