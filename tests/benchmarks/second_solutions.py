"""Whether a second solution is named where the data have one, and only there.

    python -m tests.benchmarks.second_solutions              # 200 sets of each kind, about ten minutes
    python -m tests.benchmarks.second_solutions --sets 20 --seed 7

Good sets: 24 orientations and a sensor whose force axes have gains of 3 %, through every published method. Their minima
lie far apart, so none may be rejected for a second solution.

Ambiguous sets: four to eight orientations of almost one angle to gravity, white noise. Whether such a set has a second
solution is decided here, by a search that uses nothing of the project: least squares of all fifteen parameters from 40
mountings. The set has one if another mounting, more than 20° away, costs less than 12 more in chi-squared, the limit
from which on the best solution is accepted.

Columns: sets, sets whose second solution is named or that are refused before the fit, and sets rejected.
"""

import argparse
from typing import Final, get_args

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, NotObservable, Setup, solve
from ftcalib.model import Array, SPECIAL_R_flange_base
from ftcalib.published.methods import BASELINES, PUBLISHED
from ftcalib.result import Method
from tests.benchmarks.common import restart_with_one_thread, show

SIGMA: Final = np.repeat([0.05, 0.00125], 3)
LIMIT: Final = 12.0
APART_RAD: Final = np.deg2rad(20)


def readings(R_base_flange: Array, turn: Rotation, gain: Array, rng: np.random.Generator) -> Array:
    """Wrenches (n, 6) of a tool of 2 kg on a sensor that is turned against the flange."""
    force = turn.inv().apply([0.4, -0.6, -20.0] @ R_base_flange)
    torque = np.cross([0.01, -0.02, -0.07], force)
    wrench = np.hstack([force * gain + [3, -5, 8], torque + np.array([0.1, 0.2, -0.3])])
    return np.asarray(wrench + rng.normal(size=wrench.shape) * SIGMA)


def as_dataset(R_base_flange: Array, wrench: Array) -> CalibrationDataset:
    n = len(wrench)
    cov = np.tile(np.diag(SIGMA**2), (n, 1, 1))
    return CalibrationDataset(R_base_flange, wrench, cov, np.full(n, 100), np.full(n, np.nan))


def second_cost(R_base_flange: Array, wrench: Array, rng: np.random.Generator) -> float:
    """Return by how much chi-squared of the best other mounting is above the minimum; infinity if there is none."""
    force, torque = wrench[:, :3], wrench[:, 3:]
    ones = np.tile(np.eye(3), (len(wrench), 1, 1))

    def linear(turn: Rotation) -> tuple[Array, Array]:
        # Gravity and force bias are linear if the mounting is known.
        A = np.concatenate([turn.as_matrix().T @ R_base_flange.swapaxes(1, 2), ones], axis=2).reshape(-1, 6)
        gravity_bias = np.linalg.lstsq(A, force.ravel())[0]
        return gravity_bias, (A @ gravity_bias - force.ravel()) / SIGMA[0]

    def reduced(x: Array, start: Rotation) -> Array:
        return linear(start * Rotation.from_rotvec(x))[1]

    def full(x: Array, start: Rotation) -> Array:
        predicted = (start * Rotation.from_rotvec(x[:3])).inv().apply(x[3:6] @ R_base_flange)
        both = np.hstack([predicted, np.cross(x[6:9], predicted)]) + x[9:15]
        return np.asarray(((both - wrench) / SIGMA).ravel())

    found: list[tuple[float, Rotation]] = []
    for start in Rotation.random(24, rng=rng):
        end = least_squares(reduced, np.zeros(3), args=(start,), method="lm")
        found.append((2 * end.cost, start * Rotation.from_rotvec(end.x)))
    kept: list[Rotation] = []
    for _, turn in sorted(found, key=lambda one: one[0]):
        if all((turn.inv() * other).magnitude() > 0.05 for other in kept):
            kept.append(turn)
    found = []
    for turn in kept[:6]:
        gravity_bias, _ = linear(turn)
        pull = turn.inv().apply(gravity_bias[:3] @ R_base_flange)
        B = np.concatenate([np.cross(np.eye(3)[None], pull[:, None]).swapaxes(1, 2), ones], axis=2).reshape(-1, 6)
        com_bias = np.linalg.lstsq(B, torque.ravel())[0]
        x = np.concatenate([np.zeros(3), gravity_bias[:3], com_bias[:3], gravity_bias[3:], com_bias[3:]])
        end = least_squares(full, x, args=(turn,), method="lm", x_scale=[*[1] * 3, *[20] * 3, *[0.1] * 3, *[5] * 6])
        found.append((2 * end.cost, turn * Rotation.from_rotvec(end.x[:3])))
    best, mounting = min(found, key=lambda one: one[0])
    return min([cost - best for cost, R in found if (mounting.inv() * R).magnitude() > APART_RAD], default=np.inf)


