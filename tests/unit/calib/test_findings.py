"""Findings as data: words from code and values, order by rank, verdict by severity, and a table that is all used."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from ftcalib.findings import CODES, Finding, Severity, folded, ordered, verdict_of
from tests.finding_examples import examples

PRODUCT = Path(__file__).parents[3]
UNITS = {"N", "Nm", "mNm", "kg", "m", "s", "mm", "deg", "percent"}


def test_words_come_from_the_table_and_the_values() -> None:
    order = [["torque", ["-x", "y", "-z"]], ["force", ["y", "-x", "z"]]]
    finding = Finding.of("axes_disagree", corrections=order, residual_Nm=np.float64(0.301), corrected_Nm=0.0029)
    assert finding.words == (
        "torque residual 0.3 N·m, but 0.0029 N·m with other axes of force or torque: try torque x and z reversed, or "
        "force x, y, z taken from (y, -x, z) (--columns), or check the wiring of the axes and the sensor's matrix"
    )


@pytest.mark.parametrize(
    ("code", "values", "says"),
    [
        ("repeated_poses", {"poses": np.array([3, 7])}, "poses 3, 7 have"),
        ("cable_pulls", {"poses": ["R03", "R07"]}, "pulls on the tool in R03, R07:"),
        ("constant_force", {"force_N": np.array([1.234, -2, 0])}, "(1.2, -2, 0) N"),
        (
            "com_too_far",
            {"distance_m": 1.0, "most_m": 0.5, "units": [("lbf", "N·m"), ("kgf", "kgf·m"), ("N", "N·mm")]},
            "torque (perhaps forces in lbf, or forces in kgf and torques in kgf·m, or torques in N·mm), and",
        ),
        (
            "payload_mismatch",
            {"payload_kg": 3, "load_kg": 1.5, "sensor_kg": None, "set_kg": 1.5},
            "mass of the sensor is not configured: set the payload in the controller to 1.50 kg plus the mass",
        ),
    ],
)
def test_forms_and_units(code: str, values: dict[str, object], says: str) -> None:
    severity = CODES[code].severities[0]
    assert says in Finding(code, severity, values).words


def test_what_was_found_is_one_line_with_its_number() -> None:
    for finding in examples():
        assert len(finding.found) <= 100, finding.code
        assert "None" not in finding.words, finding.code
        places = re.findall(r"{(\w+)", CODES[finding.code].found)
        has_number = any(place.rpartition("_")[2] in UNITS for place in places)
        assert not has_number or re.search(r"\d", finding.found[:70]), finding.code


def test_a_finding_survives_json_and_infinity_is_not_known() -> None:
    finding = Finding.of("force_error", "reject", source="residuals", error_N=2, share_percent=np.inf, limit_percent=10)
    document = json.loads(json.dumps(finding.to_dict(), allow_nan=False))
    assert Finding.from_dict(document) == finding
    assert "the force error is unknown of the weight" in document["words"]


def test_a_code_of_a_later_version_is_kept_without_a_sentence() -> None:
    later = Finding("spooky_action", "limit", {"distance_m": 2.0})
    assert ordered([later, Finding.of("noise_unknown"), Finding.of("few_poses", n_poses=5, recommended=6)])[1] == later
    assert "spooky_action" in later.words
    assert Finding.from_dict(later.to_dict()) == later


def test_wrong_findings_are_refused() -> None:
    with pytest.raises(KeyError):
        Finding.of("spooky_action")
    with pytest.raises(ValueError, match="lacks poses"):
        Finding.of("poses_unchecked")
    with pytest.raises(ValueError, match="severity"):
        Finding("few_poses", "fatal", {})  # type: ignore[arg-type]  # the point of the test


@pytest.mark.parametrize(
    "change",
    [
        {"code": ["few_poses"]},
        {"severity": "fatal"},
        {"severity": {}},
        {"values": None},
        {"values": [1]},
        {"values": {}},
        {"code": "constant_force", "values": {"force_N": "x"}},
    ],
)
def test_a_damaged_finding_is_refused_when_it_is_read(change: dict[str, object]) -> None:
    document = Finding.of("few_poses", n_poses=5, recommended=6).to_dict() | change
    with pytest.raises(ValueError, match=r"^finding "):
        Finding.from_dict(document)


@pytest.mark.parametrize("document", [None, 3, "few_poses", [], {}])
def test_what_is_no_finding_is_refused(document: object) -> None:
    with pytest.raises(ValueError, match=r"^finding "):
        Finding.from_dict(document)  # type: ignore[arg-type]  # the point of the test


def test_causes_come_first_notes_last_and_the_worst_gives_the_verdict() -> None:
    def of(code: str, severity: Severity) -> Finding:
        return Finding(code, severity, dict.fromkeys(CODES[code].values, 0))

    drift, error = of("drift", "limit"), of("force_error", "reject")
    small_drift, rejected = of("drift", "note"), of("poses_rejected", "limit")
    assert ordered([error, drift]) == (drift, error)
    assert ordered([small_drift, rejected]) == (rejected, small_drift)
    assert [verdict_of(found) for found in ([], [small_drift], [small_drift, rejected], [drift, error])] == [
        "good",
        "good",
        "usable",
        "rejected",
    ]


def test_a_cause_stands_for_what_it_explains_and_leaves_the_verdict() -> None:
    def of(code: str, severity: Severity) -> Finding:
        return Finding(code, severity, dict.fromkeys(CODES[code].values, 0))

    error, far, mass = of("force_error", "reject"), of("com_too_far", "reject"), of("payload_mismatch", "limit")
    assert folded([error, far]) == [error, far]
    assert folded([of("bias_stepped", "limit"), mass, error]) == [of("bias_stepped", "reject"), mass]
    # Torques about another point say nothing of an error of force, and are no reason to reject by themselves.
    assert folded([of("torques_reversed", "limit"), far, error]) == [of("torques_reversed", "limit"), far, error]
    assert folded([of("torques_reversed", "limit"), of("com_too_far", "limit"), error]) == [
        of("torques_reversed", "limit"),
        error,
    ]


def test_a_finding_of_an_earlier_version_has_no_scale() -> None:
    document = Finding.of("known_mass", "limit", known_kg=1, mass_kg=1.2, sigma_kg=0.01, units=[]).to_dict()
    assert "unit" not in Finding.from_dict(document).words


def test_every_code_is_found_somewhere_and_every_finding_has_a_code() -> None:
    folders = (PRODUCT / "calib/ftcalib", PRODUCT / "ftdrive/ftdrive")
    files = [path for folder in folders for path in folder.rglob("*.py") if path.name != "findings.py"]
    source = "\n".join(path.read_text(encoding="utf-8") for path in files)
    made = set(re.findall(r'Finding\.of\(\s*"(\w+)"', source))
    assert made <= CODES.keys()
    unused = {code for code in CODES if f'"{code}"' not in source}
    assert unused == {"gain_x", "gain_y", "gain_z", "known_values_misfit_force", "known_values_misfit_torque"}
