"""What the sections of a report print of its facts."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from syrupy.assertion import SnapshotAssertion

from ftdrive.report.sections import (
    Section,
    comparison,
    coverage,
    cross_validation,
    drift,
    error,
    estimates_section,
    motion,
    noise,
    provenance,
    residuals,
    tour,
)
from tests.unit.ftdrive.exports.example import calibration, responding

Facts = Mapping[str, Any]


def as_lines(section: Section) -> str:
    lines = list(section.text)
    for figure in section.figures:
        lines += [f"figure {figure.name}: {figure.alt}", f"  {figure.caption}"]
    for table in section.tables:
        lines += [f"table {table.caption}", *(" | ".join(row) for row in table.rows)]
    return "\n".join(lines)


DRIFT: dict[str, Any] = {
    "in_fit": {"change": [0.4, -0.2, 0.0, 0.012, -0.003, 0.0], "sigma": [0.02] * 3 + [0.001] * 3},
    "first_pose_again": None,
    "lag1": None,
    "components": ["linear_force"],
    "in_use": None,
}
WALK = {
    "in_fit": {"change": [0.1] * 6, "sigma": [0.0] * 6},
    "first_pose_again": {"words": "none seen"},
    "lag1": 0.312,
    "components": ["walk_force_N"],
    "in_use": "at the last pose the bias was off",
}
ERRORS: dict[str, Any] = {
    "error_map": {
        "force_N": {"map": [[0.01, 0.02]], "rms": 0.0152, "largest": 0.0231, "axes": "+z", "words": "up"},
        "torque_Nm": {"map": [[1e-3, 2e-3]], "rms": 0.00125, "largest": 0.00231, "axes": "-x", "words": "along -x"},
    },
    "error": {"words": "0.02 N rms", "source": "predicted by the noise: 0.01 N", "cross_validated": True},
}


def method(name: str, crossed_N: float | None) -> dict[str, Any]:
    fit = {"force_rms_N": 0.1234, "torque_rms_Nm": 0.01234}
    left_out = {"force_rms_N": crossed_N, "torque_rms_Nm": crossed_N}
    known = {"mass_kg": 1.23456, "rotation_difference_rad": np.radians(1.5)}
    return {"method": name, "residual": fit, "cross_validated": left_out, **known}


METHODS = [method("ml", 0.2), method("lrom", 0.15), method("carlson", None), {"method": "srom", "reason": "23 poses"}]
CROSSED: dict[str, Any] = {"force_N": 0.2, "torque_Nm": 0.003, "reason": "", "methods": METHODS}
UNCROSSED: dict[str, Any] = {"force_N": None, "torque_Nm": None, "reason": "No poses.", "methods": []}
POSES: list[dict[str, Any]] = [
    {"row": row, "name": name, "t_s": t_s, "residual": residual, "sigmas": sigmas, "used": used}
    for row, name, t_s, residual, sigmas, used in (
        (1, "R07", 0.4, [0.1, -0.2, 0.3, 0.001, -0.002, 0.0035], 0.8, True),
        (2, "R12", 61.6, [2.0, 0.0, 0.0, 0.0, 0.0, 0.0], 7.0, False),
        (3, "R13", None, [0.0] * 6, None, True),
    )
]
FIT = {"noise_factor": 1.234, "p_value": 0.042, "rejected_poses": [2]}
NOISE = {"force_N": [0.01, 0.02, 0.09], "torque_Nm": [0.001, 0.003, 0.002], "unsteady": [2, 5]}
COVERAGE = {"words": "the poses …", "orientations": 20, "rank": 15, "largest_gap_rad": 1.0, "gap_words": "+x"}
MOMENTS = np.array([[2.0, 0.1, -0.2], [0.1, 2.4, 0.3], [-0.2, 0.3, 1.4]]) * 1e-3
MOTION_SIGMA = {"inertia_kg_m2": np.arange(9).reshape(3, 3) * 1e-6, "delay_s": 1.2e-4, "height_m": 0.0006}
MOTION = {
    "inertia_kg_m2": MOMENTS,
    "sigma": MOTION_SIGMA,
    "delay_s": 0.00321,
    "height_m": 0.0334,
    "used_share": 0.87,
    "contacts": [{"t_s": 12.34, "duration_s": 0.52, "force_N": 8.1, "torque_Nm": 0.42}],
    "sweep": {"duration_s": 19.6},
}
PLAN: dict[str, Any] = {
    "why": ["24 poses were asked for."],
    "poses": 24,
    "motion_time_s": 57.4,
    "max_move_deg": 88.6,
    "certified": True,
    "min_clearance_mm": 23.4,
    "predicted_sigma": {"mass_kg": 0.0011, "p_sensor_com_m": [1e-4, 2e-4, 3e-4], "force_bias_N": [0.004, 0.003, 0.002],
                        "torque_bias_Nm": [1e-4, 1e-4, 2e-4], "force_rms_N": 0.005, "torque_rms_Nm": 2e-4},
}  # fmt: skip
RUN: dict[str, Any] = {
    "run": "2026-11-23T075825Z-gripper",
    "created_utc": "2026-11-23T07:58:25.123+00:00",
    "mode": "auto",
    "stops": 25,
    "devices": {"arm": {"model": "UR5e", "serial": "1", "firmware": "5.15"}, "sensor": {"model": "Mini45"}},
    "config": {"robot": {"host": "10.0.0.2", "speed": [1, 2]}, "sign": None},
    "plan": PLAN,
    "plan_error": "",
}
SIGMA = {"mass_kg": 0.0012, "p_sensor_com_m": [4e-4, 1e-4, 2e-4], "force_bias_N": [0.001, 0.006, 0.002],
         "torque_bias_Nm": [3e-4, 1e-4, 2e-4]}  # fmt: skip
RESULT = {"sigma": SIGMA, "predicted_error": {"force_rms_N": 0.0061, "torque_rms_Nm": 3.1e-4}}
GROUPS = [
    {"name": "force bias", "chi2": 31.234, "dof": 3, "p_value": 9.9e-4},
    {"name": "centre of mass", "chi2": 16.2, "dof": 3, "p_value": 1.1e-3},
    {"name": "all", "chi2": 99.0, "dof": 15, "p_value": 1e-9},
]
COMPARISON: dict[str, Any] = {
    "id": "29ce87",
    "verdict": "good",
    "mass_kg": 1.23456,
    "same_data": False,
    "groups": GROUPS,
    "sensors": ["assumed", "assumed"],
    "parameters": [
        {"name": "force_bias_N.x", "change": 0.123, "sigmas": 4.26},
        {"name": "p_sensor_com_m.z", "change": -0.00012, "sigmas": None},
    ],
}
VERIFIED = {"created_utc": "2026-11-23T07:58:25+00:00", "passed": False, "reason": "bias", "path": "v.json"}
ORIGIN: dict[str, Any] = {
    "source": "run",
    "created_utc": "2026-11-24",
    "id": "29ce87",
    "reproduce": "ftdrive solve run",
    "trust": {"last_verification": VERIFIED, "store_error": "it is locked"},
    "result": {"provenance": {"devices": {"arm": {"serial": "1"}}, "by": "me"}},
}
PAIRS = [("R_flange_sensor.x", f"torque_bias_Nm.{axis}", value) for value, axis in enumerate("xyzxyz")]


def estimates(result: Any = None, strong: Any = (), motion: Any = None) -> Facts:
    found = (calibration() if result is None else result).to_dict()
    return {"result": found, "correlation": {"strong": strong}, "motion": motion, "mass": "1.2 kg ± 1.6 %"}


def of_poses(poses: Any = POSES, motion: Any = None, **more: Any) -> Facts:
    return {"result": FIT | more, "poses": poses, "motion": motion, "residuals": "force 0.2100 N rms"}


def of_tour(plan: Any = PLAN, plan_error: str = "") -> Facts:
    return {"tour": RUN | {"plan": plan, "plan_error": plan_error}, "result": RESULT}


def compared(**more: Any) -> Facts:
    return {"comparison": COMPARISON | more, "compared_with": "old.json"}


CASES: Mapping[str, tuple[Callable[[Facts], Section], Facts]] = {
    "drift": (drift, {"drift": DRIFT}),
    "drift-walk": (drift, {"drift": WALK}),
    "drift-none": (drift, {"drift": DRIFT | {"in_fit": None, "components": []}}),
    "estimates": (estimates_section, estimates()),
    "estimates-correlated": (estimates_section, estimates(strong=PAIRS)),
    "estimates-motion": (estimates_section, estimates(motion={})),
    "estimates-response": (estimates_section, estimates(responding(0.01, 0.002))),
    "error": (error, ERRORS),
    "error-predicted": (error, ERRORS | {"error": ERRORS["error"] | {"cross_validated": False}}),
    "methods": (cross_validation, {"cross_validation": CROSSED}),
    "methods-none": (cross_validation, {"cross_validation": UNCROSSED}),
    "methods-one": (cross_validation, {"cross_validation": UNCROSSED | {"reason": "", "methods": METHODS[2:3]}}),
    "residuals": (residuals, of_poses()),
    "residuals-timed": (residuals, of_poses(POSES[:2])),
    "residuals-no-noise": (residuals, of_poses(p_value=None, rejected_poses=[])),
    "residuals-motion": (residuals, of_poses(motion={"sweep": None}, rejected_poses=[])),
    "noise": (noise, {"noise": NOISE}),
    "noise-steady": (noise, {"noise": NOISE | {"unsteady": []}}),
    "noise-none": (noise, {"noise": None}),
    "coverage": (coverage, {"coverage": COVERAGE}),
    "coverage-none": (coverage, {"coverage": None}),
    "motion": (motion, {"motion": MOTION}),
    "motion-free": (motion, {"motion": MOTION | {"contacts": [], "sweep": None}}),
    "tour": (tour, of_tour()),
    "tour-unproven": (tour, of_tour(PLAN | {"certified": False})),
    "tour-as-predicted": (tour, of_tour(PLAN | {"predicted_sigma": dict.fromkeys(PLAN["predicted_sigma"], 1.0)})),
    "tour-by-hand": (tour, of_tour(None)),
    "tour-damaged": (tour, of_tour(None, "plan.json is damaged")),
    "tour-sweep": (tour, of_tour(PLAN | {"sweep": {}})),
    "tour-none": (tour, {"tour": None}),
    "comparison": (comparison, compared()),
    "comparison-alike": (comparison, compared(groups=GROUPS[1:])),
    "comparison-same": (comparison, compared(same_data=True)),
    "comparison-none": (comparison, {"comparison": None, "compared_with": "It is gone."}),
    "origin": (provenance, ORIGIN),
    "origin-bare": (provenance, ORIGIN | {"reproduce": "", "trust": None, "result": {"provenance": {"by": "me"}}}),
    "origin-passed": (provenance, ORIGIN | {"trust": {"last_verification": VERIFIED | {"passed": True}}}),
}


@pytest.mark.parametrize(("section", "facts"), CASES.values(), ids=CASES)
def test_what_a_section_prints(section: Callable[[Facts], Section], facts: Facts, snapshot: SnapshotAssertion) -> None:
    assert as_lines(section(facts)) == snapshot


def test_only_what_was_known_beforehand_is_fixed() -> None:
    sigma = np.full(15, 1e-3)
    sigma[6:10] = 0.0, 1e-13, 1e-8, 1e-13
    facts = estimates(replace(calibration(), covariance=np.diag(sigma**2)))
    rows = {row[0]: row[1:] for row in estimates_section(facts).tables[0].rows}
    assert rows["force bias x, N"] == ("1.0000", "fixed")
    assert rows["force bias y, N"] == ("-2.0000", "fixed")
    assert rows["force bias z, N"] == ("0.000010000", "0.000000010")
    assert rows["centre of mass x, mm"] == ("10.0000", "fixed")
    assert rows["torque bias y, N·m"] == ("-0.2000", "0.0010")
    assert [values[1] for values in rows.values()].count("fixed") == 3


def test_of_many_residuals_the_table_says_how_many_it_shows() -> None:
    many = residuals(of_poses([{**POSES[0], "row": row} for row in range(1, 251)], rejected_poses=[]))
    assert many.tables[0].caption.startswith(f"Table of the residuals ({len(many.tables[0].rows)} of 250 poses")
