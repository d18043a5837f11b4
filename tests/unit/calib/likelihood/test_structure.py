"""Errors that have a structure: their columns, and sigmas that hold where they act."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib.likelihood.fit import Fit, fit
from ftcalib.likelihood.structure import MOST_POSES, structure_columns
from ftcalib.model import Array, Parameters, gravity_wrench, jacobian, predict

TOOL = Parameters(
    R_flange_sensor=Rotation.from_rotvec([0.02, -0.03, 0.8]).as_matrix(),
    gravity_force_base_N=np.array([0.3, -0.2, -15.0]),
    force_bias_N=np.array([3.0, -4.0, 5.0]),
    p_sensor_com_m=np.array([0.01, -0.02, 0.08]),
    torque_bias_Nm=np.array([0.2, 0.1, -0.3]),
)
SIGMA = np.repeat([0.01, 4e-4], 3)
R24 = np.asarray(Rotation.random(24, rng=np.random.default_rng(3)).as_matrix())


def off(best: Fit) -> Array:
    """Errors of the parameters (15,) in sigmas."""
    return np.asarray(TOOL.difference(best.parameters) / np.sqrt(np.diag(best.covariance)))


def test_a_load_that_is_half_as_large_bends_a_quarter_or_an_eighth() -> None:
    half = Parameters(
        TOOL.R_flange_sensor, TOOL.gravity_force_base_N / 2, TOOL.force_bias_N, TOOL.p_sensor_com_m, TOOL.torque_bias_Nm
    )
    whole, part = (structure_columns(p, R24, np.eye(3))["load"] for p in (TOOL, half))
    assert whole.shape == (24, 6, 54)
    # Relative to the weight the columns depend on its direction alone.
    np.testing.assert_allclose(part, whole / 2, atol=1e-12)
    u = gravity_wrench(TOOL, R24)[:, :3] / TOOL.weight_N
    square = whole[:, 0, :6] / (TOOL.weight_N / np.sqrt(2))
    np.testing.assert_allclose(np.sum(square**2, axis=1), np.sum(u**2, axis=1) ** 2)


def test_what_cable_and_arm_do_in_the_middle_is_part_of_bias_and_mounting() -> None:
    columns = structure_columns(TOOL, R24, R24.mean(axis=0))
    np.testing.assert_allclose(columns["cable"].sum(axis=0), 0, atol=1e-12)
    turn = jacobian(TOOL, R24)[..., :3]
    away = (R24 - R24.mean(axis=0)).reshape(24, 9) / np.sqrt(3)
    coefficients = np.arange(27.0)
    error_rad = away @ coefficients.reshape(3, 9).T  # of each pose
    expected = np.einsum("nck,nk->nc", turn, error_rad)
    np.testing.assert_allclose(columns["kinematics"] @ coefficients, expected, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["load", "cable"])
def test_sigmas_hold_where_an_error_has_a_structure(kind: str) -> None:
    squares = []
    for seed in range(3):
        rng = np.random.default_rng([seed, 5])
        columns = structure_columns(TOOL, R24, R24.mean(axis=0))[kind]
        size = 0.005 if kind == "load" else np.repeat([0.08, 0.02], 3)[:, None]
        true = (columns * size) @ rng.normal(size=columns.shape[2])
        best = fit(R24, predict(TOOL, R24) + true + SIGMA * rng.normal(size=(24, 6)), np.diag(SIGMA**2))
        assert any(name.startswith(kind) for name in best.components)
        squares.append(np.square(off(best)))
    assert 0.3 < np.mean(squares) < 2.0  # taken for white noise: up to 20
    assert np.mean(np.array(squares) < 4) > 0.85


def test_many_poses_have_no_such_columns() -> None:
    rng = np.random.default_rng(9)
    R = np.asarray(Rotation.random(MOST_POSES + 1, rng=rng).as_matrix())
    best = fit(R, predict(TOOL, R) + SIGMA * rng.normal(size=(MOST_POSES + 1, 6)), np.diag(SIGMA**2))
    assert not {"kinematics", "load", "cable"} & {name.partition("_")[0] for name in best.components}
    np.testing.assert_array_equal(best.elsewhere, 0)
