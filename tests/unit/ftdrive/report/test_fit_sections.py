"""What the sections about a fit print of its facts."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ftdrive.report.sections import coverage, cross_validation, drift, error, estimates_section, noise, residuals
from tests.unit.ftdrive.exports.example import calibration, responding


def test_a_drift_is_listed_in_newton_and_millinewton_metre() -> None:
    found = {"change": [0.4, -0.2, 0.0, 0.012, -0.003, 0.0], "sigma": [0.02] * 3 + [0.001] * 3}
    seen = {"in_fit": found, "first_pose_again": None, "lag1": None, "components": ["linear_force"], "in_use": None}
    (table,) = drift({"drift": seen}).tables
    assert [row[0] for row in table.rows][::3] == ["Fx, N", "Tx, mN·m"]
    assert [row[1] for row in table.rows][::3] == ["+0.400", "+12.0"]
    assert [row[2] for row in table.rows][::3] == ["0.020", "1.0"]
    assert [row[3] for row in table.rows][:4] == ["+20.0", "-10.0", "+0.0", "+12.0"]


def test_a_drift_is_said_as_far_as_it_is_known() -> None:
    found = {"change": [0.1] * 6, "sigma": [0.0] * 6}
    seen = {"lag1": 0.312, "components": ["walk_force_N"], "in_use": "at the last pose the bias was off"}
    section = drift({"drift": {**seen, "in_fit": found, "first_pose_again": {"words": "none seen"}}})
    assert section.text[0] == "None seen."
    assert "correlated by 0.31." in section.text[1]
    assert "(random walk)" in section.text[2]
    assert section.text[3] == "At the last pose the bias was off. Tare before use."
    assert {tuple(row[1:]) for row in section.tables[0].rows} == {("-", "-", "-")}
    nothing = drift({"drift": {**seen, "in_fit": None, "first_pose_again": None, "lag1": None, "in_use": None}})
    assert (nothing.text, nothing.tables) == (["The fit found no drift of the bias."], ())


def estimated(result: Any, strong: Any = (), motion: Any = None) -> Any:
    seen = {"correlation": {"strong": strong}, "motion": motion, "mass": "1.2 kg ± 1.6 %"}
    return estimates_section({"result": result.to_dict(), **seen})


def test_only_what_was_known_beforehand_is_fixed() -> None:
    sigma = np.full(15, 1e-3)
    sigma[6:10] = 0.0, 1e-13, 1e-8, 1e-13
    table = estimated(replace(calibration(), covariance=np.diag(sigma**2))).tables[0]
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["force bias x, N"] == ("1.0000", "fixed")
    assert rows["force bias y, N"] == ("-2.0000", "fixed")
    assert rows["force bias z, N"] == ("0.000010000", "0.000000010")
    assert rows["centre of mass x, mm"] == ("10.0000", "fixed")
    assert rows["torque bias y, N·m"] == ("-0.2000", "0.0010")
    assert [values[1] for values in rows.values()].count("fixed") == 3


def test_the_strongest_correlations_are_named() -> None:
    pairs = [
        ("R_flange_sensor.x", f"torque_bias_Nm.{axis}", value) for axis, value in zip("xyzxyz", range(6), strict=True)
    ]
    text = estimated(calibration(), pairs).text
    assert "24 poses, gravity 9.80665 m/s²" in text[0]
    assert text[1].startswith(
        "Strongest correlations: mounting x and torque bias x +0.00; mounting x and torque bias y"
    )
    assert text[1].count("mounting") == 5
    assert estimated(calibration(), motion={}).text[0].count("24 parts of the motion") == 1
    assert estimated(calibration()).text[1].startswith("No two parameters")
    assert estimated(calibration()).text[2].endswith("there they cancel. Mass as read: 1.2 kg ± 1.6 %.")


def test_gain_and_cross_talk_have_their_units() -> None:
    section = estimated(responding(0.01, 0.002))
    rows = {row[0]: float(row[1]) for row in section.tables[1].rows}
    assert len(rows) == 12
    assert {name: value for name, value in rows.items() if value} == pytest.approx(
        {"force gain xx, %": 1.0, "force gain yy, %": -1.0, "cross-talk xx, mN·m/N": 2.0}
    )
    assert "force gain yz, %" in rows
    assert section.text[2].startswith("Sigma: that of mounting")


def test_the_error_is_listed_with_its_worst_direction() -> None:
    one = {"map": [[0.01, 0.02]], "rms": 0.0152, "largest": 0.0231, "axes": "+z", "words": "up"}
    other = {"map": [[0.001, 0.002]], "rms": 0.00125, "largest": 0.00231, "axes": "-x", "words": "along -x"}
    facts: dict[str, Any] = {
        "error_map": {"force_N": one, "torque_Nm": other},
        "error": {"words": "0.02 N rms", "source": "predicted by the noise: 0.01 N", "cross_validated": True},
    }
    section = error(facts)
    assert section.text[1:] == [
        "Its source: predicted by the noise: 0.01 N.",
        "Worst direction of the tool axis for the force: up, 0.0231 N.",
        "Worst direction for the torque: along -x, 0.00231 N·m.",
    ]
    assert section.tables[0].rows == [
        ("force, N", "0.0152", "0.0231", "+z"),
        ("torque, N·m", "0.00125", "0.00231", "-x"),
    ]
    assert "0.0100 to 0.0231 N, largest up" in section.figures[0].alt
    assert "0.00100 to 0.00231 N·m" in section.figures[1].alt
    assert "also includes model errors" in section.figures[0].caption
    facts["error"]["cross_validated"] = False
    assert "can be trusted" in error(facts).figures[0].caption


def test_methods_are_compared_where_they_have_a_result() -> None:
    def method(name: str, crossed_N: float | None) -> dict[str, Any]:
        fit = {"force_rms_N": 0.1234, "torque_rms_Nm": 0.01234}
        left_out = {"force_rms_N": crossed_N, "torque_rms_Nm": crossed_N}
        known = {"mass_kg": 1.23456, "rotation_difference_rad": np.radians(1.5)}
        return {"method": name, "residual": fit, "cross_validated": left_out, **known}

    methods = [
        method("ml", 0.2),
        method("lrom", 0.15),
        method("carlson", None),
        {"method": "srom", "reason": "23 poses"},
    ]
    section = cross_validation(
        {"cross_validation": {"force_N": 0.2, "torque_Nm": 0.003, "reason": "", "methods": methods}}
    )
    assert section.text[0].startswith("Each pose predicted from all others: 0.200 N, 0.00300 N·m rms.")
    assert section.tables[0].rows[0] == ("ml", "1.235", "1.50", "0.123", "0.0123", "0.200", "0.200")
    assert section.tables[0].rows[2][-2:] == ("-", "-")
    assert section.tables[1].rows == [("srom", "23 poses")]
    assert section.figures[0].alt.endswith("lrom has the smallest force error.")
    none: dict[str, Any] = {"force_N": None, "torque_Nm": None, "reason": "No poses.", "methods": []}
    assert cross_validation({"cross_validation": none}).text == ["The methods are not compared. No poses."]
    alone = cross_validation({"cross_validation": {**none, "reason": "", "methods": methods[2:3]}})
    assert (alone.figures, len(alone.tables)) == ([], 1)


POSES: list[dict[str, Any]] = [
    {"row": row, "name": name, "t_s": t_s, "residual": residual, "sigmas": sigmas, "used": used}
    for row, name, t_s, residual, sigmas, used in (
        (1, "R07", 0.4, [0.1, -0.2, 0.3, 0.001, -0.002, 0.0035], 0.8, True),
        (2, "R12", 61.6, [2.0, 0.0, 0.0, 0.0, 0.0, 0.0], 7.0, False),
        (3, "R13", None, [0.0] * 6, None, True),
    )
]


def left(poses: Any = POSES, motion: Any = None, **more: Any) -> Any:
    result = {"noise_factor": 1.234, "p_value": 0.042, "rejected_poses": [2]} | more
    return residuals({"result": result, "poses": poses, "motion": motion, "residuals": "force 0.2100 N rms"})


def test_each_residual_is_in_the_table_and_the_worst_is_named() -> None:
    section = left()
    assert section.text == [
        "Residuals: force 0.2100 N rms.",
        "They are 1.23 times the measured noise (p = 0.042).",
        "Rejected, because they do not fit the others: pose R12.",
    ]
    assert section.tables[0].rows == [
        ("R07", "0", "0.100", "-0.200", "0.300", "1.0", "-2.0", "3.5", "0.80", "yes"),
        ("R12", "62", "2.000", "0.000", "0.000", "0.0", "0.0", "0.0", "7.0", "no"),
        ("R13", "-", "0.000", "0.000", "0.000", "0.0", "0.0", "0.0", "-", "yes"),
    ]
    assert section.tables[0].caption == "Table of the residuals"
    assert section.figures[0].alt.endswith("the largest is 7.0 at pose R12.")
    assert "none above the dashed line at 1.9." in section.figures[0].caption
    assert "against the order of the poses" in section.figures[1].alt
    assert "against time" in left(POSES[:2]).figures[1].alt


def test_residuals_without_a_measured_noise_do_not_test_the_fit() -> None:
    text = left(p_value=None, rejected_poses=[]).text
    assert text[1].startswith("The noise was not measured but estimated")
    assert len(text) == 2


def test_parts_of_a_motion_are_no_poses() -> None:
    section = left(motion={"sweep": None}, rejected_poses=[])
    assert ([one.name for one in section.figures], section.tables) == (["time_residuals"], [])
    assert "against time" in section.figures[0].alt
    many = left([{**POSES[0], "row": row} for row in range(1, 251)], rejected_poses=[])
    assert many.tables[0].caption.startswith(f"Table of the residuals ({len(many.tables[0].rows)} of 250 poses")


def test_noise_is_given_by_its_median_and_largest() -> None:
    measured = {"force_N": [0.01, 0.02, 0.09], "torque_Nm": [0.001, 0.003, 0.002], "unsteady": [2, 5]}
    section = noise({"noise": measured})
    assert section.text[0].endswith("poses: 0.0200 N, 0.00200 N·m. Largest: 0.0900 N, 0.00300 N·m.")
    assert section.text[1].startswith("Not steady while averaged: stop 2, 5.")
    assert section.figures[0].alt.endswith("0.0100 to 0.0900 N.")
    assert len(noise({"noise": {**measured, "unsteady": []}}).text) == 1
    assert noise({"noise": None}).text[0].startswith("The source contains no noise")


def test_coverage_names_its_largest_gap() -> None:
    found = {"words": "the poses …", "orientations": 20, "rank": 15, "largest_gap_rad": 1.0, "gap_words": "+x"}
    section = coverage({"coverage": found})
    assert section.text[0] == "The poses …"
    assert section.text[1].startswith("20 different orientations")
    assert section.text[2] == "Largest gap: 57° around the direction +x."
    assert "57°" in section.figures[0].alt
    assert coverage({"coverage": None}).figures == ()
