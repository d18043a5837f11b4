"""Known values that the data contradict, from given estimates and sigmas."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib.findings import Finding
from ftcalib.judge.described_cell import contradictions
from ftcalib.known import Known
from ftcalib.model import STANDARD_GRAVITY_M_S2, Parameters

FOUND = Parameters(
    R_flange_sensor=np.eye(3),
    gravity_force_base_N=np.array([0.0, 0.0, -10.0]),
    force_bias_N=np.zeros(3),
    p_sensor_com_m=np.zeros(3),
    torque_bias_Nm=np.zeros(3),
)
COVARIANCE = np.diag(np.square([*[0.002] * 3, *[0.01, 0.02, 0.05], *[0.1] * 9]))
"""Sigmas: 2 mrad of the mounting, 1, 2 and 5 mrad of the direction of gravity or 0.5 % of the weight."""


def contradicted(known: Known, sigmas: float, found: Parameters = FOUND) -> list[Finding]:
    return contradictions(known, found, COVARIANCE, STANDARD_GRAVITY_M_S2, sigmas)


@pytest.mark.parametrize("sigmas_off", [3.9, 4.1])
def test_a_mass_is_compared_in_sigmas_of_the_weight(sigmas_off: float) -> None:
    known = Known(mass_kg=(10 + sigmas_off * 0.05) / STANDARD_GRAVITY_M_S2)
    assert len(contradicted(known, 4)) == (sigmas_off > 4)


@pytest.mark.parametrize("sigmas_off", [3.9, 4.1])
@pytest.mark.parametrize(("axis", "sigma_rad"), [(0, 0.002), (1, 0.001)])
def test_a_direction_is_compared_in_sigmas_across_it(axis: int, sigma_rad: float, sigmas_off: float) -> None:
    turn = Rotation.from_rotvec(sigmas_off * sigma_rad * np.eye(3)[axis])
    known = Known(gravity_direction_base=turn.apply([0, 0, -1]))
    found = contradicted(known, 4)
    assert len(found) == (sigmas_off > 4)
    if found:
        assert found[0].values["off_deg"] == pytest.approx(np.degrees(sigmas_off * sigma_rad))
        assert found[0].values["sigma_deg"] == pytest.approx(np.degrees(sigma_rad), rel=1e-3)


@pytest.mark.parametrize("yaw_only", [False, True])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_mounting_is_compared_but_for_a_free_yaw(axis: int, yaw_only: bool) -> None:
    turn: NDArray[np.float64] = Rotation.from_rotvec(0.0082 * np.eye(3)[axis]).as_matrix()
    known = Known(R_flange_sensor=turn, yaw_only=yaw_only)
    assert len(contradicted(known, 4)) == (not (yaw_only and axis == 2))
    assert not contradicted(known, 4.2)


def test_a_unit_of_force_is_named() -> None:
    (finding,) = contradicted(Known(mass_kg=4.4482 / STANDARD_GRAVITY_M_S2 * 10), 4)
    assert finding.values["units"] == [["lbf", "N·m"]]


def test_agreement_is_no_contradiction() -> None:
    mass_kg = 10 / STANDARD_GRAVITY_M_S2
    known = Known(mass_kg=mass_kg, gravity_direction_base=(0, 0, -1), R_flange_sensor=np.eye(3))
    assert contradicted(known, 1e-6) == []
    lighter = replace(FOUND, gravity_force_base_N=np.array([0.0, 0.0, -5.0]))
    assert len(contradicted(known, 4, lighter)) == 1


def test_without_a_significant_weight_no_direction_is_compared() -> None:
    light = replace(FOUND, gravity_force_base_N=np.array([0.0, 0.0, -0.1]))
    askew = Rotation.from_rotvec([2.0, 0, 0]).as_matrix()
    known = Known(mass_kg=1.0, gravity_direction_base=(1, 0, 0), R_flange_sensor=askew)
    assert [one.code for one in contradicted(known, 4, light)] == ["known_mass"]


@pytest.mark.parametrize(
    ("turn_deg", "upwards", "corrections"),
    [
        (90.0, False, [["wrench", ["-y", "x", "z"]]]),
        (90.0, True, [["wrench", ["y", "-x", "-z"]]]),  # mirrored forces read like a weight that pulls upwards
        (95.0, False, [["wrench", ["-y", "x", "z"]]]),
        (96.5, False, []),
        (5.0, False, []),  # in the right order
        (45.0, False, []),
    ],
)
def test_axes_in_another_order_are_named(turn_deg: float, upwards: bool, corrections: list[object]) -> None:
    turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    down = np.array([0.0, 0, 10.0 if upwards else -10.0])
    mount = Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix()
    found = replace(FOUND, R_flange_sensor=mount @ turn, gravity_force_base_N=down)
    (finding,) = contradicted(Known(R_flange_sensor=mount), 4, found)
    assert (finding.code, finding.values["corrections"]) == ("known_mounting", corrections)
    assert finding.values["off_deg"] == pytest.approx(turn_deg)
    # Where only the turn about z is open, a tilt is no order of axes.
    flat = replace(FOUND, R_flange_sensor=Rotation.from_euler("x", 90, degrees=True).as_matrix())
    (finding,) = contradicted(Known(yaw_only=True), 4, flat)
    assert (finding.values["off_deg"], finding.values["corrections"]) == (pytest.approx(90), [])


@pytest.mark.parametrize(("off", "units"), [(1.03, [["lbf", "N·m"]]), (1.05, [])])
def test_a_unit_is_named_where_it_makes_the_masses_agree(off: float, units: list[object]) -> None:
    (finding,) = contradicted(Known(mass_kg=off * 4.4482216 * 10 / STANDARD_GRAVITY_M_S2), 4)
    assert finding.values["units"] == units
