"""What the sections about the origin of a result print of its facts."""

from typing import Any

import pytest

from ftdrive.report.sections import comparison, provenance, tour

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


def test_a_run_is_described_by_its_plan_and_what_came_of_it() -> None:
    section = tour({"tour": RUN, "result": RESULT})
    assert section.text == [
        "Run 2026-11-23T075825Z-gripper, started 2026-11-23T07:58:25 UTC, mode auto, 25 stops.",
        "24 poses were asked for.",
        "24 poses, 57 s of motion, no move above 89°, all proven clear, nearest 23 mm.",
        "Larger sigma than predicted: centre of mass (1.3 times), force bias (1.5 times), "
        "torque bias (1.5 times), force compensation (1.2 times), torque compensation (1.5 times). "
        "Noise or errors of this sensor are larger than the plan assumed.",
    ]
    sigmas, devices, settings = section.tables
    assert sigmas.rows == [
        ("mass, g", "1.1", "1.2"),
        ("centre of mass, mm", "0.30", "0.40"),
        ("force bias, N", "0.0040", "0.0060"),
        ("torque bias, N·m", "0.00020", "0.00030"),
        ("force compensation, N", "0.0050", "0.0061"),
        ("torque compensation, N·m", "0.00020", "0.00031"),
    ]
    assert devices.rows == [("arm", "UR5e", "1", "5.15"), ("sensor", "Mini45", "-", "-")]
    assert settings.rows == [("robot.host", "10.0.0.2"), ("robot.speed", "1 2"), ("sign", "-")]
    other = tour({"tour": {**RUN, "plan": {**PLAN, "certified": False}}, "result": RESULT})
    assert "NOT all proven clear" in other.text[2]
    as_good = tour(
        {
            "tour": {**RUN, "plan": {**PLAN, "predicted_sigma": dict.fromkeys(PLAN["predicted_sigma"], 1.0)}},
            "result": RESULT,
        }
    )
    assert as_good.text[-1] == "No sigma is more than 20 % larger than predicted."


@pytest.mark.parametrize(
    ("plan", "error", "words"),
    [
        (None, "", "The poses were chosen by hand, without a plan."),
        (None, "plan.json is damaged", "plan.json is damaged"),
        (PLAN | {"sweep": {}}, "", "Proven clear along the whole curve, nearest 23 mm."),
    ],
)
def test_without_a_tour_only_devices_and_settings_are_listed(plan: Any, error: str, words: str) -> None:
    section = tour({"tour": {**RUN, "plan": plan, "plan_error": error}, "result": RESULT})
    assert section.text[-1] == words
    assert [table.caption for table in section.tables] == ["Devices", "Settings"]
    assert tour({"tour": None}).text == ["The source is not a run folder, so it contains no plan, devices or settings."]


def test_a_comparison_names_what_changed_by_more_than_chance() -> None:
    groups = [
        {"name": "force bias", "chi2": 31.234, "dof": 3, "p_value": 9.9e-4},
        {"name": "centre of mass", "chi2": 16.2, "dof": 3, "p_value": 1.1e-3},
        {"name": "all", "chi2": 99.0, "dof": 15, "p_value": 1e-9},
    ]
    parameters = [
        {"name": "force_bias_N.x", "change": 0.123, "sigmas": 4.26},
        {"name": "p_sensor_com_m.z", "change": -0.00012, "sigmas": None},
    ]
    found = {"id": "29ce87", "verdict": "good", "mass_kg": 1.23456, "same_data": False, "groups": groups,
             "sensors": ["assumed", "assumed"], "parameters": parameters}  # fmt: skip
    section = comparison({"comparison": found, "compared_with": "old.json"})
    assert section.text[0] == "Compared with old.json: id 29ce87, good, mass 1.2346 kg."
    assert section.text[1] == "Significant changes: force bias."
    assert section.tables[0].rows[0] == ("force bias", "31.23", "3", "0.00099")
    assert section.tables[0].rows[2] == ("all", "99", "15", "< 0.0001")
    assert section.tables[1].rows == [("force bias x", "+0.12", "+4.3"), ("centre of mass z", "-0.00012", "-")]
    alike = {**found, "groups": groups[1:]}
    assert comparison({"comparison": alike, "compared_with": ""}).text[1].startswith("No significant change")
    same = comparison({"comparison": {**found, "same_data": True}, "compared_with": ""}).text
    assert (len(same), same[1].startswith("Both results use the same data")) == (2, True)
    assert comparison({"comparison": None, "compared_with": "It is gone."}).text == ["It is gone."]


def test_the_origin_says_how_to_reproduce_and_what_was_verified() -> None:
    last = {"created_utc": "2026-11-23T07:58:25+00:00", "passed": False, "reason": "bias", "path": "v.json"}
    facts = {"source": "run", "created_utc": "2026-11-24", "id": "29ce87", "reproduce": "ftdrive solve run",
             "trust": {"last_verification": last, "store_error": "it is locked"},
             "result": {"provenance": {"devices": {"arm": {"serial": "1"}}, "by": "me"}}}  # fmt: skip
    section = provenance(facts)
    assert section.text[1:] == [
        "Reproduce the result: `ftdrive solve run`. The id must be 29ce87.",
        "Last verification 2026-11-23T07:58 UTC, FAILED: bias. File v.json.",
        "A later verification may be missing, because it is locked.",
    ]
    assert [table.rows for table in section.tables] == [[("by", "me")], [("devices.arm.serial", "1")]]
    bare = provenance({**facts, "reproduce": "", "trust": None, "result": {"provenance": {"by": "me"}}})
    assert bare.text[1].startswith("The file contains no data")
    assert len(bare.tables) == 1
    passed = provenance({**facts, "trust": {"last_verification": {**last, "passed": True}}})
    assert "UTC, passed: bias." in passed.text[-1]
