"""The fit of rows in motion: its equations against dense ones, and what it states."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from ftcalib.known import RANGE_LEVER_M
from ftcalib.model import Array, skew
from ftcalib.motion.estimate import (
    _first_kept,
    fit_motion,
    rough_delay,
)
from ftcalib.motion.model import (
    CROSS_TALK,
    DELAY,
    GAINS,
    HEIGHT,
    INERTIA,
    SIZE,
    MovingLoad,
    RowNoise,
    lever_columns,
    motion_jacobian,
    wrench_of,
)
from ftcalib.motion.problem import DELAY_S, GYRATION_M, HEIGHT_M, Problem
from ftcalib.motion.samples import Motion, MotionRows
from ftcalib.motion.solve import solve_motion
from tests.moving_load import Truth, means_of, record, sweep
from tests.unit.calib.motion.test_motion import load_of

G = 9.80665
ROW_S = 0.12
SIGMA = np.repeat([0.2, 0.01], 3)
ALL_ON = {"gain": 0.01, "cross_talk": 3e-3, "walk_N": 0.05, "walk_Nm": 2e-3}
Posed = tuple[Problem, MovingLoad, Array]


def rows_of(
    n: int, load: MovingLoad, *, seed: int = 0, turn_rad: float = 3.0, sigma: Array = SIGMA, row_s: float = ROW_S
) -> MotionRows:
    """Rows of a random motion of this load, with white noise."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(turn_rad * rng.uniform(-1, 1, (n, 3)))
    omega, alpha = rng.normal(size=(2, n, 3))
    motion = Motion(
        (turns * Rotation.from_euler("x", 180, degrees=True)).as_matrix(),
        rng.normal(size=(n, 3)),
        skew(alpha) + skew(omega) @ skew(omega),
    )
    rate = Motion.of_columns(rng.normal(size=(n, 21)))
    wrench = wrench_of(load, motion.earlier(load.delay_s, rate)) + sigma * rng.normal(size=(n, 6))
    t: Array = np.arange(n) * np.float64(row_s)
    return MotionRows(t, wrench, motion, rate, np.linalg.norm(omega, axis=1), 0.0, row_s)


def all_kept(rows: MotionRows) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return np.ones(len(rows), np.bool_)


WHITE = RowNoise(SIGMA[None], np.ones((1, 6, 1)), np.eye(6))


class Dense:
    """The same problem as one matrix: readings in their noise, and the covariance of what is expected."""

    def __init__(self, problem: Problem, load: MovingLoad, drift: Array) -> None:
        rows = problem.rows
        motion = rows.motion.earlier(load.delay_s, rows.rate)
        knots = len(problem.knots)
        hats = np.maximum(1 - np.abs(rows.t_s[:, None] - problem.knots) / np.diff(problem.knots)[0], 0)
        self.r = ((rows.wrench - wrench_of(load, motion) - hats @ drift) / SIGMA).ravel()
        on_knots = np.einsum("nk,ij->nikj", hats, np.eye(6)).reshape(len(rows), 6, -1)
        lever = lever_columns(load, motion)
        J = np.concatenate([motion_jacobian(load, motion, rows.rate), on_knots, lever], axis=2)
        self.J = (J / SIGMA[:, None]).reshape(6 * len(rows), -1)
        self.steps = np.tril(np.ones((knots, knots)), -1)[:, :-1] * np.sqrt(np.diff(problem.knots)[0])
        self.since_end = np.eye(knots) - np.eye(knots)[-1]
        self.value = np.concatenate([load.vector, drift.ravel(), np.zeros(3)])
        self.mass_kg = load.mass_kg

    def expected(self, sizes: dict[str, float]) -> Array:
        """Covariance of all but the static values: those of motion, gain, cross-talk, knots of the bias, and lever."""
        variance = np.zeros(SIZE)
        variance[INERTIA], variance[HEIGHT], variance[DELAY] = (
            (self.mass_kg * GYRATION_M**2) ** 2,
            HEIGHT_M**2,
            DELAY_S**2,
        )
        variance[GAINS], variance[CROSS_TALK] = sizes["gain"] ** 2, sizes["cross_talk"] ** 2
        walk = np.diag(np.repeat([sizes["walk_N"] ** 2, sizes["walk_Nm"] ** 2], 3))
        root = self.since_end @ self.steps
        lever = sizes["cross_talk"] ** 2 * RANGE_LEVER_M**2 / 2 * np.eye(3)
        return np.asarray(block_diag(np.diag(variance[15:]), np.kron(root @ root.T, walk), lever))

    def solution(self, sizes: dict[str, float]) -> tuple[Array, Array, float, float]:
        """Values, covariance of the static ones, cost, and -2 log restricted likelihood."""
        X, Z, K = self.J[:, :15], self.J[:, 15:], self.expected(sizes)
        y = self.r + Z @ self.value[15:]  # about values of 0
        S = np.eye(len(y)) + Z @ K @ Z.T
        SX = np.linalg.solve(S, X)
        C = np.linalg.inv(X.T @ SX)
        step = C @ SX.T @ y
        left = y - X @ step
        cost = float(left @ np.linalg.solve(S, left))
        values = np.concatenate([step, K @ Z.T @ np.linalg.solve(S, left)])
        return values, C, cost, float(cost + np.linalg.slogdet(S)[1] - np.linalg.slogdet(C)[1])


