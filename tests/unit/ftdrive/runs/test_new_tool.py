"""Which earlier result may serve a new tool."""

from dataclasses import replace
from typing import Any

import pytest

from ftcalib import CalibrationResult
from ftcalib.findings import Finding
from ftdrive.errors import ConfigError
from ftdrive.runs.new_tool import require_same_cell
from tests.unit.ftdrive.live.simulated import calibrated


def of(sensor: str, arm: str, mount: str | None = None) -> dict[str, Any]:
    return {"devices": {"sensor": {"serial": sensor}, "arm": {"serial": arm}}, "setup": {"mount": mount}}


def earlier(**provenance: Any) -> CalibrationResult:
    return replace(calibrated(), provenance=provenance)


def test_the_same_cell_may_and_what_is_not_named_is_not_compared() -> None:
    require_same_cell(earlier(**of("FT1", "A1", "front")), of("FT1", "A1", "front"))
    require_same_cell(earlier(**of("FT1", "A1")), {"source": "poses.csv"})
    require_same_cell(earlier(), of("FT1", "A1"))


@pytest.mark.parametrize(
    ("now", "words"),
    [(of("FT2", "A1", "front"), "sensor FT1"), (of("FT1", "A2"), "arm A1"), (of("FT1", "A1", "back"), "mount front")],
)
def test_another_cell_may_not(now: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        require_same_cell(earlier(**of("FT1", "A1", "front")), now)


def test_a_rejected_result_may_not() -> None:
    rejected = Finding("not_a_known_code", "reject")
    with pytest.raises(ConfigError, match="rejected"):
        require_same_cell(replace(earlier(), findings=(rejected,)), {})
