"""Carlson's methods against simulated poses."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib.errors import BadDataset, NotObservable
from ftcalib.model import Array
from ftcalib.published import carlson
from ftcalib.published.carlson import (
    ForceFit,
    cayley,
    eigen,
    iterative,
    nullspace,
    polynomial,
    relaxation,
)

Method = Callable[[Array, Array, Array, bool], ForceFit]


UNKNOWN: dict[str, Method] = {
    "eigen": lambda R, f, _, bias: eigen(R, f, bias=bias),
    "nullspace": lambda R, f, _, bias: nullspace(R, f, bias=bias),
    "iterative": lambda R, f, _, bias: iterative(R, f, bias=bias),
    "polynomial": lambda R, f, _, bias: polynomial(R, f, bias=bias),
}
DIRECTION: dict[str, Method] = {"relaxation": lambda R, f, g, bias: relaxation(R, f, g, bias=bias)}
WEIGHT: dict[str, Method] = {"cayley": lambda R, f, g, bias: cayley(R, f, g, bias=bias)}
METHODS = UNKNOWN | DIRECTION | WEIGHT
MIN_POSES = dict.fromkeys(UNKNOWN, 4) | {"polynomial": 3, "relaxation": 3} | dict.fromkeys(WEIGHT, 2)

SROM24 = np.array(
    [
        M
        for order in permutations(np.eye(3))
        for s in product((1, -1), repeat=3)
        if np.linalg.det(M := np.array(order).T * s) > 0
    ]
)
DOWN = Rotation.from_rotvec([np.pi, 0, 0])
MOUNTS = {
    "plain": np.eye(3),
    "turned by 180 deg": np.diag([-1.0, -1.0, 1.0]),
    "axes permuted": np.eye(3)[[1, 2, 0]],
    "anyhow": Rotation.from_rotvec([0.3, -1.9, 0.8]).as_matrix(),
}


@dataclass
class Truth:
    R_flange_sensor: Array
    gravity_force_base_N: Array
    force_bias_N: Array

    def force_N(self, R_base_flange: Array, sigma_N: float = 0, seed: int = 0) -> Array:
        clean = self.gravity_force_base_N @ R_base_flange @ self.R_flange_sensor + self.force_bias_N
        return clean + sigma_N * np.random.default_rng(seed).normal(size=clean.shape)


def random_truth(rng: np.random.Generator, bias_N: float = 0, weight_N: float = 20) -> Truth:
    gravity, bias = (
        length * v / np.linalg.norm(v) for length, v in zip((weight_N, bias_N), rng.normal(size=(2, 3)), strict=True)
    )
    return Truth(Rotation.random(rng=rng).as_matrix(), gravity, bias)


def random_poses(rng: np.random.Generator, n: int) -> Array:
    return Rotation.random(n, rng=rng).as_matrix()


def ball(rng: np.random.Generator, n: int, angle_deg: float) -> Array:
    """Tool down, turned by up to an angle about any axis."""
    v = rng.normal(size=(n, 3))
    v *= (np.radians(angle_deg) * rng.uniform(size=n) ** (1 / 3) / np.linalg.norm(v, axis=1))[:, None]
    return (Rotation.from_rotvec(v) * DOWN).as_matrix()


def rim(rng: np.random.Generator, n: int, tilt_deg: float) -> Array:
    """Tool tilted by one and the same angle in all directions, wrist anywhere."""
    heading, wrist = rng.uniform(0, 2 * np.pi, size=(2, n))
    tilt = np.radians(tilt_deg) * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(n)])
    return (Rotation.from_rotvec(tilt) * DOWN * Rotation.from_rotvec(np.outer(wrist, [0, 0, 1]))).as_matrix()


def apart_deg(R: Array, S: Array) -> float:
    return float(np.degrees(2 * np.arcsin(min(np.linalg.norm(R - S) / np.sqrt(8), 1))))


def error_deg(fit: ForceFit, truth: Truth) -> float:
    return apart_deg(fit.R_flange_sensor, truth.R_flange_sensor)


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def assert_equal(fit: ForceFit, R: Array, gravity: Array, bias: Array, tolerance: float) -> None:
    size = np.linalg.norm(gravity)
    assert np.linalg.norm(fit.R_flange_sensor - R) < tolerance
    assert np.linalg.norm(fit.gravity_force_base_N - gravity) < tolerance * size
    assert np.linalg.norm(fit.force_bias_N - bias) < tolerance * (size + np.linalg.norm(bias))


# --- exact without noise ---


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("name", METHODS)
def test_exact_with_the_fewest_poses_and_one_less_is_rejected(name: str, bias: bool) -> None:
    rng = np.random.default_rng(1)
    n = MIN_POSES[name] + bias
    for _ in range(5):
        truth = random_truth(rng, 5 * bias)
        R = random_poses(rng, n)
        fit = METHODS[name](R, truth.force_N(R), truth.gravity_force_base_N, bias)
        assert_equal(fit, truth.R_flange_sensor, truth.gravity_force_base_N, truth.force_bias_N, 1e-10)
    with pytest.raises(NotObservable, match=f"needs {n} poses or more, got {n - 1}: record 1 more"):
        METHODS[name](R[1:], truth.force_N(R[1:]), truth.gravity_force_base_N, bias)


# --- what a bias does ---


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_the_original_form_hides_a_bias_in_the_rotation_and_the_other_finds_it(name: str) -> None:
    errors: dict[tuple[float, bool], list[float]] = {(bias_N, bias): [] for bias_N in (0, 1) for bias in (False, True)}
    rng = np.random.default_rng(2)
    for trial in range(10):
        R = random_poses(rng, 24)
        for (bias_N, bias), found in errors.items():
            truth = random_truth(rng, bias_N)
            force_N = truth.force_N(R, 0.05, seed=trial)
            fit = METHODS[name](R, force_N, truth.gravity_force_base_N, bias)
            found.append(error_deg(fit, truth))
            if bias:
                assert np.linalg.norm(fit.force_bias_N - truth.force_bias_N) < 0.08
    assert 0.04 < rms(errors[0, False]) < 0.09
    assert 0.55 < rms(errors[1, False]) < 0.95
    assert rms(errors[1, True]) == pytest.approx(rms(errors[0, True]), abs=0.02)
    assert rms(errors[1, True]) < 0.1


# --- invariances, with noise ---


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("name", METHODS)
def test_follows_the_frames_the_unit_and_the_order(name: str, bias: bool) -> None:
    rng = np.random.default_rng(4)
    truth, R = random_truth(rng, 3 * bias), random_poses(rng, 12)
    force_N = truth.force_N(R, 0.3)
    turn_base, turn_flange, turn_sensor = Rotation.random(3, rng=rng).as_matrix()
    if name in WEIGHT:  # the Cayley transform favours small rotations: not invariant to where they are counted from
        turn_flange = turn_sensor = np.eye(3)
    order = rng.permutation(12)
    one = METHODS[name](R, force_N, truth.gravity_force_base_N, bias)
    two = METHODS[name](
        (turn_base @ R @ turn_flange.T)[order],
        2.5 * (force_N @ turn_sensor.T)[order],
        2.5 * turn_base @ truth.gravity_force_base_N,
        bias,
    )
    assert_equal(
        two,
        turn_flange @ one.R_flange_sensor @ turn_sensor.T,
        2.5 * turn_base @ one.gravity_force_base_N,
        2.5 * turn_sensor @ one.force_bias_N,
        1e-8,
    )


# --- nullspace and eigendecomposition ---


# --- algorithm 1 ---


# --- the polynomial problem ---


@pytest.mark.parametrize("sigma_N", [0, 0.05])
def test_polynomial_rejects_one_tilt_only_because_gravity_may_be_up_or_down(sigma_N: float) -> None:
    R = rim(np.random.default_rng(13), 12, 40)
    truth = Truth(MOUNTS["anyhow"], np.array([0, 0, -20.0]), np.ones(3))
    with pytest.raises(NotObservable, match="180 deg"):
        polynomial(R, truth.force_N(R, sigma_N), bias=True)
    assert (
        error_deg(polynomial(R, truth.force_N(R, sigma_N), bias=False), truth) > 1
    )  # a bias of 1 N is not for this form
    clean = Truth(truth.R_flange_sensor, truth.gravity_force_base_N, np.zeros(3))
    assert error_deg(polynomial(R, clean.force_N(R, sigma_N), bias=False), clean) < 0.5


# --- known gravity ---


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("name", DIRECTION | WEIGHT)
def test_known_gravity_rejects_forces_that_point_up(name: str, bias: bool) -> None:
    rng = np.random.default_rng(17)
    for R in (random_poses(rng, 12), ball(rng, 12, 60)):
        truth = random_truth(rng)
        with pytest.raises(BadDataset, match="against the given gravity"):
            METHODS[name](R, -truth.force_N(R, 0.1), truth.gravity_force_base_N, bias)


def test_a_direction_has_a_length() -> None:
    for method in (relaxation, cayley):
        with pytest.raises(ValueError, match="length"):
            method(SROM24, np.ones((24, 3)), np.zeros(3), bias=True)


# --- degenerate poses ---

TURN = np.linspace(0, 5, 24)
START = Rotation.from_rotvec([0.4, 2.0, -0.7])
DEGENERATE = {
    "one oblique base axis": (Rotation.from_rotvec(np.outer(TURN, [0.5, 0.6, 0.7])) * START).as_matrix(),
    "about the vertical": (Rotation.from_rotvec(np.outer(TURN, [0, 0, 1])) * START).as_matrix(),
    "wrist yaw": (START * Rotation.from_rotvec(np.outer(TURN, [0, 0, 1]))).as_matrix(),
    "two poses": np.repeat(SROM24[[0, 9]], 12, axis=0),
}


@pytest.mark.parametrize("poses", DEGENERATE)
@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("name", UNKNOWN)
def test_rejects_poses_that_leave_gravity_open(
    name: str, bias: bool, poses: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(carlson, "MOST_ITERATIONS", 300)  # the iterative method never rests here, with noise
    truth = Truth(MOUNTS["anyhow"], np.array([0, 0, -20.0]), bias * np.array([1.0, 2, -30]))
    with pytest.raises(NotObservable, match="add poses"):
        METHODS[name](DEGENERATE[poses], truth.force_N(DEGENERATE[poses], 0.05), np.zeros(3), bias)


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("name", DIRECTION | WEIGHT)
def test_known_gravity_needs_a_change_of_tilt(name: str, bias: bool) -> None:
    R = DEGENERATE["about the vertical"]
    truth = Truth(MOUNTS["anyhow"], np.array([0, 0, -20.0]), bias * np.array([1.0, 2, -30]))
    with pytest.raises(NotObservable, match="tilt the tool"):
        METHODS[name](R, truth.force_N(R, 0.05), truth.gravity_force_base_N, bias)


@pytest.mark.parametrize("name", ["eigen", "nullspace", "iterative", "relaxation"])
def test_relaxed_methods_reject_one_tilt_only_with_bias(name: str) -> None:
    R = rim(np.random.default_rng(18), 12, 40)
    truth = Truth(MOUNTS["anyhow"], np.array([0, 0, -20.0]), np.zeros(3))
    with pytest.raises(NotObservable, match="only 2"):
        METHODS[name](R, truth.force_N(R), truth.gravity_force_base_N, True)
    assert error_deg(METHODS[name](R, truth.force_N(R), truth.gravity_force_base_N, False), truth) < 1e-9


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("name", METHODS)
def test_rejects_a_sensor_that_carries_nothing(name: str, bias: bool) -> None:
    with pytest.raises(NotObservable, match="no weight"):
        METHODS[name](SROM24, np.full((24, 3), 7.0 * bias), np.array([0, 0, -1.0]), bias)


# --- input ---


@pytest.mark.parametrize("name", METHODS)
def test_names_the_row_that_is_not_finite(name: str) -> None:
    force_N = np.ones((24, 3))
    force_N[5, 2] = np.nan
    with pytest.raises(BadDataset, match="row 5"):
        METHODS[name](SROM24, force_N, np.array([0, 0, -1.0]), True)


def test_names_the_shapes() -> None:
    with pytest.raises(ValueError, match=r"\(24, 3, 3\).*\(23, 3\)"):
        nullspace(SROM24, np.ones((23, 3)), bias=True)
