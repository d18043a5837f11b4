"""What was mixed up is named, and undoing it helps."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import BadDataset, CalibrationDataset, CalibrationResult, NotObservable, Parameters, read_csv, solve
from ftcalib.known import Known
from ftcalib.model import Array, predict

SIGMA = np.repeat([0.05, 0.00125], 3)
SWAP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
CYCLE = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])


def session(seed: int, n: int = 12) -> tuple[Parameters, Array, Array]:
    rng = np.random.default_rng(seed)
    mount = Rotation.random(rng=rng).as_matrix()
    com = mount.T @ [0.015, -0.01, 0.08]  # outside the flange
    p = Parameters(mount, np.array([0.3, -0.2, -20.0]), 5 * rng.normal(size=3), com, 0.3 * rng.normal(size=3))
    R = np.asarray(Rotation.random(n, rng=rng).as_matrix())
    return p, R, np.asarray(predict(p, R) + SIGMA * rng.normal(size=(n, 6)))


def first(R: Array, wrench: Array, known: Known | None = None, payload_kg: float | None = None) -> str:
    """Give the first reason, or the refusal."""
    try:
        result = solved(R, wrench, known, payload_kg)
    except NotObservable as exc:
        return str(exc)
    assert result.verdict != "good"
    return result.reasons[0]


def solved(R: Array, wrench: Array, known: Known | None = None, payload_kg: float | None = None) -> CalibrationResult:
    n = len(R)
    dataset = CalibrationDataset(R, wrench, None, np.zeros(n, np.int64), np.arange(float(n)))
    return solve(dataset, known=known, payload_kg=payload_kg)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(("shift", "says"), [(1, "(w, x, y, z) that were read"), (-1, "(x, y, z, w) that were read")])
def test_the_order_of_quaternions_is_named_and_not_called_inverted(shift: int, says: str, seed: int) -> None:
    p, R, wrench = session(seed)
    quaternions = Rotation.from_matrix(R).as_quat()
    reason = first(Rotation.from_quat(np.roll(quaternions, shift, axis=1)).as_matrix(), wrench)
    assert says in reason
    assert "inverted" not in reason
    assert solved(R, wrench).mass_kg == pytest.approx(np.linalg.norm(p.gravity_force_base_N) / 9.80665, rel=0.01)


@pytest.mark.parametrize("by", [1, -1])
def test_a_wrench_of_the_neighbouring_pose_is_named(by: int) -> None:
    _, R, wrench = session(3)
    R, wrench = (R[1:], wrench[:-1]) if by > 0 else (R[:-1], wrench[1:])
    assert f"that of the pose {'before' if by > 0 else 'after'} it" in first(R, wrench)


@pytest.mark.parametrize("order", ["reverse", "two before", "any"])
def test_wrenches_of_other_poses_are_named(order: str) -> None:
    _, R, wrench = session(3)
    n = len(R)
    rows = {"reverse": np.arange(n)[::-1], "two before": np.roll(np.arange(n), 2)}
    wrench = wrench[rows.get(order, np.random.default_rng(1).permutation(n))]
    assert "wrenches are paired with other poses" in first(R, wrench)


def test_two_exchanged_poses_are_rejected_and_not_called_a_wrong_pairing() -> None:
    _, R, wrench = session(3, 24)
    wrench[[4, 5]] = wrench[[5, 4]]
    reasons = " | ".join(solved(R, wrench).reasons)
    assert "repeat 5, 6" in reasons
    assert "other poses" not in reasons


def test_roll_pitch_and_yaw_that_were_read_as_a_rotation_vector_are_named() -> None:
    _, R, wrench = session(4)
    angles = Rotation.from_matrix(R).as_euler("xyz")
    assert "orientations have another form (Euler angles" in first(Rotation.from_rotvec(angles).as_matrix(), wrench)


@pytest.mark.parametrize("S", [np.diag([1.0, -1, 1]), SWAP])
def test_orientations_in_left_handed_axes_are_named(S: Array) -> None:
    _, R, wrench = session(5)
    assert "the orientations are mirrored (left-handed axes)" in first(S @ R @ S, wrench)


@pytest.mark.parametrize(
    ("force", "torque", "says"),
    [
        (1e-3, 1e-3, "as with forces in mN and torques in N·mm: check"),
        (1e-3, 1.0, "as with forces in mN: check"),
        (1e3, 1e3, "as with forces in kN and torques in kN·m: check"),
        (1e3, 1.0, "or forces in kN: check"),
    ],
)
def test_a_factor_of_1000_is_named_without_a_known_mass(force: float, torque: float, says: str) -> None:
    p, R, wrench = session(7)
    wrench /= np.repeat([force, torque], 3)
    assert says in first(R, wrench)
    mass_kg = float(np.linalg.norm(p.gravity_force_base_N)) / 9.80665
    unit = "mN" if force < 1 else "kN"
    assert f"forces in {unit}" in first(R, wrench, payload_kg=mass_kg)
    assert f"forces in {unit}" in first(R, wrench, Known(mass_kg=mass_kg, mass_tolerance_kg=0.01))


@pytest.mark.parametrize("Q", [SWAP, CYCLE])
@pytest.mark.parametrize("group", ["force", "torque"])
def test_axes_that_disagree_are_named_with_their_order(Q: Array, group: str) -> None:
    _, R, wrench = session(4)
    part = slice(0, 3) if group == "force" else slice(3, 6)
    wrench[:, part] = wrench[:, part] @ Q.T
    reason = first(R, wrench)
    assert "axes disagree" in reason
    order = "(y, x, z)" if Q is SWAP else "(z, x, y)"
    assert f"{group} x, y, z taken from {order}" in reason


@pytest.mark.parametrize(("Q", "order"), [(SWAP, "(y, x, z)"), (CYCLE, "(z, x, y)")])
def test_axes_permuted_in_both_are_named_where_the_mounting_is_known(Q: Array, order: str) -> None:
    p, R, wrench = session(4)
    turned = np.concatenate([part @ Q.T for part in np.hsplit(wrench, 2)], axis=1)
    reason = first(R, turned, Known(R_flange_sensor=p.R_flange_sensor))
    assert "known values contradict the data: mounting" in reason
    assert f"as with wrench x, y, z taken from {order}" in reason
    askew = p.R_flange_sensor @ Rotation.from_rotvec([0, 0, 30], degrees=True).as_matrix()
    assert "taken from" not in first(R, wrench, Known(R_flange_sensor=askew))


def test_a_wrong_mounting_is_named_where_it_leaves_no_weight() -> None:
    p, R, wrench = session(6)
    turned = np.concatenate([part @ CYCLE.T for part in np.hsplit(wrench, 2)], axis=1)
    known = Known(R_flange_sensor=p.R_flange_sensor)
    with pytest.raises(NotObservable, match=r"contradict the data: mounting .* from \(z, x, y\)") as refused:
        solved(R, turned, known)
    assert "do not determine" in str(refused.value.__cause__)
    still = np.tile(wrench[0], (len(R), 1)) + SIGMA * np.random.default_rng(0).normal(size=wrench.shape)
    assert "hang something heavier" in first(R, still, known)


def test_a_mistake_is_named_before_known_values_that_it_contradicts() -> None:
    p, R, wrench = session(4)
    known = Known(R_flange_sensor=p.R_flange_sensor, mass_kg=2.04, mass_tolerance_kg=0.01)
    assert "inverted" in first(np.swapaxes(R, 1, 2), wrench, known)
    stuck = wrench.copy()
    stuck[:, 1] = stuck[0, 1]
    assert "stuck" in first(R, stuck, known)


def test_a_wrench_in_base_axes_is_named() -> None:
    p, R, wrench = session(5)
    turned = R @ p.R_flange_sensor
    in_base = np.concatenate([np.einsum("nij,nj->ni", turned, part) for part in (wrench[:, :3], wrench[:, 3:])], axis=1)
    assert "base axes" in first(R, in_base)
    unbiased = predict(p, R) - np.concatenate([p.force_bias_N, p.torque_bias_Nm])
    in_base = np.concatenate([np.einsum("nij,nj->ni", turned, part) for part in np.hsplit(unbiased, 2)], axis=1)
    assert "base axes" in first(R, in_base + SIGMA * np.random.default_rng(1).normal(size=in_base.shape))


def test_a_channel_that_is_stuck_and_rows_that_were_copied_are_named() -> None:
    _, R, wrench = session(6)
    rows = np.append(np.arange(12), 3)
    assert "poses 4, 13 have identical wrenches and orientations" in first(R[rows], wrench[rows])
    stale = wrench.copy()
    stale[7] = stale[6]
    assert "poses 7, 8 have identical wrenches in different orientations" in first(R, stale)
    wrench[:, 4] = wrench[0, 4]
    assert "ty reads the same in all poses" in first(R, wrench)


def test_a_stuck_channel_is_named_before_the_drift_that_it_makes_up() -> None:
    _, R, wrench = session(1)
    wrench[:, 5] = wrench[0, 5]
    assert "tz reads the same in all poses" in first(R, wrench)


LBF_N, KGF_N, LBF_IN_NM = 4.4482216, 9.80665, 0.11298483


@pytest.mark.parametrize(
    ("force", "torque", "units"),
    [
        (LBF_N, 1.0, "forces in lbf, or forces in lbf and torques in lbf·ft"),
        (KGF_N, 1.0, "forces in kgf"),
        (LBF_N, LBF_IN_NM, "forces in lbf and torques in lbf·in"),
        (KGF_N, KGF_N, "forces in kgf and torques in kgf·m"),
    ],
)
def test_a_force_in_other_units_is_named_where_mass_or_payload_is_known(
    force: float, torque: float, units: str
) -> None:
    p, R, wrench = session(7)
    mass_kg = float(np.linalg.norm(p.gravity_force_base_N)) / 9.80665
    wrench /= np.repeat([force, torque], 3)
    assert f", as with {units})" in first(R, wrench, Known(mass_kg=mass_kg, mass_tolerance_kg=0.01))
    reason = first(R, wrench, payload_kg=2.2)
    assert reason.startswith(f"the load is {mass_kg / force:.2f} kg, but 2.20 kg by the payload")
    assert f", as with {units}: check" in reason


@pytest.mark.parametrize("payload_kg", [0.5, 2.0, 2.8, 5.0, 15.0])
def test_no_unit_is_suspected_where_another_does_not_explain_the_payload(payload_kg: float) -> None:
    _, R, wrench = session(7)
    assert solved(R, wrench, payload_kg=payload_kg).verdict == "good"


def test_forces_and_torques_in_other_units_are_named_where_only_their_ratio_shows_it() -> None:
    _, R, wrench = session(7)
    both = first(R, wrench / np.repeat([LBF_N, LBF_IN_NM], 3))
    assert "as with forces in lbf and torques in lbf·in, or forces in kgf and torques in kgf·cm: check" in both


def test_reversed_torques_are_usable_at_best() -> None:
    _, R, wrench = session(8)
    wrench[:, 3:] *= -1
    assert "torques are reversed" in first(R, wrench)


def test_a_drift_is_named_with_its_size() -> None:
    _, R, wrench = session(9, 24)
    wrench[:, 2] += np.linspace(-1, 1, 24)
    assert "the bias drifted by 2" in first(R, wrench)


def test_rotation_vectors_in_degrees_are_refused(tmp_path: Path) -> None:
    rows = "\n".join(f"{90 - k},{k},0,1,2,3,4,5,6" for k in range(6))
    (tmp_path / "poses.csv").write_text(f"rx,ry,rz,fx,fy,fz,tx,ty,tz\n{rows}\n")
    with pytest.raises(BadDataset, match="look like degrees"):
        read_csv(tmp_path / "poses.csv")


def test_nothing_is_named_in_sound_sessions() -> None:
    for seed in range(10, 16):
        _, R, wrench = session(seed)
        result = solved(R, wrench)
        assert result.verdict == "good"
        assert not any(word in " ".join(result.reasons) for word in ("looks", "look", "disagree", "reversed"))