def nearly_one_tilt(rng: np.random.Generator) -> Array:
    """Four to eight orientations (n, 3, 3) whose angle to gravity varies by .03° to 1°."""
    n = int(rng.integers(4, 9))
    spread = np.exp(rng.uniform(np.log(np.deg2rad(0.03)), np.log(np.deg2rad(1))))
    tilt = rng.uniform(np.deg2rad(20), np.deg2rad(70)) + spread * rng.normal(size=n)
    turns = rng.uniform(-np.pi, np.pi, (2, n))
    upright = Rotation.align_vectors([[0.4, -0.6, -20.0]], [[0.0, 0.0, -1.0]])[0]  # the base leans a little
    return np.asarray((upright * Rotation.from_euler("ZYZ", np.column_stack([turns[0], tilt, turns[1]]))).as_matrix())


def found(dataset: CalibrationDataset, method: Method) -> tuple[bool, bool]:
    """Return whether a second solution is named or the set is refused, and whether it is rejected."""
    try:
        result = solve(dataset, method, setup=Setup(sensor_accuracy_percent=0.0) if method == "ml" else Setup())
    except NotObservable:
        return True, True
    return "second_solution" in [one.code for one in result.findings], result.verdict == "rejected"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    restart_with_one_thread()
    show(f"{'':10} {'method':22} {'sets':>5} {'named':>6} {'rejected':>9}")
    for method in (one for one in get_args(Method) if one in PUBLISHED and one not in (*BASELINES, "carlson-cayley")):
        rng = np.random.default_rng(options.seed)
        answers = []
        for _ in range(options.sets):
            R = Rotation.random(24, rng=rng).as_matrix()
            if method in ("srom", "mixed"):
                R = SPECIAL_R_flange_base.swapaxes(1, 2)
            wrench = readings(R, Rotation.random(rng=rng), rng.normal(1, 0.03, 3), rng)
            answers.append(found(as_dataset(R, wrench), method))
        show_row("good", method, answers)
    rng = np.random.default_rng(options.seed)
    ambiguous: list[CalibrationDataset] = []
    while len(ambiguous) < options.sets:
        R = nearly_one_tilt(rng)
        wrench = readings(R, Rotation.random(rng=rng), np.ones(3), rng)
        if second_cost(R, wrench, rng) < LIMIT:
            ambiguous.append(as_dataset(R, wrench))
    methods: tuple[Method, ...] = ("ml", "lrom", "carlson-polynomial")
    for method in methods:
        show_row("ambiguous", method, [found(one, method) for one in ambiguous])


def show_row(kind: str, method: str, answers: list[tuple[bool, bool]]) -> None:
    """Print one row of the table."""
    named, rejected = np.sum(answers, axis=0)
    show(f"{kind:10} {method:22} {len(answers):5} {named:6} {rejected:9}")


if __name__ == "__main__":
    main()
