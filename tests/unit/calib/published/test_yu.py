"""Yu's closed forms: the 24 orientations and their recognition."""

import re

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import NotObservable, Parameters
from ftcalib.model import Array, SPECIAL_R_flange_base, predict
from ftcalib.published.yu import _SUMS, lrom, mixed, special_numbers, srom, srom_gravity_force
from tests.known_cells import UPSIDE_DOWN as TRUTH

R24 = np.swapaxes(SPECIAL_R_flange_base, 1, 2)


def turned(axis: str, angle_deg: float | list[float]) -> Array:
    return np.asarray(Rotation.from_euler(axis, angle_deg, degrees=True).as_matrix())


def error(estimate: Parameters) -> float:
    return float(np.abs(TRUTH.difference(estimate)).max())


def test_the_24_are_the_rotations_of_the_cube_in_the_papers_order() -> None:
    np.testing.assert_array_equal(SPECIAL_R_flange_base[10], [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(np.linalg.det(SPECIAL_R_flange_base), 1)
    assert len({R.tobytes() for R in SPECIAL_R_flange_base + 0.0}) == 24
    np.testing.assert_array_equal(SPECIAL_R_flange_base.sum(axis=0), 0)


def test_every_sum_leaves_one_entry_of_the_orientations() -> None:
    """Eqs 15-23: of p_kj, 4 e_j e_k^T from the forces that are added, and its negative from those subtracted."""
    for k, sums in enumerate(_SUMS):
        for j, both in enumerate(sums):
            for numbers, sign in zip(both, (4, -4), strict=True):
                entry = np.zeros((3, 3))
                entry[j, k] = sign
                np.testing.assert_array_equal(SPECIAL_R_flange_base[np.array(numbers) - 1].sum(axis=0), entry)


@pytest.mark.parametrize("Y", [np.eye(3), turned("z", 45), turned("ZYX", [10, 20, 30])])
def test_srom_works_when_all_orientations_are_turned_by_a_common_rotation(Y: Array) -> None:
    rng = np.random.default_rng(1)
    order = rng.permutation(24)
    R = (Y @ R24)[order]
    number, found = special_numbers(R)
    np.testing.assert_allclose(found @ R24[number], R, atol=1e-12)
    for _ in range(5):  # the same choice in every order, also where 24 equivalents tie but for rounding
        rounded = Rotation.from_rotvec(1e-7 * rng.normal(size=(24, 3))).as_matrix() @ Y @ R24
        np.testing.assert_allclose(special_numbers(rounded[rng.permutation(24)])[1], found, atol=1e-6)
    assert error(srom(R, predict(TRUTH, R))) < 1e-12


def deviating(rng: np.random.Generator, n: int, most_deg: float) -> Array:
    """(n, 3, 3) small turns about random axes, by up to an angle."""
    axis = rng.normal(size=(n, 3))
    angle = np.deg2rad(most_deg) * rng.uniform(size=(n, 1))
    return np.asarray(Rotation.from_rotvec(angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)).as_matrix())


def is_numbered(R: Array, number: NDArray[np.intp], Y: Array, expected: NDArray[np.intp]) -> bool:
    """Whether the numbers are the expected ones, up to a rotation of the cube that Y takes up."""
    special = expected >= 0
    nominal = Y @ R24[number[special]]
    fits = Rotation.from_matrix(nominal @ np.swapaxes(R[special], 1, 2)).magnitude().max() < np.deg2rad(1.5)
    return bool(fits) and ((number >= 0) == special).all()


def test_deviations_up_to_1_degree_are_recognised_for_any_turn_of_the_base() -> None:
    rng = np.random.default_rng(3)
    for Y in Rotation.random(20, rng=rng).as_matrix():
        order = rng.permutation(24)
        R = (deviating(rng, 24, 1.0) @ Y @ R24)[order]
        number, found = special_numbers(R)
        assert is_numbered(R, number, found, order)
        assert np.unique(number).size == 24
        R[3] = turned("y", 1.5) @ Y @ R24[order[3]]
        others = np.arange(24) != 3
        R[others] = (Y @ R24)[order[others]]
        with pytest.raises(NotObservable, match=r"row 4 is 1\.50° from"):
            special_numbers(R)


@pytest.mark.parametrize("Y", [np.eye(3), turned("ZYX", [10, 20, 30])])
def test_mixed_finds_its_24_among_other_poses(Y: Array) -> None:
    rng = np.random.default_rng(5)
    for numbers in (np.r_[:24, [-1] * 24], np.r_[:24, :24], np.r_[:24, 3, 3, [-1] * 100]):
        expected = rng.permutation(numbers)
        any_pose = Rotation.random(len(expected), rng=rng).as_matrix()
        R = np.where((expected >= 0)[:, None, None], Y @ R24[expected], any_pose)
        number, found = special_numbers(R, others=True)
        assert is_numbered(R, number, found, expected)
        assert error(mixed(R, predict(TRUTH, R))) < 1e-12


def test_mixed_takes_the_gravity_force_from_the_24_and_the_rest_from_all_poses() -> None:
    rng = np.random.default_rng(6)
    R = np.concatenate([R24, Rotation.random(24, rng=rng).as_matrix()])
    wrench = predict(TRUTH, R) + 0.1 * rng.normal(size=(48, 6))
    alone, together = srom(R24, wrench[:24]), mixed(R, wrench)
    np.testing.assert_allclose(together.gravity_force_base_N, alone.gravity_force_base_N, atol=1e-12)
    assert np.abs(together.difference(alone))[[0, 6, 9, 12]].min() > 1e-6
    twice = np.concatenate([wrench[:24], wrench[:24] + np.array([0.2, 0, 0, 0, 0, 0])])
    averaged = mixed(np.tile(R24, (2, 1, 1)), twice)
    np.testing.assert_allclose(averaged.gravity_force_base_N, alone.gravity_force_base_N, atol=1e-12)
    np.testing.assert_allclose(averaged.force_bias_N, alone.force_bias_N + np.array([0.1, 0, 0]), atol=1e-12)


@pytest.mark.parametrize("Y", [np.eye(3), turned("ZYX", [10, 20, 30])])
def test_mixed_takes_no_other_pose_for_a_repetition_that_only_lies_near(Y: Array) -> None:
    near = turned("x", 0.6) @ Y @ R24[[3]], turned("y", 1.2) @ Y @ R24[[7]]
    R = np.concatenate([Y @ R24, *near, turned("z", 0.01) @ Y @ R24[[9]]])
    number, found = special_numbers(R, others=True)
    assert number.tolist() == [*range(24), -1, -1, 9]
    np.testing.assert_allclose(found, Y, atol=1e-5)
    exact = R[:26]
    assert error(mixed(exact, predict(TRUTH, exact))) < 1e-12


def test_mixed_names_what_is_missing() -> None:
    R = np.concatenate([np.delete(R24, [2, 16], axis=0), R24[:5:3], turned("x", 3) @ R24[16:17]])
    with pytest.raises(NotObservable, match=r"missing 3, 17 \(row 25 is 3\.00° from orientation 17.*Record these"):
        mixed(R, np.zeros((len(R), 6)))
    with pytest.raises(NotObservable, match="missing 1, 2, 3"):
        mixed(R[:0], np.zeros((0, 6)))


def test_srom_names_what_is_missing_repeated_or_off() -> None:
    def refusal(R: Array) -> str:
        with pytest.raises(NotObservable) as caught:
            srom(R, np.zeros((len(R), 6)))
        return str(caught.value)

    assert "missing 3, 17. Use LROM or ML" in refusal(np.delete(R24, [2, 16], axis=0))
    assert "missing 1, 2, 3, 4, 5, 6 and 2 more." in refusal(R24[8:])
    assert "missing 5; repeated 9." in refusal(np.concatenate([np.delete(R24, 4, axis=0), R24[8:9]]))
    assert "each: repeated 1. Use mixed" in refusal(np.concatenate([R24, R24[:1]]))
    assert "25 not among them" in (extra := refusal(np.concatenate([R24, turned("ZYX", [10, 20, 30])[None]])))
    assert "Use mixed, which accepts additional poses" in extra
    bent = R24.copy()
    bent[6] = turned("y", 2.0) @ bent[6]
    assert re.search(r"missing 7; .*row 7 is 2\.00° from orientation 7", refusal(bent))
    assert "missing 3, 17." in refusal(turned("z", 5) @ np.delete(R24, [2, 16], axis=0))
    scattered = Rotation.random(24, rng=np.random.default_rng(0)).as_matrix()
    assert "use LROM" in refusal(scattered).replace("Use", "use")
    assert "no pose has one of them" in refusal(R24[:0])


def test_srom_gravity_force_has_the_sign_of_every_component() -> None:
    for F_b in ([1.0, 3.0, -40.0], [-5.0, 0.5, 2.0], [0.0, 0.0, 10.0]):
        force_N = (TRUTH.R_flange_sensor.T @ SPECIAL_R_flange_base @ F_b) + [63, 5, 21]
        np.testing.assert_allclose(srom_gravity_force(force_N), F_b, atol=1e-12)


def test_lrom_rejects_four_poses_and_poses_with_several_solutions() -> None:
    R = Rotation.random(4, rng=np.random.default_rng(0)).as_matrix()
    with pytest.raises(NotObservable, match=r"5 poses.* 4"):
        lrom(R, predict(TRUTH, R))
    spin = Rotation.from_euler("x", np.arange(8)[:, None] * 40.0, degrees=True).as_matrix()
    with pytest.raises(NotObservable, match="several solutions"):
        lrom(spin, predict(TRUTH, spin))
