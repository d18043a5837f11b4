"""The fast compensation gives what the model says, whatever the shape, the type and the memory order."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import DTypeLike
from scipy.spatial.transform import Rotation

from ftcalib import Parameters
from ftcalib.compensation import CHUNK_ROWS, Compensator
from ftcalib.model import Array, predict


def random_parameters(rng: np.random.Generator) -> Parameters:
    return Parameters(Rotation.random(rng=rng).as_matrix(), *rng.normal(size=(4, 3)))


def samples(n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    return rng.normal(size=(n, 6)), Rotation.random(n, rng=rng).as_matrix()


@given(st.integers(0, 2**32 - 1))
def test_one_sample_and_many_agree_with_the_model(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parameters = random_parameters(rng)
    wrench, R_base_flange = samples(5, rng)
    expected = wrench - predict(parameters, R_base_flange)
    compensator = Compensator(parameters)
    np.testing.assert_allclose(compensator.batch(wrench, R_base_flange), expected, atol=1e-13)
    np.testing.assert_allclose(compensator(wrench, R_base_flange), expected, atol=1e-13)
    for i in range(5):
        np.testing.assert_allclose(compensator.sample(wrench[i], R_base_flange[i]), expected[i], atol=1e-13)
        np.testing.assert_allclose(compensator(wrench[i], R_base_flange[i]), expected[i], atol=1e-13)
        by_hand = wrench[i] - compensator.matrix @ R_base_flange[i].ravel() - compensator.offset
        np.testing.assert_allclose(by_hand, expected[i], atol=1e-13)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rotations_of_scipy_count_as_their_matrices(dtype: DTypeLike) -> None:
    rng = np.random.default_rng(2)
    parameters, rotations = random_parameters(rng), Rotation.random(5, rng=rng)
    wrench = rng.normal(size=(5, 6))
    compensator, expected = Compensator(parameters, dtype), wrench - predict(parameters, rotations)
    assert compensator(wrench, rotations).dtype == dtype
    np.testing.assert_allclose(compensator(wrench, rotations), expected, atol=1e-5)
    np.testing.assert_allclose(compensator(wrench[0].tolist(), rotations[0]), expected[0], atol=1e-5)
    np.testing.assert_allclose(compensator(wrench, list(rotations)), expected, atol=1e-5)


def test_a_tool_hanging_still_leaves_nothing_and_a_push_is_left() -> None:
    down = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    parameters = Parameters(np.eye(3), np.array([0, 0, -9.80665]), np.zeros(3), np.array([0.1, 0, 0]), np.zeros(3))
    # 1 kg at +x of a sensor that looks down: +9.8 N along z, and the torque x cross z is -y.
    reading = np.array([0, 0, 9.80665, 0, -0.980665, 0])
    np.testing.assert_allclose(Compensator(parameters).sample(reading, down), 0, atol=1e-14)
    push = np.array([0, 0, -5.0, 0, 0, 0])
    np.testing.assert_allclose(Compensator(parameters).sample(reading + push, down), push, atol=1e-14)


@pytest.mark.parametrize("n", [0, 1, CHUNK_ROWS, CHUNK_ROWS + 1])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_every_row_is_written_to_the_buffer(n: int, dtype: type[np.float64 | np.float32]) -> None:
    rng = np.random.default_rng(n)
    parameters = random_parameters(rng)
    wrench, R_base_flange = samples(n, rng)
    out = np.full((n, 6), np.nan, dtype)
    returned = Compensator(parameters, dtype).batch(wrench, R_base_flange, out)
    assert returned is out
    expected = (wrench - predict(parameters, R_base_flange)).reshape(n, 6)
    np.testing.assert_allclose(out, expected, atol=1e-13 if dtype is np.float64 else 1e-5)


def test_the_wrench_can_be_overwritten_with_the_result() -> None:
    rng = np.random.default_rng(1)
    parameters = random_parameters(rng)
    wrench, R_base_flange = samples(CHUNK_ROWS + 7, rng)
    expected = wrench - predict(parameters, R_base_flange)
    compensator = Compensator(parameters)
    one = wrench[0].copy()
    assert compensator.sample(one, R_base_flange[0], one) is one
    np.testing.assert_allclose(one, expected[0], atol=1e-13)
    assert compensator.batch(wrench, R_base_flange, wrench) is wrench
    np.testing.assert_allclose(wrench, expected, atol=1e-13)


def test_the_input_is_not_changed_and_a_result_is_not_overwritten_by_the_next() -> None:
    rng = np.random.default_rng(2)
    compensator = Compensator(random_parameters(rng))
    wrench, R_base_flange = samples(2, rng)
    before = wrench.copy()
    first = compensator.sample(wrench[0], R_base_flange[0])
    kept = first.copy()
    compensator.sample(wrench[1], R_base_flange[1])
    compensator.batch(wrench, R_base_flange)
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(wrench, before)


def test_memory_order_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    parameters = random_parameters(rng)
    wrench, R_flange_base = samples(50, rng)
    R_base_flange = np.swapaxes(R_flange_base, 1, 2)  # a view that is not contiguous
    expected = wrench - predict(parameters, R_base_flange)
    compensator = Compensator(parameters)
    np.testing.assert_allclose(compensator.batch(np.asfortranarray(wrench), R_base_flange), expected, atol=1e-13)
    np.testing.assert_allclose(compensator.batch(wrench[::2], R_base_flange[::2]), expected[::2], atol=1e-13)
    out = np.empty((100, 6))[::2]
    np.testing.assert_allclose(compensator.batch(wrench, R_base_flange, out), expected, atol=1e-13)
    np.testing.assert_allclose(compensator.sample(wrench[0], R_base_flange[0]), expected[0], atol=1e-13)


def test_nan_never_turns_into_a_number() -> None:
    rng = np.random.default_rng(4)
    compensator = Compensator(random_parameters(rng))
    wrench, R_base_flange = samples(3, rng)
    wrench[1, 4] = np.nan
    assert np.isnan(compensator.sample(wrench[1], R_base_flange[1])).all()
    many = compensator.batch(wrench, R_base_flange)
    assert np.isnan(many[1, 4])
    assert np.isfinite(many[[0, 2]]).all()


def test_wrong_shapes_are_rejected() -> None:
    rng = np.random.default_rng(5)
    compensator = Compensator(random_parameters(rng))
    wrench, R = samples(4, rng)
    for bad_wrench, bad_R in ((wrench, R[0]), (wrench[0], R), (wrench[:, :3], R), (wrench[:3], R), (wrench[None], R)):
        with pytest.raises(ValueError, match="expected \\(6,\\) with \\(3, 3\\)"):
            compensator(bad_wrench, bad_R)
        with pytest.raises(ValueError, match=r"expected|broadcast"):
            compensator.sample(bad_wrench, bad_R)
        with pytest.raises(ValueError, match="expected"):
            compensator.batch(bad_wrench, bad_R)
    with pytest.raises(ValueError, match="use `sample` for a single wrench"):
        compensator.batch(wrench[0], R[0])
    with pytest.raises(ValueError, match=r"out .*\(3, 6\).*\(4, 6\)"):
        compensator.batch(wrench, R, np.empty((3, 6)))
    with pytest.raises(ValueError, match="out is float32"):
        compensator.batch(wrench, R, np.empty((4, 6), np.float32))
    with pytest.raises(ValueError, match="output array"):
        compensator.sample(wrench[0], R[0], np.empty(5))
    with pytest.raises(TypeError, match="dtype is float16"):
        Compensator(random_parameters(rng), np.float16)
