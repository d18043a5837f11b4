"""The columns of Yu's Table III, and its eleven cases."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ftcalib import CalibrationDataset, solve
from ftcalib.compare import CASES, compare, table_iii
from ftcalib.errors import NotObservable
from ftcalib.model import Parameters, predict
from ftcalib.poses.selection import EVERY_SET, paper_set, set_numbers

TRUTH = Parameters(
    np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([0.3, -0.5, -19.7]),
    np.array([3.0, -5.9, -1.0]),
    np.array([0.002, -0.004, 0.08]),
    np.array([-0.07, -0.05, 0.02]),
)
HEAVIER = replace(
    TRUTH, gravity_force_base_N=1.02 * TRUTH.gravity_force_base_N, p_sensor_com_m=1.5 * TRUTH.p_sensor_com_m
)
NAMES = EVERY_SET.split("+")
NUMBERS = np.concatenate([set_numbers(name) for name in NAMES])
POSES = np.concatenate([paper_set(name) for name in NAMES])


@pytest.fixture(autouse=True)
def few_simulations(monkeypatch: pytest.MonkeyPatch) -> None:
    """No column has the sigmas of closed forms, which are simulated."""
    monkeypatch.setattr("ftcalib.solver.SIMULATIONS", 2)


def measured(sigma_N: float, R: np.ndarray = POSES) -> CalibrationDataset:
    noise = np.random.default_rng(3).normal(0.0, sigma_N, (len(R), 6)) * [1, 1, 1, 0.025, 0.025, 0.025]
    return CalibrationDataset.of(R, predict(TRUTH, R) + noise)


def test_all_cases_are_exact_without_noise_in_any_order_of_the_poses() -> None:
    order = np.random.default_rng(0).permutation(len(POSES))
    cases = table_iii(measured(0.0, POSES[order]), NUMBERS[order].tolist(), TRUTH)
    assert [(number, one.method, data, test) for number, data, test, one in cases] == list(CASES)
    for *_, one in cases:
        assert one.largest_errors is not None
        assert one.largest_errors.max() < 1e-9
        assert max(one.mass_error, one.centre_error) < 1e-10


def test_the_columns_are_the_largest_of_each_axis_and_of_the_norm(monkeypatch: pytest.MonkeyPatch) -> None:
    bumped = measured(0.0, paper_set("D"))
    wrench = bumped.wrench.copy()
    wrench[7] += [3.0, 4.0, 0.0, 0.0, 0.0, -0.2]
    wrench[9] += [0.0, -4.5, 0.0, 0.1, 0.0, 0.0]
    test = CalibrationDataset.of(bumped.R_base_flange, wrench)
    monkeypatch.setattr("ftcalib.compare.get_args", lambda _: ["srom"])
    (one,) = compare(measured(0.0, paper_set("A")), test=test, truth=HEAVIER)
    assert one.largest_errors is not None
    np.testing.assert_allclose(one.largest_errors, [3.0, 4.5, 0.0, 5.0, 0.1, 0.0, 0.2, 0.2], atol=1e-9)
    document = one.to_dict()["test"]
    assert document["largest"]["force_N"] == pytest.approx(5.0)
    assert document["mass_error"] == pytest.approx(0.02 / 1.02)


def test_errors_of_weight_and_centre_are_shares_of_the_truth() -> None:
    *_, one = table_iii(measured(0.0), NUMBERS.tolist(), HEAVIER)[0]
    assert one.mass_error == pytest.approx(0.02 / 1.02)
    assert one.centre_error == pytest.approx(0.5 / 1.5)


@pytest.mark.parametrize(
    ("name", "cases"),
    [
        ("A", {1, 2, 8, 9, 10}),
        ("B", {3, 4, 10}),
        ("C", {4, 10}),
        ("D", {1, 2, 3, 4, 5, 6, 7, 8, 9, 10}),
        ("E", {6, 7, 8, 9, 10, 11}),
        ("F", {7, 10}),
        ("G", {10, 11}),
        ("H", {5, 6, 7, 8, 9, 10, 11}),
    ],
)
def test_each_case_uses_the_sets_of_the_printed_table(name: str, cases: set[int]) -> None:
    poses = measured(0.0)
    rows = np.isin(NUMBERS, set_numbers(name))
    if name == "E":
        rows &= ~np.isin(NUMBERS, set_numbers("H"))  # which case 5 uses alone
    wrench = poses.wrench.copy()
    wrench[rows] += np.random.default_rng(1).normal(size=(rows.sum(), 6))
    found = table_iii(CalibrationDataset.of(POSES, wrench), NUMBERS.tolist(), TRUTH)
    changed = {
        number for number, *_, one in found if one.largest_errors is not None and one.largest_errors.max() > 0.01
    }
    assert changed == cases


def test_a_reference_of_zero_has_no_relative_errors() -> None:
    nothing = Parameters(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    *_, one = table_iii(measured(0.0), NUMBERS.tolist(), nothing)[0]
    assert np.isnan([one.mass_error, one.centre_error]).all()
    test = json.loads(json.dumps(one.to_dict(), allow_nan=False))["test"]
    assert test["mass_error"] is test["centre_error"] is None


def test_missing_poses_are_counted_in_every_set() -> None:
    with pytest.raises(NotObservable, match=r"\(1 of A\)"):
        table_iii(measured(0.0), [0, *NUMBERS[1:].tolist()], TRUTH)
    with pytest.raises(NotObservable, match=r"\(12 of C, 150 of D, 24 of E, 24 of F, 48 of G\)"):
        table_iii(measured(0.0), NUMBERS[:36].tolist(), TRUTH)


def test_a_case_has_every_number_that_json_shows() -> None:
    for *_, one in table_iii(measured(0.01), NUMBERS.tolist(), TRUTH, g_m_s2=9.8):
        document = json.loads(json.dumps(one.to_dict(), allow_nan=False))
        assert document["mass_kg"] == pytest.approx(19.7 / 9.8, rel=2e-3)
        assert 0.0 < document["rotation_difference_rad"] < 0.01
        assert document["residual"]["force_rms_N"] == pytest.approx(0.017, rel=0.4)


def test_carlson_as_published_has_no_bias(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ftcalib.compare.get_args", lambda _: ["srom", "carlson-eigen", "carlson-nullspace"])
    poses = measured(0.01, paper_set("A")[::2])
    default = solve(poses)
    printed, extended = (
        {one.method: one for one in compare(poses, default=default, as_published=as_published)}
        for as_published in (True, False)
    )
    for method in ("carlson-eigen", "carlson-nullspace"):
        without, with_bias = printed[method].parameters, extended[method].parameters
        assert without is not None
        assert with_bias is not None
        np.testing.assert_array_equal(without.force_bias_N, np.zeros(3))
        np.testing.assert_allclose(with_bias.force_bias_N, TRUTH.force_bias_N, atol=0.05)
    assert printed["srom"].to_dict() == extended["srom"].to_dict()
