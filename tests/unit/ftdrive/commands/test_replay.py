"""A replay equals the saved result: to the last digit, or to rounding where another processor computes."""

from dataclasses import replace

import pytest

from ftcalib import CalibrationResult, Finding
from ftdrive.commands.replay import compare_results
from ftdrive.errors import NotAccepted
from tests.unit.ftdrive.stream.simulated import calibrated


def moved(result: CalibrationResult, sigmas: float) -> CalibrationResult:
    weight_N = result.parameters.gravity_force_base_N * (1 + sigmas * result.sigma["mass_kg"] / result.mass_kg)
    return replace(result, parameters=replace(result.parameters, gravity_force_base_N=weight_N))


def test_a_replay_is_equal_to_rounding() -> None:
    saved = calibrated()
    assert compare_results(calibrated(), saved) == "equal to the last digit"
    assert compare_results(moved(saved, 1e-8), saved).startswith("equal except for rounding, within ")
    with pytest.raises(NotAccepted, match=r"differs from the saved calibration in .*"):
        compare_results(moved(saved, 1e-4), saved)
    other = replace(moved(saved, 1e-8), findings=(*saved.findings, Finding.of("response_small")))
    with pytest.raises(NotAccepted, match="differs"):
        compare_results(other, saved)
