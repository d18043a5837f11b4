"""The published methods behind one shape."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import NotObservable, Parameters
from ftcalib.model import UP_IN_BASE, predict
from ftcalib.published import carlson
from ftcalib.published.methods import CARLSON, PUBLISHED, published
from ftcalib.published.yu import SPECIAL_R_flange_base

TRUTH = Parameters(
    Rotation.from_euler("zyx", [70, 15, 13], degrees=True).as_matrix(),
    np.array([0.0, 0.0, -12.0]),
    np.array([3.0, -1.0, 2.0]),
    np.array([0.01, -0.02, 0.08]),
    np.array([0.1, 0.2, -0.3]),
)
SPECIAL = np.swapaxes(SPECIAL_R_flange_base, 1, 2)
R_BASE_FLANGE = np.concatenate([SPECIAL, Rotation.random(6, rng=4).as_matrix()])


@pytest.mark.parametrize("method", PUBLISHED)
def test_every_published_method_is_exact_without_noise(method: str) -> None:
    R_base_flange = SPECIAL if method == "srom" else R_BASE_FLANGE
    estimate = published(
        method,
        R_base_flange,
        gravity_direction_base=-UP_IN_BASE,
        weight_N=12.0,
        R_flange_sensor=TRUTH.R_flange_sensor,
    )
    np.testing.assert_allclose(TRUTH.difference(estimate(predict(TRUTH, R_base_flange))), 0, atol=1e-9)


def test_methods_that_know_gravity_are_wrong_on_a_tilted_base_unless_configured() -> None:
    direction = np.array([0.1, 0.0, -1.0]) / np.sqrt(1.01)
    tilted = Parameters(
        TRUTH.R_flange_sensor, 12.0 * direction, TRUTH.force_bias_N, TRUTH.p_sensor_com_m, TRUTH.torque_bias_Nm
    )
    wrench = predict(tilted, R_BASE_FLANGE)
    for direction_given, limit in ((-UP_IN_BASE, None), (direction, 1e-9)):
        estimate = published("carlson-relaxation", R_BASE_FLANGE, gravity_direction_base=direction_given)
        error = np.abs(tilted.difference(estimate(wrench))).max()
        assert error > 0.05 if limit is None else error < limit


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


def test_the_printed_form_applies_the_cayley_transform_once() -> None:
    half = Parameters(np.diag([-1.0, -1.0, 1.0]), np.array([0, 0, -12.0]), *np.zeros((3, 3)))
    force_N = predict(half, R_BASE_FLANGE)[:, :3] + np.random.default_rng(0).normal(size=(len(R_BASE_FLANGE), 3))
    gravity_N = half.gravity_force_base_N
    once, best_of_four = (
        carlson.cayley(R_BASE_FLANGE, force_N, gravity_N, bias=False, as_published=one).R_flange_sensor
        for one in (True, False)
    )
    np.testing.assert_allclose(once, carlson.cayley_rotation(force_N, gravity_N @ R_BASE_FLANGE).T)
    assert np.abs(once - best_of_four).max() > 1e-3


@pytest.mark.parametrize("method", sorted({*PUBLISHED} - {*CARLSON}))
def test_other_methods_have_one_form(method: str) -> None:
    with pytest.raises(ValueError, match=f"{method} runs as published already"):
        published(method, R_BASE_FLANGE, gravity_direction_base=-UP_IN_BASE, as_published=True)
