"""Units by the weight and the centre of mass that they make: where suspicion begins, and which units it names."""

import numpy as np
import pytest
from scipy import constants

from ftcalib import Parameters
from ftcalib.judge.units import FORCE_UNITS_N, TORQUE_UNITS_NM, implausible, unit_of_force


def found(
    weight_N: float, com_m: float, residual_N: float = 1.0, *, described: bool = False
) -> list[tuple[object, ...]]:
    zero = np.zeros(3)
    tool = Parameters(np.eye(3), np.array([0.0, 0, -weight_N]), zero, np.array([0.0, 0, com_m]), zero)
    findings = implausible(tool, residual_N, described=described)
    return [(one.code, one.severity, one.values.get("units"), one.values.get("most_m")) for one in findings]


def test_units_are_as_large_as_defined() -> None:
    inch, foot = constants.inch, constants.foot
    in_newtons = {"lbf": constants.pound_force, "kgf": constants.g, "gf": constants.g / 1e3}
    assert {name: FORCE_UNITS_N[name] for name in in_newtons} == pytest.approx(in_newtons)
    levers = {"lbf·in": ("lbf", inch), "lbf·ft": ("lbf", foot), "kgf·cm": ("kgf", 0.01), "kgf·m": ("kgf", 1.0)}
    expected = {name: in_newtons[force] * lever for name, (force, lever) in levers.items()}
    assert {name: TORQUE_UNITS_NM[name] for name in levers} == pytest.approx(expected)


@pytest.mark.parametrize(
    ("weight_N", "com_m", "residual_N", "expected"),
    [
        (0.31, 0.1, 1.0, []),
        (0.29, 0.1, 1.0, [("weight_compensated", "limit", None)]),
        (0.2, 0.019, 0.0, [("weight_compensated", "limit", None)]),
        (0.2, 0.021, 0.0, [("weight_implausible", "limit", [["kN", "kN·m"]])]),
        (490.0, 0.1, 1.0, []),
        (510.0, 0.1, 1.0, [("weight_implausible", "limit", [["mN", "N·mm"]])]),
        (2010.0, 0.1, 1.0, [("weight_implausible", "reject", [["mN", "N·mm"]])]),
        (50_000.0, 1e-3, 1.0, [("weight_implausible", "reject", [["gf", "N·m"]])]),
        (52_000.0, 1e-3, 1.0, [("weight_implausible", "reject", [["mN", "N·m"]])]),  # 510 N of gf are no tool
    ],
)
def test_a_weight_of_no_tool_is_named_with_the_units_that_make_it_one(
    weight_N: float, com_m: float, residual_N: float, expected: list[object]
) -> None:
    assert [one[:3] for one in found(weight_N, com_m, residual_N)] == expected


@pytest.mark.parametrize(
    ("com_m", "described", "expected"),
    [
        (4.9e-4, False, [("com_too_near", "limit", None)]),
        (5.1e-4, False, []),
        (0.24, False, []),
        (0.26, False, [("com_too_far", "limit", 0.25)]),
        (0.26, True, []),
        (0.51, False, [("com_too_far", "reject", 0.5)]),
        (2.0, True, []),
    ],
)
def test_a_centre_of_mass_of_no_tool_is_named(com_m: float, described: bool, expected: list[object]) -> None:
    assert [
        (code, severity, most_m) for code, severity, _, most_m in found(20.0, com_m, described=described)
    ] == expected


@pytest.mark.parametrize(
    ("weight_N", "force_N", "torque_Nm", "severity"),
    [
        (10.0, 490.0, 90.0, None),
        (10.0, 510.0, 0.0, "limit"),
        (30.0, 510.0, 110.0, None),  # a large sensor, not many weights
        (10.0, 2010.0, 0.0, "reject"),
        (10.0, 0.0, 410.0, "reject"),
        (4000.0, 25_400.0, 0.0, None),  # which the weight shows
    ],
)
def test_a_bias_of_no_sensor_is_named(weight_N: float, force_N: float, torque_Nm: float, severity: str | None) -> None:
    sideways = np.array([0.6, 0.8, 0.0])
    biased = Parameters(
        np.eye(3), np.array([0.0, 0, -weight_N]), force_N * sideways, np.array([0.0, 0, 0.1]), torque_Nm * sideways
    )
    found = implausible(biased, 0.01, described=False, unit_N=(0.82, 0.01))
    assert [one.severity for one in found if one.code == "bias_implausible"] == [severity] * (severity is not None)
    assert all("1 unit = 0.820 N (sigma 0.010 N)" in one.fix for one in found)
    confirmed = implausible(biased, 0.01, described=False, unit_N=(1.002, 0.001))
    assert any(one.code == "bias_implausible" for one in confirmed) == (severity is not None and torque_Nm > 100)
    free = implausible(biased, 0.01, described=False, any_bias=True)
    assert all(one.code != "bias_implausible" for one in free)


def test_the_sigma_of_a_unit_is_that_of_mass_and_data() -> None:
    rng = np.random.default_rng(0)
    data_kg, true_kg = rng.normal(1.18, 0.01, 20_000), rng.normal(0.96, 0.006, 20_000)
    unit_N, sigma_N = unit_of_force(1.18, 0.01, 0.96, 0.006)
    assert unit_N == pytest.approx(np.mean(true_kg / data_kg), abs=4 * sigma_N / np.sqrt(20_000) + 1e-4)
    assert sigma_N == pytest.approx(np.std(true_kg / data_kg), rel=0.03)
