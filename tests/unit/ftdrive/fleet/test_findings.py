"""Findings across cells: each is named where it is planted, and nowhere else."""

from typing import Any

import numpy as np
import pytest

from ftcalib.model import Array
from ftdrive.fleet.state import FleetFinding
from ftdrive.store.records import StoredResult
from tests.unit.ftdrive.fleet.fleet_records import cell, daily, fleet, result, weighed
from tests.unit.ftdrive.stream.simulated import calibrated

MASS_KG = result("a", 1).mass_kg
OFF_AXIS_M = (calibrated().parameters.R_flange_sensor @ calibrated().parameters.p_sensor_com_m)[:2]


def found(cells: str, results: list[StoredResult], checks: list[Any] | None = None) -> list[FleetFinding]:
    return list(fleet([cell(name, verify_every_days=1000.0) for name in cells], results, checks or []).findings)


def noisy(seed: int) -> Array:
    return np.random.default_rng(seed).multivariate_normal(np.zeros(15), calibrated().covariance)


def payload(
    name: str, kg: float = MASS_KG + 0.4, off_axis_m: Array | None = OFF_AXIS_M, step: Array | None = None, **more: Any
) -> StoredResult:
    """A result of a controller whose payload includes 0.4 kg of sensor on the axis, if it is right."""
    share = MASS_KG / kg
    com = None if off_axis_m is None else [*(share * off_axis_m), 0.05]
    return result(name, 1, step=noisy(ord(name)) if step is None else step, payload_kg=kg, payload_com_m=com, **more)


def test_a_centre_of_mass_that_is_wrong_in_several_controllers_is_named() -> None:
    wrong = np.zeros(2)
    (one,) = found("abcd", [payload("a"), *(payload(name, off_axis_m=wrong) for name in "bcd")])
    assert (one.kind, one.cells) == ("payload", ("b", "c", "d"))
    x, y = 1e3 * OFF_AXIS_M
    assert one.words.startswith(
        f"The tool gripper has its centre of mass ({x:.0f}, {y:.0f}) mm off the flange axis, according to b, c and d"
    )
    assert "imply other centres, such as (0, 0) mm in b: set the payloads with `ftdrive push`" in one.words


@pytest.mark.parametrize(("kg", "wrong"), [(0.5, True), (MASS_KG, False), (MASS_KG + 0.9, False), (5.0, True)])
def test_a_mass_that_is_wrong_in_several_controllers_is_named(kg: float, wrong: bool) -> None:
    one = found("abc", [payload(name, kg, None) for name in "abc"])
    assert [(each.kind, each.cells) for each in one] == ([("payload", ("a", "b", "c"))] if wrong else [])
    if wrong:
        assert f"The tool gripper weighs {MASS_KG:.2f} kg without sensor and adapter, according to a," in one[0].words
        assert f"such as {kg:.2f} kg in a" in one[0].words


def tilted(degrees: float) -> Array:
    step = np.zeros(15)
    step[3] = np.deg2rad(degrees) * MASS_KG * 9.80665
    return step


def test_a_base_that_turned_between_calibrations_is_named() -> None:
    results = [
        *(result(name, 60, step=noisy(1)) for name in "abc"),
        result("a", 10, step=noisy(2)),
        result("b", 10, step=noisy(3) + tilted(0.5), tool="drill"),
        result("c", 30, step=noisy(4) + tilted(0.5)),
        result("c", 10, step=noisy(5) + tilted(0.5)),  # the base rests since
    ]
    (one,) = found("abc", results)
    assert (one.kind, one.cells) == ("base", ("b",))
    assert one.words.startswith("b: gravity has turned by 0.5")
    assert "between the calibrations of 2026-09-23 and 2026-11-12" in one.words


def test_sensors_that_follow_their_temperature_are_named_by_model() -> None:
    rng = np.random.default_rng(0)
    results = [result(name, 50, sensor_model="Rokubi" if name in "abc" else "Mini45") for name in "abcde"]
    checks = []
    for seed, one in enumerate(results):
        warm = 20 + 10 * rng.random(40)
        sign = 0.0 if one.robot_host in {"host-c", "host-e"} else (-1.0) ** seed
        added = np.outer(warm - 25, [sign, 0, 0, 0, 0, 0])  # sigma a kelvin: 0.01 N
        days = daily(one, 40, seed, added)
        checks += [check_at(each, T) for each, T in zip(days, warm, strict=True)]
    (finding,) = found("abcde", results, checks)
    assert (finding.kind, finding.cells) == ("temperature", ("a", "b"))
    assert "of 2 of 3 sensors Rokubi depends on their temperature, by up to 0.0099 N per kelvin" in finding.words


def check_at(one: Any, T: float) -> Any:
    return one._replace(temperature_C=float(T))


@pytest.mark.parametrize(
    ("weighings", "refusals", "days_ago", "named"),
    [
        (10, {"cable": 8, "moving": 3}, 1.0, True),
        (10, {"cable": 8, "moving": 2}, 1.0, False),
        (2, {"cable": 7}, 1.0, False),
        (0, {"cable": 90}, 5.0, False),
    ],
    ids=["most", "half", "few", "past"],
)
def test_a_cell_that_cannot_weigh_most_parts_is_named(
    weighings: int, refusals: dict[str, int], days_ago: float, named: bool
) -> None:
    last = weighed("a", days_ago, weighings=weighings, refusals=refusals)
    cells = [cell(name, verify_every_days=1000.0) for name in "ab"]
    findings = fleet(cells, [result("a", 9), result("b", 9)], (), [last, weighed("b", 0.0)]).findings
    assert [(one.kind, one.cells) for one in findings] == ([("weighing", ("a",))] if named else [])
    if named:
        assert "of 21 weighings with gripper were refused on 2026-11-21, mostly because of 'cable'" in findings[0].words
