"""What was mixed up is named, and undoing it helps."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import BadDataset, CalibrationDataset, CalibrationResult, Finding, NotObservable, Parameters, Setup, solve
from ftcalib.judge.faults import (
    EULER_ORDERS,
    broken_channels,
    faults,
    other_poses,
)
from ftcalib.known import Known
from ftcalib.model import Array, SPECIAL_R_flange_base, predict
from ftdrive import read_dataset

Sequence = Literal["xyz", "XYZ"]
SIGMA = np.repeat([0.05, 0.00125], 3)
SWAP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
CYCLE = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])


def session(seed: int, n: int = 11) -> tuple[Parameters, Array, Array]:
    rng = np.random.default_rng(seed)
    mount = Rotation.random(rng=rng).as_matrix()
    com = mount.T @ [0.015, -0.01, 0.08]  # outside the flange
    p = Parameters(mount, np.array([0.3, -0.2, -20.0]), 5 * rng.normal(size=3), com, 0.3 * rng.normal(size=3))
    R = np.asarray(Rotation.random(n, rng=rng).as_matrix())
    return p, R, np.asarray(predict(p, R) + SIGMA * rng.normal(size=(n, 6)))


def first(R: Array, wrench: Array, known: Known | None = None, payload_kg: float | None = None) -> Finding:
    """The first finding, or that of the refusal."""
    try:
        result = solved(R, wrench, known, payload_kg)
    except NotObservable as exc:
        return exc.finding or Finding("none", "note")
    assert result.verdict != "good"
    return result.findings[0]


def solved(R: Array, wrench: Array, known: Known | None = None, payload_kg: float | None = None) -> CalibrationResult:
    n = len(R)
    dataset = CalibrationDataset(R, wrench, None, np.zeros(n, np.int64), np.arange(float(n)))
    return solve(dataset, known=known, setup=Setup(payload_kg=payload_kg))


def angles_in(R: Array, order: Any) -> Array:
    """Angles about x, y and z as a program writes them that turns in this order."""
    return np.asarray(Rotation.from_matrix(R).as_euler(order)[:, [order.index(axis) for axis in "xyz"]])


def from_angles(angles: Array, order: str) -> Array:
    return np.asarray(Rotation.from_euler(order, angles[:, ["xyz".index(axis) for axis in order]]).as_matrix())


@pytest.mark.parametrize("written", EULER_ORDERS)
def test_any_order_of_euler_angles_is_named_from_the_one_that_was_read(written: str) -> None:
    _, R, wrench = session(2, 16)
    for read, spelled in (("xyz", "ZYX"), ("yzx", "yzx")):
        found = faults(from_angles(angles_in(R, written), read), wrench, written=spelled)
        said = [(one.code, one.values["order"], one.values["read_as"]) for one in found]
        assert said == [("euler_angles", written, spelled)] * (written != read)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["matrix", "quaternion", "vector", "joints", "xyz"])
def test_a_hypothesis_names_only_what_the_file_can_contain(form: str) -> None:
    _, R, wrench = session(1)
    possible = {
        "matrix": {"orientations_inverted", "euler_angles"},
        "quaternion": {"orientations_inverted", "quaternion_order"},
        "vector": {"orientations_inverted"},
        "joints": set[str](),
        "xyz": {"orientations_inverted", "euler_angles"},
    }[form]
    made = {
        "orientations_inverted": np.swapaxes(R, 1, 2),
        "quaternion_order": Rotation.from_quat(np.roll(Rotation.from_matrix(R).as_quat(), 1, axis=1)).as_matrix(),
        "euler_angles": from_angles(angles_in(R, "zyx"), "xyz"),
    }
    named = {one.code for turned in made.values() for one in faults(turned, wrench, written=form)}
    assert named & made.keys() == possible


def test_a_dataset_says_as_what_its_orientations_were_written() -> None:
    _, R, wrench = session(2, 12)
    read = from_angles(angles_in(R, "zyx"), "xyz")
    dataset = CalibrationDataset.of(read, wrench, meta={"form": "euler", "euler": "ZYX"})
    finding = solve(dataset).findings[0]
    assert (finding.code, finding.values["order"], finding.values["read_as"]) == ("euler_angles", "zyx", "ZYX")
    assert "--euler zyx" in finding.fix


def test_a_sensor_that_is_zeroed_before_each_move_reads_differences() -> None:
    _, R, wrench = session(3, 12)
    (finding,) = faults(R[1:], np.diff(wrench, axis=0))
    assert finding.code == "zeroed_each_pose"


@pytest.mark.slow
def test_equal_readings_of_a_simulator_do_not_hide_its_mistake() -> None:
    """Without noise, with the centre of mass on the axis, so that tz is 0, and orientations in steps of 30°."""
    angles = np.radians([180, 0, 0] + 30 * np.random.default_rng(1).integers(-2, 3, (16, 3)))
    R = Rotation.from_euler("xyz", angles).as_matrix()
    zero = np.zeros(3)
    wrench = predict(Parameters(np.eye(3), np.array([0.0, 0, -9.8]), zero, np.array([0.0, 0, 0.06]), zero), R)
    assert {one.code for one in broken_channels(wrench, R)} >= {"stuck_channels"}
    assert solved(R, wrench).verdict == "good"
    shuffled = Rotation.from_quat(np.roll(Rotation.from_matrix(R).as_quat(), 1, axis=1)).as_matrix()
    result = solved(shuffled, wrench)
    assert result.findings[0].code == "quaternion_order"
    assert "stuck_channels" not in {one.code for one in result.findings}


def test_a_channel_of_a_few_decimal_steps_is_not_saturated() -> None:
    _, R, wrench = session(5, 12)
    wrench[:, 5] = np.where(np.arange(12) % 4, 0.1, 0.101)
    assert "saturated" not in {one.code for one in broken_channels(np.round(wrench, 3), R)}


@pytest.mark.slow
def test_columns_of_force_and_torque_that_were_exchanged_are_named() -> None:
    _, R, wrench = session(1)
    assert first(R, np.roll(wrench, 3, axis=1)).code == "columns_swapped"


@pytest.mark.slow
def test_coarse_and_saturated_readings_are_named() -> None:
    _, R, wrench = session(1)
    coarse = first(R, np.round(wrench))
    assert (coarse.code, coarse.values["step_N"]) == ("quantised", 1)
    limit = np.sort(wrench[:, 0])[-4]
    wrench[:, 0] = np.minimum(wrench[:, 0], limit)
    saturated = first(R, wrench)
    rows = (np.flatnonzero(wrench[:, 0] == limit) + 1).tolist()
    assert (saturated.code, saturated.values["channel"], saturated.values["poses"]) == ("saturated", "fx", rows)


@pytest.mark.slow
def test_a_wrench_that_is_compensated_already_has_no_weight() -> None:
    p, R, wrench = session(1)
    left = wrench - 0.99 * (predict(p, R) - np.concatenate([p.force_bias_N, p.torque_bias_Nm]))
    assert first(R, left).code in {"weight_compensated", "weight_insignificant"}


def test_a_wrench_of_the_neighbouring_pose_is_named() -> None:
    _, R, wrench = session(3)
    finding = first(R[1:], wrench[:-1])
    assert (finding.code, finding.values["neighbour"]) == ("pairing_shifted", "before")


@pytest.mark.slow
def test_wrenches_of_other_poses_are_named() -> None:
    _, R, wrench = session(3)
    assert first(R, wrench[::-1]).code == "pairing_or_rotations"


@pytest.mark.parametrize(("rock_deg", "code"), [(2.0, "orientations_off"), (20.0, "pairing_or_rotations")])
def test_poses_that_rock_are_off_and_not_those_of_another_recording(rock_deg: float, code: str) -> None:
    p, R, _ = session(7, 12)
    rng = np.random.default_rng(3)
    rock = np.deg2rad(rock_deg) * rng.choice([-1, 1], (12, 3)) * [1, 1, 0] / np.sqrt(2)
    wrench = predict(p, Rotation.from_rotvec(rock).as_matrix() @ R) + 0.2 * SIGMA * rng.normal(size=(12, 6))
    (finding,) = other_poses(R, wrench)
    assert finding.code == code
    assert 0.7 < finding.values.get("turn_deg", 2.0) < 2.5


@pytest.mark.parametrize(("idle", "severity"), [(False, "reject"), (True, "limit")])
def test_torques_of_another_sensor_are_named(idle: bool, severity: str) -> None:
    _, R, wrench = session(8, 16)
    other, posed, _ = session(9, 16)
    noise = SIGMA[3:] * np.random.default_rng(1).normal(size=(16, 3))
    wrench[:, 3:] = noise if idle else predict(other, posed)[:, 3:]
    finding = first(R, wrench)
    assert (finding.code, finding.severity) == ("torques_unrelated", severity)


def test_a_load_balanced_on_the_sensor_is_near_and_its_torques_follow() -> None:
    p, R, _ = session(10, 16)
    balanced = replace(p, p_sensor_com_m=0.004 * p.p_sensor_com_m)
    wrench = predict(balanced, R) + 0.01 * SIGMA * np.random.default_rng(2).normal(size=(16, 6))
    assert first(R, wrench).code == "com_too_near"


def test_orientations_in_left_handed_axes_are_named() -> None:
    _, R, wrench = session(5)
    assert first(SWAP @ R @ SWAP, wrench).code == "forces_reversed"


@pytest.mark.slow
@pytest.mark.parametrize(("Q", "group"), [(SWAP, "torque"), (CYCLE, "force")])
def test_axes_that_disagree_are_named_with_their_order(Q: Array, group: str) -> None:
    _, R, wrench = session(4)
    part = slice(0, 3) if group == "force" else slice(3, 6)
    wrench[:, part] = wrench[:, part] @ Q.T
    finding = first(R, wrench)
    assert finding.code == "axes_disagree"
    assert [group, list("yxz" if Q is SWAP else "zxy")] in finding.values["corrections"]


def test_axes_permuted_in_both_are_named_where_the_mounting_is_known() -> None:
    p, R, wrench = session(4)
    turned = np.concatenate([part @ CYCLE.T for part in np.hsplit(wrench, 2)], axis=1)
    finding = first(R, turned, Known(R_flange_sensor=p.R_flange_sensor))
    assert (finding.code, finding.values["corrections"]) == ("known_mounting", [["wrench", ["z", "x", "y"]]])


@pytest.mark.slow
def test_a_mistake_is_named_before_known_values_that_it_contradicts() -> None:
    p, R, wrench = session(4)
    known = Known(R_flange_sensor=p.R_flange_sensor, mass_kg=2.04, mass_tolerance_kg=0.01)
    assert first(np.swapaxes(R, 1, 2), wrench, known).code == "orientations_inverted"


@pytest.mark.slow
def test_a_wrench_in_base_axes_is_named() -> None:
    p, R, wrench = session(5)
    turned = R @ p.R_flange_sensor
    in_base = np.concatenate([np.einsum("nij,nj->ni", turned, part) for part in (wrench[:, :3], wrench[:, 3:])], axis=1)
    assert first(R, in_base).code == "wrench_in_base"
    unbiased = predict(p, R) - np.concatenate([p.force_bias_N, p.torque_bias_Nm])
    in_base = np.concatenate([np.einsum("nij,nj->ni", turned, part) for part in np.hsplit(unbiased, 2)], axis=1)
    assert first(R, in_base + SIGMA * np.random.default_rng(1).normal(size=in_base.shape)).code == "constant_force"


@pytest.mark.slow
def test_a_channel_that_is_stuck_and_rows_that_were_copied_are_named() -> None:
    _, R, wrench = session(6)
    rows = np.append(np.arange(11), 3)
    copies = first(R[rows], wrench[rows])
    assert (copies.code, copies.values["poses"]) == ("repeated_poses", [4, 12])
    stale = wrench.copy()
    stale[7] = stale[6]
    stale_rows = first(R, stale)
    assert (stale_rows.code, stale_rows.values["poses"]) == ("repeated_wrenches", [7, 8])
    wrench[:, 4] = wrench[0, 4]
    assert first(R, wrench).values["channels"] == ["ty"]


LBF_N, KGF_N, LBF_IN_NM = 4.4482216, 9.80665, 0.11298483


@pytest.mark.slow
@pytest.mark.parametrize(
    ("force", "torque", "units"),
    [
        (LBF_N, 1.0, [["lbf", "N·m"], ["lbf", "lbf·ft"]]),
        (LBF_N, LBF_IN_NM, [["lbf", "lbf·in"]]),
        (KGF_N, KGF_N, [["kgf", "kgf·m"]]),
    ],
)
def test_a_force_in_other_units_is_named_where_mass_or_payload_is_known(
    force: float, torque: float, units: list[list[str]]
) -> None:
    p, R, wrench = session(7)
    mass_kg = float(np.linalg.norm(p.gravity_force_base_N)) / 9.80665
    wrench /= np.repeat([force, torque], 3)
    if len(units) == 2:
        finding = first(R, wrench, Known(mass_kg=mass_kg, mass_tolerance_kg=0.01))
        assert (finding.code, finding.values["units"]) == ("known_mass", units)
    finding = first(R, wrench, payload_kg=2.2)
    assert (finding.code, finding.values["units"]) == ("payload_units", units)
    assert finding.values["load_kg"] == pytest.approx(mass_kg / force, abs=0.01)


@pytest.mark.parametrize("payload_kg", [0.5, 2.0, 2.8, 5.0, 15.0])
def test_no_unit_is_suspected_where_another_does_not_explain_the_payload(payload_kg: float) -> None:
    _, R, wrench = session(7)
    result = solved(R, wrench, payload_kg=payload_kg)
    assert "payload_units" not in {one.code for one in result.findings}
    assert (result.verdict == "good") == (payload_kg in {2.0, 2.8})


def test_forces_and_torques_in_other_units_are_named_where_only_their_ratio_shows_it() -> None:
    _, R, wrench = session(7)
    both = first(R, wrench / np.repeat([LBF_N, LBF_IN_NM], 3))
    assert both.values["units"] == [["lbf", "lbf·in"], ["kgf", "kgf·cm"]]


def test_rotation_vectors_in_degrees_are_refused(tmp_path: Path) -> None:
    rows = "\n".join(f"{90 - k},{k},0,1,2,3,4,5,6" for k in range(6))
    (tmp_path / "poses.csv").write_text(f"rx,ry,rz,fx,fy,fz,tx,ty,tz\n{rows}\n")
    with pytest.raises(BadDataset, match="is in degrees, or three Euler angles"):
        read_dataset(tmp_path / "poses.csv")


@pytest.mark.parametrize("side", [1, -1])
def test_a_limit_is_one_that_three_poses_read(side: int) -> None:
    _, R, wrench = session(1)
    order = np.argsort(side * wrench[:, 4])[::-1]
    wrench[order[:2], 4] = wrench[order[0], 4]
    assert broken_channels(wrench, R) == []
    wrench[order[:3], 4] = wrench[order[0], 4]
    (finding,) = broken_channels(wrench, R)
    assert (finding.code, finding.values["channel"]) == ("saturated", "ty")
    assert finding.values["poses"] == sorted((order[:3] + 1).tolist())


def of_a_level_base(seed: int, decimals: int, steps: float, off_deg: float) -> tuple[Array, Array]:
    """The 24 orientations and rounded readings, in which poses with the same direction of gravity often tie."""
    rng = np.random.default_rng(seed)
    mount = np.eye(3) if seed % 2 else Rotation.random(rng=rng).as_matrix()
    down = Rotation.from_euler("xy", off_deg * np.array([0.5, 0.8]), degrees=True).apply([0.0, 0.0, -1.0])
    bias, com = rng.normal(size=(2, 3)) * [[15.0], [1.0]], rng.uniform(0.02, 0.1) * rng.normal(size=3)
    p = Parameters(mount, rng.uniform(5, 25) * down, bias[0], com, bias[1])
    R = np.swapaxes(SPECIAL_R_flange_base, 1, 2)
    wrench = predict(p, R) + steps * 10.0**-decimals * rng.normal(size=(24, 6))
    return R, np.round(wrench, decimals)


def test_readings_that_tie_because_they_are_rounded_are_neither_saturated_nor_copied() -> None:
    """None of 15 sets; noise of 0.3 to 3 steps, base 0 to 1 degree off."""
    wrong = []
    for seed in range(15):
        R, wrench = of_a_level_base(seed, 2, (0.3, 1.0, 3.0)[seed % 3], (0.0, 0.05, 0.1, 0.3, 1.0)[seed % 5])
        wrong += [(seed, one.code) for one in broken_channels(wrench, R) if one.code != "quantised"]
    assert wrong == []


def test_readings_without_noise_are_not_saturated() -> None:
    R, wrench = of_a_level_base(3, 15, 0.0, 0.0)
    result = solve(CalibrationDataset(R, wrench, None, np.zeros(24, np.int64), np.arange(24.0)))
    assert result.verdict != "rejected"
    assert not {one.code for one in result.findings} & {"saturated", "repeated_wrenches"}


def test_copied_rows_are_named_beside_rows_that_are_equal_by_right() -> None:
    R, wrench = of_a_level_base(1, 2, 0.0, 0.0)
    equal = [i for i in range(1, 24) if (wrench[i] == wrench[0]).all()]
    assert equal
    other = next(i for i in range(1, 24) if i not in equal)
    wrench[other] = wrench[0]
    found = [one for one in broken_channels(wrench, R) if one.code == "repeated_wrenches"]
    assert [one.values["poses"] for one in found] == [sorted([1, *(i + 1 for i in equal), other + 1])]
