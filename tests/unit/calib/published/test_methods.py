"""The published methods behind one shape."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import NotObservable, Parameters
from ftcalib.model import UP_IN_BASE, Array, SPECIAL_R_flange_base, predict
from ftcalib.published.methods import BASELINES, CARLSON, PUBLISHED, published, vougioukas, wang, yang

TRUTH = Parameters(
    Rotation.from_euler("zyx", [70, 15, 13], degrees=True).as_matrix(),
    np.array([0.0, 0.0, -12.0]),
    np.array([3.0, -1.0, 2.0]),
    np.array([0.01, -0.02, 0.08]),
    np.array([0.1, 0.2, -0.3]),
)
SPECIAL = np.swapaxes(SPECIAL_R_flange_base, 1, 2)
R_BASE_FLANGE = np.concatenate([SPECIAL, Rotation.random(6, rng=4).as_matrix()])


def test_cayley_asks_for_the_mass() -> None:
    with pytest.raises(NotObservable, match="mass"):
        published("carlson-cayley", R_BASE_FLANGE, gravity_direction_base=-UP_IN_BASE)


@pytest.mark.parametrize("method", CARLSON)
def test_carlsons_printed_form_is_exact_without_biases_and_only_then(method: str) -> None:
    zero = np.zeros(3)
    no_bias = Parameters(TRUTH.R_flange_sensor, TRUTH.gravity_force_base_N, zero, TRUTH.p_sensor_com_m, zero)
    given = {"gravity_direction_base": -UP_IN_BASE, "weight_N": 12.0}
    estimate = published(method, R_BASE_FLANGE, **given, as_published=True)  # type: ignore[arg-type]  # of two types
    np.testing.assert_allclose(no_bias.difference(estimate(predict(no_bias, R_BASE_FLANGE))), 0, atol=1e-9)
    biased = estimate(predict(TRUTH, R_BASE_FLANGE))
    np.testing.assert_array_equal([biased.force_bias_N, biased.torque_bias_Nm], 0)
    assert np.abs(TRUTH.difference(biased))[:3].max() > 1e-3


@pytest.mark.parametrize("method", sorted({*PUBLISHED} - {*CARLSON}))
def test_other_methods_have_one_form(method: str) -> None:
    with pytest.raises(ValueError, match=f"{method} runs as published already"):
        published(method, R_BASE_FLANGE, gravity_direction_base=-UP_IN_BASE, as_published=True)


R24 = np.swapaxes(SPECIAL_R_flange_base, 1, 2)
DOWN = np.array([0.0, 0.0, -1.0])


def turned(*rotation_vector_deg: float) -> Array:
    return np.asarray(Rotation.from_rotvec(rotation_vector_deg, degrees=True).as_matrix())


@pytest.mark.parametrize(
    ("method", "turn", "lean", "axis_rms_N"),
    [
        ("vougioukas", (0, 0, 5), 0, 0.82),
        ("wang", (0, 0, 5), 0, 0.82),
        ("yang", (0, 0, 5), 0, 0),
        ("vougioukas", (2, 0, 0), 0, 0.33),
        ("wang", (2, 0, 0), 0, 0.33),
        ("yang", (2, 0, 0), 0, 0.33),
        ("vougioukas", (0, 0, 0), 2, 0.40),
        ("wang", (0, 0, 0), 2, 0),
        ("yang", (0, 0, 0), 2, 0),
    ],
)
def test_a_wrong_assumption_costs_what_the_docstring_says(
    method: str, turn: tuple[float, float, float], lean: float, axis_rms_N: float
) -> None:
    truth = Parameters(turned(*turn), turned(lean, 0, 0) @ [0, 0, -20.0], *np.full((3, 3), 0.1))
    estimate = published(method, R24, gravity_direction_base=DOWN)(predict(truth, R24))
    R = Rotation.random(1000, rng=1).as_matrix()
    error_N = (predict(estimate, R) - predict(truth, R))[:, :3]
    assert np.sqrt(np.mean(error_N**2)) == pytest.approx(axis_rms_N, rel=0.06, abs=1e-9)


def rim(n: int, tilt_deg: float) -> Array:
    """Tool tilted by one angle in n directions, and turned."""
    return np.array([turned(0, 0, 360 * k / n) @ turned(tilt_deg, 0, 0) @ turned(0, 0, 70.0 * k) for k in range(n)])


ESTIMATES: dict[str, Callable[[Array, Array], object]] = {
    "vougioukas": partial(vougioukas, R_flange_sensor=np.eye(3), gravity_direction_base=DOWN),
    "wang": lambda R, wrench: wang(R, wrench[:, :3], R_flange_sensor=np.eye(3)),
    "yang": lambda R, wrench: yang(R, wrench[:, :3], R_flange_sensor=np.eye(3)),
}
SPIN = np.array([turned(0, 0, 40.0 * k) for k in range(6)])
PLANE = np.array([turned(40.0 * k, 0, 0) for k in range(6)])


@pytest.mark.parametrize(
    ("method", "R", "words"),
    [
        *((method, R24[:2], "needs 3 poses or more, got 2: record 1 more") for method in BASELINES),
        ("vougioukas", SPIN, "only 0 of the 2 flange axes needed: add poses"),
        ("wang", SPIN, "turn about one base axis.*: add poses"),
        ("wang", PLANE, "turn about one base axis.*: add poses"),
        ("yang", PLANE, "turn about one base axis.*: add poses"),
        ("yang", rim(8, 40), "two yaws of the sensor 180 deg apart .*: add poses"),
    ],
)
def test_poses_that_do_not_suffice_are_refused(method: str, R: Array, words: str) -> None:
    truth = Parameters(np.eye(3), 20 * DOWN, *np.ones((3, 3)))
    with pytest.raises(NotObservable, match=words):
        ESTIMATES[method](R, predict(truth, R))


def test_yang_is_refused_where_noise_alone_decides_between_two_yaws() -> None:
    R, rng = rim(8, 40), np.random.default_rng(2)
    force_N = predict(Parameters(np.eye(3), 20 * DOWN, *np.ones((3, 3))), R)[:, :3]
    for _ in range(5):
        with pytest.raises(NotObservable, match="two yaws of the sensor"):
            yang(R, force_N + rng.normal(0.0, 0.1, force_N.shape), R_flange_sensor=np.eye(3))


def test_yang_is_refused_if_the_forces_show_no_yaw() -> None:
    along_z = predict(Parameters(np.eye(3), 20 * DOWN, *np.ones((3, 3))), R24)[:, :3] * [0, 0, 1]
    with pytest.raises(NotObservable, match="do not determine the yaw of the sensor"):
        yang(R24, along_z, R_flange_sensor=np.eye(3))


@pytest.mark.parametrize("method", BASELINES)
def test_a_sensor_that_carries_nothing_is_refused(method: str) -> None:
    with pytest.raises(NotObservable, match="no weight"):
        ESTIMATES[method](R24, np.ones((24, 6)))