@pytest.fixture(scope="module")
def posed() -> Posed:
    truth = replace(load_of(Truth(), 3e-3), delay_s=0.01)
    rows = rows_of(45, truth, row_s=0.4)
    problem = Problem(rows, None, G, point_mass=False)
    rng = np.random.default_rng(1)
    near = truth.moved(1e-3 * rng.normal(size=SIZE))
    drift = rng.normal(size=(len(problem.knots), 6)) * np.repeat([0.05, 2e-3], 3)
    effects = np.zeros(len(problem.basis))
    effects[: drift.size] = (drift - drift[-1]).ravel()
    return problem, near, effects


@pytest.mark.parametrize("off", [(), ("cross_talk", "walk_Nm")])
def test_a_step_is_that_of_generalised_least_squares(posed: Posed, off: tuple[str, ...]) -> None:
    problem, load, effects = posed
    sizes = {name: 0.0 if name in off else size for name, size in ALL_ON.items()}
    sums = problem.sums(load, effects, WHITE, all_kept(problem.rows), np.zeros(len(problem.rows), np.intp))
    dense = Dense(problem, load, problem.drift(effects))
    assert sums[2] == pytest.approx(float(dense.r @ dense.r))
    found = problem.solve(sizes, sums, load, effects)
    values, covariance, cost, criterion = dense.solution(sizes)
    by_effects = problem.basis @ found.step[SIZE:]
    of_knots = len(dense.value) - SIZE - 3
    assert not by_effects[of_knots:-3].any()
    step = np.concatenate([found.step[:SIZE], by_effects[:of_knots], by_effects[-3:]])
    sigma = np.sqrt(np.diag(found.covariance))[:15]
    np.testing.assert_allclose((step + dense.value)[:15] / sigma, values[:15] / sigma, atol=1e-4)
    scale = np.abs(values[15:]).reshape(-1) + 1e-9
    np.testing.assert_allclose((step + dense.value)[15:] / scale, values[15:] / scale, atol=1e-4)
    np.testing.assert_allclose(
        found.covariance[:15, :15] / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=1e-6
    )
    assert found.cost == pytest.approx(cost, rel=1e-8)
    larger = {name: 2 * size for name, size in sizes.items()}
    other = problem.solve(larger, sums, load, effects).criterion
    assert other - found.criterion == pytest.approx(dense.solution(larger)[3] - criterion, abs=1e-5)
    none = problem.solve({}, sums, load, effects).criterion
    assert none - found.criterion == pytest.approx(dense.solution(dict.fromkeys(ALL_ON, 0.0))[3] - criterion, abs=1e-5)
    taken = problem.absorb(load, problem.rows[:20], found)
    T = block_diag(np.eye(SIZE), np.vstack([problem.basis[:of_knots], problem.basis[-3:]]))
    J = dense.J[:120].reshape(20, 6, -1) * SIGMA[:, None] @ T
    np.testing.assert_allclose(
        np.einsum("nik,njk->nij", taken, taken), J @ found.covariance @ np.swapaxes(J, 1, 2), rtol=1e-6, atol=1e-9
    )


def slowly_turned(rows: MotionRows) -> MotionRows:
    """The same rows in the order of a smooth path through their orientations."""
    order = np.argsort(rows.motion.R_base_flange[:, 2, 0])
    return replace(rows, wrench=rows.wrench[order], motion=rows.motion[order], rate=rows.rate[order])


