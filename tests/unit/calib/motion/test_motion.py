"""Calibration from motion: the model against its derivatives and a simulated arm, and what may be wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult, Known, NotObservable
from ftcalib.errors import BadDataset
from ftcalib.model import Parameters
from ftcalib.motion.model import (
    SIZE,
    MovingLoad,
    lever_columns,
    motion_jacobian,
    turn_columns,
    wrench_of,
)
from ftcalib.motion.samples import Means, Motion, motion_rows
from ftcalib.motion.solve import solve_motion
from tests.moving_load import HOME, Array, Recorded, Truth, means_of, programme, record, sweep

TRUTH = Truth()
QUIET = Truth(noise=(0, 0), vibration=(0, 0), joint_noise_rad=0)
SWEEP_S = 9.0


@pytest.fixture(scope="module")
def swept() -> Recorded:
    return record(TRUTH, sweep(SWEEP_S), SWEEP_S, 1)


@pytest.fixture(scope="module")
def result(swept: Recorded) -> CalibrationResult:
    return solve_motion(*means_of(swept), height_m=TRUTH.height_m)


def load_of(truth: Truth, response: object = 0.0) -> MovingLoad:
    inertia = truth.inertia_kg_m2[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    static = Parameters(**truth.to_dict())
    return MovingLoad(static, 9.80665, inertia, truth.height_m, 0.0, np.zeros(11) + np.asarray(response))


def test_rows_follow_the_model_of_point_masses() -> None:
    wrench, poses = means_of(record(QUIET, sweep(SWEEP_S), SWEEP_S, 1))
    rows = motion_rows(wrench.result(), poses.result(), QUIET.delay_s)
    left = rows.wrench - wrench_of(load_of(QUIET), rows.motion)
    assert np.abs(left[:, :3]).max() < 2e-3
    assert np.abs(left[:, 3:]).max() < 2e-4


def test_jacobian_is_the_derivative() -> None:
    rng = np.random.default_rng(0)
    motion, rate = (Motion.of_columns(rng.standard_normal((4, 21))) for _ in range(2))
    load = load_of(TRUTH, 0.1 * rng.standard_normal(11))

    def read(step: np.ndarray) -> np.ndarray:
        moved = load.moved(step)
        return wrench_of(moved, motion.earlier(moved.delay_s, rate))

    steps = 1e-6 * np.eye(SIZE)
    numeric = np.stack([(read(step) - read(-step)) / 2e-6 for step in steps], axis=2)
    np.testing.assert_allclose(motion_jacobian(load, motion, rate), numeric, atol=1e-6)


def test_turns_and_lever_are_derivatives() -> None:
    rng = np.random.default_rng(1)
    columns, load = rng.standard_normal((4, 21)), load_of(TRUTH)
    columns[:, :9] = Rotation.random(4, rng).as_matrix().reshape(4, 9)
    motion = Motion.of_columns(columns)
    for axis, turn in enumerate(Rotation.from_rotvec(1e-6 * np.eye(3))):
        true = replace(motion, R_base_flange=motion.R_base_flange @ turn.as_matrix())
        numeric = (wrench_of(load, true) - wrench_of(load, motion)) / 1e-6
        np.testing.assert_allclose(turn_columns(load, motion)[:, :, axis], numeric, atol=1e-4)
        # The centre of mass of the torques stays, so they see only the force.
        static = replace(load.static, p_sensor_com_m=load.static.p_sensor_com_m + 1e-6 * np.eye(3)[axis])
        force = (wrench_of(replace(load, static=static), motion) - wrench_of(load, motion))[:, :3] / 1e-6
        expected = np.hstack([force, np.cross(load.static.p_sensor_com_m, force)])
        np.testing.assert_allclose(lever_columns(load, motion)[:, :, axis], expected, atol=1e-4)


@pytest.mark.slow
def test_a_sweep_gives_all_that_motion_shows(result: CalibrationResult) -> None:
    motion = result.motion
    assert motion is not None
    assert result.verdict == "good"
    assert abs(result.mass_kg - TRUTH.mass_kg) < 5e-4
    error = (motion.inertia_kg_m2 - TRUTH.inertia_kg_m2) / motion.sigma["inertia_kg_m2"]
    assert np.abs(error).max() < 4
    assert abs(motion.delay_s - TRUTH.delay_s) < 1e-4
    assert abs(motion.height_m - TRUTH.height_m) < 4 * float(motion.sigma["height_m"])
    step = Parameters(**TRUTH.to_dict()).difference(result.parameters) / np.sqrt(np.diag(result.covariance))
    assert np.abs(step).max() < 4


@pytest.mark.slow
def test_contact_is_left_out_and_listed() -> None:
    joints, stops = programme(4, 20.0)
    touched = {(start + 0.1, end): np.r_[0, 0, -6.0, 0.1, 0, 0] for start, end in stops[1::2]}
    result = solve_motion(*means_of(record(TRUTH, joints, 20.0, 4, contacts=touched)))
    motion = result.motion
    assert motion is not None
    assert result.verdict == "good"
    assert abs(result.mass_kg - TRUTH.mass_kg) < 5e-4
    starts = [start for start, _ in touched if start < 19]
    assert [one["t_s"] for one in motion.contacts] == pytest.approx(starts, abs=0.2)
    assert all(4 < one["force_N"] < 8 for one in motion.contacts)
    assert "contacts_left_out" in {one.code for one in result.findings}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda s: replace(s, t_pose_s=s.t_pose_s + 0.5), "clock_offset"),
        (lambda _: record(TRUTH, sweep(SWEEP_S, (0.17, 0.17, 0.17)), SWEEP_S, 1), "motion_narrow"),
    ],
)
def test_wrong_data_are_named(swept: Recorded, change: object, code: str) -> None:
    found = solve_motion(*means_of(change(swept)))  # type: ignore[operator]
    assert code in {one.code for one in found.findings if one.severity != "note"}
    assert found.verdict != "good"


@pytest.mark.slow
def test_another_rate_of_one_clock_is_named_and_undone(swept: Recorded) -> None:
    ratio = 1.02
    found = solve_motion(*means_of(replace(swept, t_s=3.0 + ratio * swept.t_s)))
    assert found.findings[0].code == "clocks_differ"
    assert found.findings[0].values["ratio"] == pytest.approx(ratio, rel=2e-3)
    assert not {"clock_offset", "clock_rate"} & {one.code for one in found.findings}


@pytest.mark.slow
def test_of_ten_poses_a_second_the_rests_count() -> None:
    """Fast moves between rests; the times of both streams are off by up to the jitter."""
    rng, jitter_s = np.random.default_rng(5), 0.04
    postures = HOME + rng.uniform(-1, 1, (12, 6)) * [0.4, 0.2, 0.2, 1.0, 1.0, 1.3]

    def joints(t: Array) -> Array:
        stop = np.clip(np.floor(t / 2.0).astype(int), 0, 10)
        x = np.clip((t - 2.0 * stop - 1.4) / 0.6, 0, 1)[:, None]
        return np.asarray(postures[stop] + (postures[stop + 1] - postures[stop]) * x**3 * (10 - 15 * x + 6 * x**2))

    whole = record(TRUTH, joints, 22.0, 2)
    t_s, t_pose_s = (t + rng.uniform(-jitter_s, jitter_s, len(t)) for t in (whole.t_s[::50], whole.t_pose_s[17::50]))
    poses = t_pose_s, whole.R_base_flange[17::50], whole.p_base_flange_m[17::50]
    found = solve_motion(*means_of(Recorded(t_s, whole.wrench[::50], *poses)))
    assert found.verdict == "usable"
    assert found.findings[0].code == "motion_coarse"
    assert found.mass_kg == pytest.approx(TRUTH.mass_kg, abs=2 * float(found.sigma["mass_kg"]))


def test_too_few_poses_without_rests_are_refused() -> None:
    fast = means_of(record(TRUTH, sweep(SWEEP_S, hz=(0.4, 0.6, 0.8)), SWEEP_S, 1, rates_Hz=(500.0, 10.0)))
    with pytest.raises(NotObservable, match=r"at rest for only .* s: record at 50 Hz"):
        solve_motion(*fast)


@pytest.mark.slow
def test_a_motion_about_one_axis_determines_nothing() -> None:
    with pytest.raises(NotObservable, match=r"last joint.*turn wrist 1"):
        solve_motion(*means_of(record(TRUTH, sweep(6.0, (0, 0, 1.5)), 6.0, 1)))


@pytest.mark.slow
def test_known_values_determine_what_the_motion_does_not() -> None:
    about_one_axis = record(TRUTH, sweep(SWEEP_S, (0.0, 1.3, 0.0)), SWEEP_S, 1)
    known = Known(R_flange_sensor=TRUTH.R_flange_sensor, gravity_direction_base=TRUTH.gravity_m_s2)
    found = solve_motion(*means_of(about_one_axis), known=known, point_mass=True)
    assert abs(found.mass_kg - TRUTH.mass_kg) < 0.01
    assert found.motion is not None
    assert not found.motion.inertia_kg_m2.any()


@pytest.mark.slow
def test_without_positions_slow_parts_count() -> None:
    joints, _ = programme(3, 25.0)
    found = solve_motion(*means_of(record(TRUTH, joints, 25.0, 3), positions=False))
    assert found.verdict == "usable"
    assert abs(found.mass_kg - TRUTH.mass_kg) < 5e-3
    assert "positions_missing" in {one.code for one in found.findings}


def test_means_are_those_of_all_pieces_together() -> None:
    rng = np.random.default_rng(0)
    t, values = np.sort(rng.uniform(0, 1, 997)), rng.standard_normal((997, 2))
    whole, pieces = Means(), Means()
    whole.add(t, values)
    for some in np.array_split(np.arange(997), 13):
        pieces.add(t[some], values[some])
    for one, other in zip(whole.result(), pieces.result(), strict=True):
        np.testing.assert_allclose(one, other)
    with pytest.raises(BadDataset, match="times decrease"):
        pieces.add(t[:1], values[:1])


def test_recordings_without_a_common_time_are_refused(swept: Recorded) -> None:
    with pytest.raises(BadDataset, match="overlap by"):
        solve_motion(*means_of(replace(swept, t_pose_s=swept.t_pose_s + 100)))
