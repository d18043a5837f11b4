"""The state of each cell: which calibration counts, when it is due, and whether its bias drifts."""

from datetime import timedelta

import numpy as np

from ftdrive.fleet.state import times_in_words
from tests.unit.ftdrive.fleet.fleet_records import NOW, cell, check, daily, fleet, result, time, weighed


def test_the_newest_accepted_calibration_of_each_tool_counts() -> None:
    results = [
        result("a", 50),
        result("a", 40),
        result("a", 30, verdict="rejected"),
        result("a", 20, tool="drill", verdict="usable", temperature_C=25.0),
        result("b", 10),
        result("x", 5),  # of no cell
    ]
    states = fleet([cell("a"), cell("b"), cell("c")], results).cells
    assert [(one.cell, one.tool, one.calibration_id) for one in states] == [
        ("a", "drill", "a-20"),
        ("a", "gripper", "a-40"),
        ("b", "gripper", "b-10"),
        ("c", "gripper", None),
    ]
    drill = states[0]
    assert (drill.verdict, drill.temperature_C, drill.sensor_serial, drill.sensor_model) == (
        "usable",
        25.0,
        "ft-a",
        "Mini45",
    )
    assert drill.calibrated == NOW - timedelta(days=20)
    assert [one.is_due(NOW) for one in states] == [True, True, True, True]  # c was never calibrated


def test_a_calibration_of_an_emulated_cell_is_marked() -> None:
    results = [
        result("a", 20, tool="drill"),
        result("a", 3, emulated=True),
        result("b", 1, tool="emulated", emulated=True),
    ]
    states = fleet([cell("a"), cell("b"), cell("c")], results).cells
    assert [one.tool_in_words for one in states] == ["drill", "gripper EMULATED", "EMULATED", "gripper", "gripper"]
    assert [one.to_dict(NOW)["emulated"] for one in states] == [False, True, True, False, False]


def test_a_tool_out_of_use_is_not_listed_for_ever() -> None:
    results = [
        result("a", 200),
        result("a", 150, tool="old"),
        result("a", 100, tool="older"),
        result("a", 1, tool="new"),
    ]
    one = fleet([cell("a")], results, [check(results[2], 3)])
    assert [state.tool for state in one.cells] == ["gripper", "new", "older"]  # configured, newest, verified


def test_due_counts_from_the_last_verification_whatever_its_outcome() -> None:
    made = result("a", 30)
    cells = [cell("a", verify_every_days=10.0)]
    (one,) = fleet(cells, [made]).cells
    assert (one.verified, one.passed, one.due) == (None, None, NOW - timedelta(days=20))
    (one,) = fleet(cells, [made], [check(made, 12), check(made, 4, passed=False, temperature_C=31.0)]).cells
    assert (one.verified, one.passed, one.change) == (NOW - timedelta(days=4), False, "bias")
    assert (one.due, one.is_due(NOW), one.temperature_C) == (NOW + timedelta(days=6), False, 31.0)


def ramp(a_week: float, since_days_ago: float, days: int = 60) -> np.ndarray:
    added = np.zeros((days, 6))
    added[:, 0] = a_week / 7 * np.maximum(0.0, since_days_ago - np.arange(days)[::-1])
    return added


def test_a_drift_is_found_and_put_in_words() -> None:
    made, still, few = result("a", 61), result("b", 61), result("c", 61)
    checks = [*daily(made, 60, 1, ramp(2.0, 21)), *daily(still, 60, 2), *daily(few, 4, 3)]
    found = {one.cell: one.drift for one in fleet([cell("a"), cell("b"), cell("c")], [made, still, few], checks).cells}
    a, b, c = (found[name] for name in "abc")
    assert a is not None
    assert b is not None
    assert c is None
    assert a.found
    assert a.words.startswith("force bias x drifts by 0.02")  # 2 sigmas of 0.01 N
    assert " N per week since 2026-" in a.words
    assert 4 < a.level_sigmas < 7
    assert (b.found, b.words) == (False, "")
    assert b.level_sigmas < 2


def test_the_last_weighing_is_that_of_the_same_cell_tool_and_kind_of_cell() -> None:
    results = [result("a", 20, tool="drill"), result("a", 3), result("b", 1, emulated=True), result("c", 1)]
    weighings = [
        weighed("a", 2.0),
        weighed("a", 5.0, mass_kg=0.9, robot_host="an older address"),
        weighed("a", 0.0, emulated=True),
        weighed("b", 0.0, mass_kg=0.4, emulated=True),
        weighed("c", 1.0, last_utc=None, mass_kg=None, mass_sigma_kg=None, weighings=0),
        weighed("x", 0.0),
    ]
    states = fleet([cell("a"), cell("b"), cell("c")], results, (), weighings).cells
    found = [(one.cell, one.tool, one.weighings and one.weighings.mass_kg) for one in states]
    assert found == [("a", "drill", None), ("a", "gripper", 0.25), ("b", "gripper", 0.4), ("c", "gripper", None)]
    gripper = states[1].to_dict(NOW)["weighings"]
    assert gripper == {
        "day": time(2.0)[:10],
        "number": 7,
        "refused": {"cable": 2},
        "last_utc": time(2.0),
        "mass_kg": 0.25,
        "mass_sigma_kg": 1e-3,
    }
    assert [times_in_words(one, NOW)["weighed"] for one in states] == ["-", "0.250 kg 2 d", "0.400 kg 0 min", "-"]