def smoothly_wrong(seed: int) -> tuple[Array, Array, float]:
    """Errors over sigma of bias and centre of mass, next use over its true error, and size of the turns."""
    truth = load_of(Truth())
    rows = slowly_turned(rows_of(220, truth, seed=seed, turn_rad=0.9, sigma=SIGMA / 20))
    R = rows.motion.R_base_flange
    # Of the second degree in R: more than a constant turn.
    weights = np.random.default_rng([seed, 1]).normal(size=(9, 9, 3))
    turns = Rotation.from_rotvec(4e-4 * np.einsum("ni,nj,ijk->nk", R.reshape(-1, 9), R.reshape(-1, 9), weights))
    true = (Rotation.from_matrix(R) * turns).as_matrix()
    noise = SIGMA / 20 * np.random.default_rng([seed, 2]).normal(size=(220, 6))
    wrench = wrench_of(truth, replace(rows.motion, R_base_flange=true)) + noise
    found = fit_motion(replace(rows, wrench=wrench), None, G)
    still = Motion(R, np.zeros((220, 3)), np.zeros((220, 3, 3)))
    left = wrench_of(truth, replace(still, R_base_flange=true)) - wrench_of(found.load, still)
    ratio = found.next_use / np.sqrt(np.mean(np.sum(left.reshape(-1, 2, 3) ** 2, axis=2), axis=0))
    error = truth.static.difference(found.load.static)[6:15] / np.sqrt(np.diag(found.covariance))[6:15]
    return error, ratio, found.components["rotation_rad"]


@pytest.mark.slow
def test_a_smooth_error_of_the_poses_is_part_of_sigma() -> None:
    errors, ratios, _ = zip(*(smoothly_wrong(seed) for seed in range(1, 4)), strict=True)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(ratios), axis=0)), 1, atol=0.3)
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.4


def test_contact_is_first_judged_by_the_quiet_rows_of_each_state() -> None:
    truth = load_of(Truth())
    rows = rows_of(400, truth, seed=2, sigma=np.zeros(6))
    rng = np.random.default_rng(3)
    resting = np.arange(400) < 100
    noise = np.where(resting, 0.3, 1.0)[:, None] * SIGMA * rng.normal(size=(400, 6))
    noise[[150, 250, 50]] = np.outer([2.5, 5.5, 2.5], SIGMA)
    rows = replace(rows, wrench=rows.wrench + noise, speed_rad_s=np.where(resting, 0.0, 1.0))
    problem = Problem(rows, None, G, point_mass=False)
    assert np.flatnonzero(~_first_kept(problem, truth)).tolist() == [*range(48, 53), *range(248, 253)]
    pushed = replace(rows, wrench=rows.wrench + np.where(resting, 20.0, 0.0)[:, None] * SIGMA)
    assert not _first_kept(Problem(pushed, None, G, point_mass=False), truth)[:100].any()


def test_a_delay_is_found_roughly_beside_contact() -> None:
    truth = replace(load_of(Truth()), delay_s=0.03)
    rows = rows_of(150, truth)
    rows.wrench[:30] += 8.0
    assert rough_delay(rows, None, G) == pytest.approx(0.03, abs=2e-3)


@pytest.mark.slow
def test_a_walk_of_the_bias_is_found() -> None:
    rows = rows_of(400, load_of(Truth()), seed=5, turn_rad=0.6, sigma=4 * SIGMA)
    steps = np.random.default_rng(6).normal(size=(400, 6)) * np.sqrt(ROW_S)
    walk = np.cumsum(steps, axis=0) * np.repeat([0.3, 0.012], 3)
    found = fit_motion(replace(rows, wrench=rows.wrench + walk), None, G)
    assert 0.1 < found.components["walk_N"] < 0.5
    assert found.drift is not None
    change, sigma, course = found.drift.change, found.drift.sigma, found.drift.course
    assert course is not None
    np.testing.assert_allclose(course[-1] - course[0], change)
    assert (np.abs(change - walk[-1] + walk[0])[:3] < 4 * sigma[:3]).all()
    assert (sigma[:3] < 3 * 0.3 * np.sqrt(400 * ROW_S)).all()
    assert np.corrcoef(course[:, 2], walk[:, 2])[0, 1] > 0.9


SECONDS = 15.0


def test_bursts_of_noise_are_no_contact_and_a_touch_is() -> None:
    bursts = {(2.0 + 1.5 * k, 2.8 + 1.5 * k): np.array([0.4, -0.3, 0.2, 0.02, 0.01, 0.0]) * (-1) ** k for k in range(8)}
    touch = {(6.0, 6.5): np.array([0.0, 6.0, 0.0, 0.4, 0.0, 0.0])}
    wrench, poses = means_of(record(Truth(), sweep(SECONDS), SECONDS, 3, contacts={**bursts, **touch}))
    found = solve_motion(wrench, poses, guarded=True)
    assert found.motion is not None
    assert "mostly_contact" not in [one.code for one in found.findings]
    assert [round(one["t_s"]) for one in found.motion.contacts] == [6]
    assert found.motion.used_share > 0.7  # the filter of .9 s and the touch
    assert abs(found.mass_kg - Truth().mass_kg) < 0.01
