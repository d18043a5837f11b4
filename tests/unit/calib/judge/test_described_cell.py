"""A result that contradicts the described cell is usable at best, and its findings say why."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Known, Parameters, Setup, solve
from ftcalib.findings import Finding
from ftcalib.judge.described_cell import _OTHER_ORDERS, contradictions, directions, lean_from, payload, tool
from ftcalib.model import STANDARD_GRAVITY_M_S2, predict
from ftcalib.poses.information import special

Array = NDArray[np.float64]

SIGMA = np.repeat([0.01, 0.0005], 3)
R_FLANGE_SENSOR = Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix()
COM_FLANGE_M = np.array([0.012, -0.005, 0.06])
"""From the sensor, which is 40 mm above the flange."""
WEIGHT_N = 15.0
LOAD_KG = WEIGHT_N / 9.80665
TOOL: dict[str, Any] = {"cylinders_m": [(0.0, 0.16, 0.08)], "sensor_height_m": 0.04, "up_in_base": (0, 0, 1)}


def session(
    mass_factor: float = 1.0, com_factor: float = 1.0, down: tuple[float, ...] = (0, 0, -1)
) -> CalibrationDataset:
    F_b, com_m = WEIGHT_N * mass_factor * np.array(down), com_factor * R_FLANGE_SENSOR.T @ COM_FLANGE_M
    truth = Parameters(R_FLANGE_SENSOR, F_b, np.array([1.0, 2, 3]), com_m, np.array([0.1, 0.2, 0.3]))
    R = special(range(1, 25))
    wrench = predict(truth, R) + SIGMA * np.random.default_rng(3).normal(size=(24, 6))
    return CalibrationDataset(R, wrench, np.tile(np.diag(SIGMA**2), (24, 1, 1)), np.full(24, 100), np.arange(24.0))


@cache
def sound() -> CalibrationDataset:
    return session()


def codes(result: CalibrationResult) -> list[str]:
    return [one.code for one in result.findings]


# ---------------------------------------------------------------------------------------------- directions of a session


def test_an_inverted_quaternion_in_another_order_is_not_good_unless_its_mounting_is_declared() -> None:
    data = sound()
    quaternions = Rotation.from_matrix(np.swapaxes(data.R_base_flange, 1, 2)).as_quat()
    R = Rotation.from_quat(np.roll(quaternions, 1, axis=1)).as_matrix()
    wrong = CalibrationDataset(R, data.wrench, data.wrench_cov, data.n_samples, data.t_s)
    result = solve(wrong)
    assert (result.verdict, codes(result)[0]) == ("usable", "mounting_undeclared")
    fix = result.findings[0].fix
    assert "mounting" in fix
    assert "rotations" in fix
    declared = solve(wrong, setup=Setup(up_in_base=tuple(-result.gravity_force_base_N)))
    assert declared.verdict == "good"


@pytest.mark.parametrize(
    ("up", "heading_deg"), [((0, 0, 1), 0), ((0, 0, -1), 100), ((1, 0, 0), 205), ((0.5, 0, 0.866), 315)]
)
def test_the_low_side_is_named(up: tuple[float, ...], heading_deg: float) -> None:
    # Tip the mounted base over the horizontal direction `heading` of the world, as a floor that gives way there.
    other = np.array([0.0, 1.0, 0.0])
    R_world_mounted = np.array([np.cross(other, up), other, up])
    heading = np.radians(heading_deg)
    hinge = np.cross([0, 0, 1], [np.cos(heading), np.sin(heading), 0])
    R_world_base = Rotation.from_rotvec(np.radians(0.8) * hinge).as_matrix() @ R_world_mounted
    lean = lean_from(-np.array(up, dtype=float), R_world_base.T @ [0, 0, -12.0], np.eye(3) * 1e-6)
    assert lean.is_significant
    assert lean.deg == pytest.approx(0.8, abs=0.01)
    side = sum((-1 if name[0] == "-" else 1) * np.eye(3)["xyz".index(name[1])] for name in lean.side.split(" and "))
    # A point on that side has sunk from where a true mounting would have it, nearly as far as any point could.
    sunk = (R_world_mounted @ side - R_world_base @ side)[2] / np.linalg.norm(side)
    assert sunk > np.cos(np.radians(31)) * np.sin(np.radians(0.8))


@pytest.mark.parametrize(("shift", "order"), [(1, "w, x, y, z"), (-1, "x, y, z, w")])
def test_orientations_in_another_order_and_inverted_are_turned_by_fixed_rotations(shift: int, order: str) -> None:
    true = Rotation.random(5, rng=0).as_matrix()
    as_read = Rotation.from_quat(np.roll(Rotation.from_matrix(true).as_quat(), shift, axis=1)).inv().as_matrix()
    U = _OTHER_ORDERS[order]
    V = (U @ as_read[0]).T @ true[0]
    np.testing.assert_allclose(U @ as_read @ V, true, atol=1e-12)


NO_LEAN = Parameters(np.eye(3), np.array([0.0, 0, -20]), np.zeros(3), np.array([0.0, 0, 0.05]), np.zeros(3))
CERTAIN = np.diag(np.repeat(1e-12, 15))


def tilted(angle_deg: float) -> Parameters:
    angle = np.radians(angle_deg)
    return replace(NO_LEAN, gravity_force_base_N=20 * np.array([0.0, np.sin(angle), -np.cos(angle)]))


@pytest.mark.parametrize(
    ("off_deg", "undeclared", "declared"),
    [
        (0.1, None, None),
        (0.3, None, "base_leans"),
        (10.1, "gravity_tilted", "gravity_off_mounting"),
        (60.1, "mounting_undeclared", "gravity_off_mounting"),
        (135.1, "weight_upwards", "weight_upwards"),
    ],
)
def test_gravity_off_the_mounting_is_named_by_its_angle(
    off_deg: float, undeclared: str | None, declared: str | None
) -> None:
    for setup, code in ((Setup(), undeclared), (Setup(up_in_base=(0, 0, 2)), declared)):
        found = directions(tilted(off_deg), CERTAIN, setup)
        assert [one.code for one in found] == [code] * (code is not None)
        for one in found:
            assert one.values["lean_deg" if code == "base_leans" else "off_deg"] == pytest.approx(off_deg)
            if "direction" in one.values:
                np.testing.assert_allclose(one.values["direction"], tilted(off_deg).gravity_force_base_N / 20)


@pytest.mark.parametrize(
    ("inside_m", "aside_m", "sigma_m", "reversed_torques"),
    [
        (0.009, 0.005, 1e-6, False),
        (0.011, 0.005, 1e-6, True),
        (0.1, 0.099, 1e-6, True),
        (0.1, 0.101, 1e-6, False),
        (0.51, 0.2, 1e-6, False),
    ],
)
def test_a_centre_of_mass_behind_the_sensor_but_not_beside_it_shows_reversed_torques(
    inside_m: float, aside_m: float, sigma_m: float, reversed_torques: bool
) -> None:
    mount = Rotation.from_rotvec([0.5, -0.2, 0.4]).as_matrix()
    com_flange_m = [0.6 * aside_m, -0.8 * aside_m, -inside_m]
    behind = replace(NO_LEAN, R_flange_sensor=mount, p_sensor_com_m=mount.T @ com_flange_m)
    covariance = CERTAIN.copy()
    covariance[9:12, 9:12] = mount.T @ np.diag([1.0, 1.0, sigma_m**2]) @ mount
    found = directions(behind, covariance, Setup())
    assert [one.code for one in found] == ["torques_reversed"] * reversed_torques
    if found:
        assert found[0].values["inside_mm"] == pytest.approx(1e3 * inside_m)
    upwards = replace(behind, gravity_force_base_N=np.array([0.0, 0, 20]))
    (found_up,) = directions(upwards, covariance, Setup())
    assert found_up.code == ("forces_reversed" if reversed_torques or inside_m > 0.5 else "weight_upwards")


# ------------------------------------------------------------------------------------------------------------- the tool


@pytest.mark.parametrize(
    ("load_kg", "tool_kg", "sigma_kg", "code"),
    [
        (0.29, 0.2, 0.0, None),
        (0.31, 0.2, 0.0, "tool_mass_mismatch"),
        (1.79, 1.0, 0.2, None),
        (1.81, 1.0, 0.2, "tool_mass_mismatch"),
        (0.07, 1.0, 0.0, "weight_compensated"),  # a remainder
        (0.14, 1.0, 0.0, "tool_mass_mismatch"),
    ],
)
def test_a_mass_is_compared_with_that_of_the_tool(
    load_kg: float, tool_kg: float, sigma_kg: float, code: str | None
) -> None:
    weight = replace(NO_LEAN, gravity_force_base_N=9.8 * load_kg * np.array([0.6, 0, -0.8]))
    across = np.array([0.8, 0, 0.6])
    covariance = CERTAIN.copy()
    covariance[3:6, 3:6] += 100 * np.outer(across, across)
    covariance[3:6, 3:6] += (9.8 * sigma_kg) ** 2 * np.outer([0.6, 0, -0.8], [0.6, 0, -0.8])
    found = tool(weight, covariance, Setup(tool_mass_kg=tool_kg), 9.8)
    assert [one.code for one in found] == [code] * (code is not None)
    if code == "tool_mass_mismatch":
        assert found[0].values["load_kg"] == pytest.approx(load_kg)
        assert found[0].values["units"] == []
    elif code:
        assert found[0].values["weight_N"] == pytest.approx(9.8 * load_kg)


@pytest.mark.parametrize(
    "setup",
    [
        Setup(**TOOL | {"sensor_height_m": None}),
        Setup(tool_mass_kg=1.4, payload_kg=1.7),
        Setup(tool_mass_kg=1.25 * LOAD_KG),
    ],
)
def test_a_result_that_agrees_with_the_cell_is_good(setup: Setup) -> None:
    assert solve(sound(), setup=setup).findings == ()


@pytest.mark.parametrize(
    ("cylinder", "height_m", "outside_mm"),
    [
        ((0.0, 0.07, 0.08), 0.04, 30),  # beyond the tip
        ((0.0, 0.07, 0.08), None, 0),  # the sensor may be at the flange face
        ((0.0, 0.16, 0.08, 0.072, -0.005), 0.04, 20),  # beside it
        ((0.12, 0.16, 0.08), 0.04, 20),  # below it
        ((0.0, 0.095, 0.08), 0.04, 0),  # within the margin
    ],
)
def test_a_centre_of_mass_outside_the_described_tool_is_named(
    cylinder: tuple[float, ...], height_m: float | None, outside_mm: float
) -> None:
    result = solve(sound(), setup=Setup(cylinders_m=[cylinder], sensor_height_m=height_m))
    assert codes(result) == ["com_outside_tool"] * bool(outside_mm)
    if outside_mm:
        values = result.findings[0].values
        assert result.verdict == "usable"
        assert values["outside_mm"] == pytest.approx(outside_mm, abs=1)
        from_m = 0.0 if height_m is None else height_m
        np.testing.assert_allclose(values["com_mm"], 1e3 * np.add(COM_FLANGE_M, (0, 0, from_m)), atol=0.5)


def test_a_centre_of_mass_between_two_cylinders_is_inside_their_hull() -> None:
    fingers = [(0.0, 0.2, 0.02, 0.04, 0.0), (0.0, 0.2, 0.02, -0.04, 0.0), (0.0, 0.04, 0.08)]
    assert solve(sound(), setup=Setup(cylinders_m=fingers, sensor_height_m=0.04)).verdict == "good"


def test_a_centre_of_mass_far_outside_is_rejected_and_units_are_named() -> None:
    far = session(com_factor=4.448)
    result = solve(far, setup=Setup(**TOOL))
    assert (result.verdict, codes(result)[0]) == ("rejected", "com_outside_tool")
    assert ["lbf", "N·m"] in result.findings[0].values["units"]
    undescribed = solve(far)
    assert (undescribed.verdict, undescribed.findings[0].code) == ("usable", "com_too_far")


def test_reversed_torques_come_before_what_they_put_outside() -> None:
    result = solve(session(com_factor=-1), setup=Setup(**TOOL | {"cylinders_m": [(0.04, 0.16, 0.08)]}))
    assert (result.verdict, codes(result)) == ("usable", ["torques_reversed"])


@pytest.mark.slow
def test_torques_about_the_tcp_are_not_only_called_reversed() -> None:
    """The tool is too short for a centre of mass that reversed torques would have 90 mm from the sensor."""
    data = session()
    about_tcp = R_FLANGE_SENSOR.T @ [0.0, 0.0, 0.15]
    torque = data.wrench[:, 3:] - np.cross(about_tcp, data.wrench[:, :3])
    moved = replace(data, wrench=np.concatenate([data.wrench[:, :3], torque], axis=1))
    result = solve(moved, setup=Setup(**TOOL | {"cylinders_m": [(0.0, 0.11, 0.08)]}))
    assert (result.verdict, codes(result)[0]) == ("usable", "torques_about_point")
    assert result.findings[0].values["inside_mm"] == pytest.approx(90, abs=2)
    assert "--wrench-frame tcp --tcp" in result.findings[0].fix
    assert "reverse" not in result.findings[0].fix


@pytest.mark.parametrize(("load_kg", "found"), [(1.07, []), (0.91, ["tool_mass_mismatch"])])
def test_a_weighed_tool_is_compared_within_the_gain_of_the_sensor(load_kg: float, found: list[str]) -> None:
    weight = replace(NO_LEAN, gravity_force_base_N=9.8 * load_kg * np.array([0.6, 0, -0.8]))
    weighed = tool(weight, CERTAIN, Setup(tool_mass_kg=1.0, tool_mass_sigma_kg=0.002), 9.8)
    assert [one.code for one in weighed] == found


def test_only_quaternions_can_have_been_read_in_another_order() -> None:
    on_wall = replace(NO_LEAN, gravity_force_base_N=np.array([-20.0, 0, 0]))
    said = {form: directions(on_wall, CERTAIN, Setup(), form)[0].fix for form in ("quaternion", "", "matrix", "xyz")}
    assert [form for form, words in said.items() if "quaternions" in words] == ["quaternion", ""]


# ---------------------------------------------------------------------------------------------------------- the payload


@pytest.mark.parametrize(
    ("payload_kg", "load_kg", "sensor_kg", "fits"),
    [
        (1.50, 0.64, None, False),  # 0.86 kg off, which no usual sensor explains
        (1.40, 0.64, 0.1, False),
        (0.20, 0.64, None, True),  # smaller by the limit: a sensor cannot weigh less than nothing
        (6.4, 5.0, 0.1, True),  # 30 %
        (6.7, 5.0, 0.1, False),
    ],
)
def test_a_payload_is_compared_with_all_that_hangs_on_the_flange(
    payload_kg: float, load_kg: float, sensor_kg: float | None, fits: bool
) -> None:
    found = payload(payload_kg, load_kg, sensor_kg)
    assert (found == []) is fits
    if not fits:
        assert (found[0].code, found[0].values["set_kg"]) == ("payload_mismatch", load_kg + (sensor_kg or 0))
        assert ("[sensor] mass_kg" in found[0].fix) is (sensor_kg is None)


@pytest.mark.parametrize("sensor_kg", [None, 0.3])
def test_no_payload_is_advised_that_would_be_right_in_pounds(sensor_kg: float | None) -> None:
    (finding,) = payload(1.5 + (sensor_kg or 0), 1.5 / 4.448, sensor_kg)
    assert (finding.code, finding.values["units"]) == ("payload_units", [["lbf", "N·m"]])


def test_payload_and_lean_limit_and_accompany_a_result() -> None:
    data = session(down=(np.sin(0.018), 0.0, -np.cos(0.018)))
    result = solve(data, setup=Setup(payload_kg=3.0, sensor_mass_kg=0.4, up_in_base=(0, 0, 1)))
    assert (result.verdict, codes(result)) == ("usable", ["payload_mismatch", "base_leans"])
    lean = result.findings[1].values
    assert (lean["lean_deg"], lean["side"]) == (pytest.approx(1.03, abs=0.04), "+x")


def test_a_setup_is_checked() -> None:
    for wrong in ({"up_in_base": (0, 0, 0)}, {"up_in_base": (0, 1)}, {"cylinders_m": [(0.0, 0.1)]}):
        with pytest.raises(ValueError, match=r"expected three numbers|give start, end"):
            Setup(**wrong)


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


@pytest.mark.parametrize(("axis", "yaw_only"), [(2, False), (0, True), (2, True)])
def test_a_mounting_is_compared_but_for_a_free_yaw(axis: int, yaw_only: bool) -> None:
    turn: NDArray[np.float64] = Rotation.from_rotvec(0.0082 * np.eye(3)[axis]).as_matrix()
    known = Known(R_flange_sensor=turn, yaw_only=yaw_only)
    assert len(contradicted(known, 4)) == (not (yaw_only and axis == 2))
    assert not contradicted(known, 4.2)


def test_a_unit_of_force_is_named() -> None:
    (finding,) = contradicted(Known(mass_kg=4.4482 / STANDARD_GRAVITY_M_S2 * 10), 4)
    assert finding.values["units"] == [["lbf", "N·m"]]


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
        (96.5, False, []),
        (5.0, False, []),  # in the right order
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
