"""Which numbers a table means: orientations, times, units, frames, and what the numbers themselves show."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import BadDataset, Known, solve
from ftcalib.data.dataset import Orientation
from ftdrive.runs.source import _forward
from ftdrive.tables.table import Table, TableOptions
from tests.unit.ftdrive.tables.test_layouts import POSES, RECORDING, columns, quaternion, t, wrench

MATRIX = "r11 r12 r13 r21 r22 r23 r31 r32 r33"
IDENTITY = "1,0,0,0,1,0,0,0,1"
ROW = ",".join([*MATRIX.split(), "fx,fy,fz,tx,ty,tz"])


def csv(tmp_path: Path, *lines: str) -> Table:
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return Table(path)


def test_a_matrix_is_row_major_and_orientation_defines_the_mapping(tmp_path: Path) -> None:
    table = csv(tmp_path, ROW, "0,-1,0,1,0,0,0,0,1,1,2,3,4,5,6")  # x goes to y
    data = table.dataset()
    np.testing.assert_array_equal(data.R_base_flange[0] @ [1, 0, 0], [0, 1, 0])
    np.testing.assert_array_equal(table.dataset("R_flange_base").R_base_flange[0] @ [0, 1, 0], [1, 0, 0])
    np.testing.assert_array_equal(data.wrench, [[1, 2, 3, 4, 5, 6]])
    assert data.wrench_cov is None
    assert np.isnan(data.t_s).all()
    assert data.n_samples.tolist() == [0]
    with pytest.raises(ValueError, match="orientation is 'x'"):
        table.dataset("x")  # type: ignore[arg-type]  # the point of the test


@pytest.mark.parametrize("orientation", ["R_base_flange", "R_flange_base"])
def test_quaternion_and_vector_are_those_of_the_matrix(orientation: Orientation) -> None:
    poses = Rotation.random(5, rng=1)
    forms = {MATRIX: poses.as_matrix().reshape(5, 9), "qx qy qz qw": poses.as_quat(), "rx ry rz": poses.as_rotvec()}
    free = columns("fx fy fz tx ty tz", np.ones((5, 6)))
    read = [Table(free | columns(*form)).dataset(orientation).R_base_flange for form in forms.items()]
    expected = poses if orientation == "R_base_flange" else poses.inv()
    np.testing.assert_allclose(read, [expected.as_matrix()] * 3, atol=1e-12)


def test_standard_errors_become_the_covariance(tmp_path: Path) -> None:
    sigmas = "sigma_fx,sigma_fy,sigma_fz,sigma_tx,sigma_ty,sigma_tz"
    data = csv(tmp_path, f"{sigmas},{ROW},t", f".1,.2,.3,.01,.02,.03,{IDENTITY},1,2,3,4,5,6,7").dataset()
    assert data.wrench_cov is not None
    np.testing.assert_allclose(data.wrench_cov[0], np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2)
    np.testing.assert_array_equal(data.wrench, [[1, 2, 3, 4, 5, 6]])
    with pytest.raises(BadDataset, match="lacks sigma_tz"):
        csv(tmp_path, f"{sigmas[:-9]},{ROW}", f".1,.2,.3,.01,.02,{IDENTITY},1,2,3,4,5,6").dataset()


@pytest.mark.parametrize(("R", "words"), [("2,0,0,0,1,0,0,0,1", "row 2"), ("1,0,0,0,1,0,0,0,-1", "reflection")])
def test_a_matrix_that_is_no_rotation_is_named(R: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(BadDataset, match=rf"^poses\.csv: row 2: .*{words.removeprefix('row 2')}"):
        csv(tmp_path, ROW, f"{IDENTITY},1,2,3,4,5,6", f"{R},1,2,3,4,5,6").dataset()


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1, -1])
def test_an_imu_on_the_tool_serves_as_orientation(sign: int) -> None:
    up = POSES.R.inv().apply([0.0, 0.0, 1.0])
    names = "imu/linear_acceleration/x imu/linear_acceleration/y imu/linear_acceleration/z" if sign == 1 else "gx gy gz"
    table = Table(wrench(POSES) | columns(names, sign * 9.81 * up))
    assert table.gravity_is_measured
    found = solve(table.dataset(), known=Known(gravity_direction_base=(0, 0, -1)))
    expected = solve(Table(wrench(POSES) | quaternion(POSES)).dataset())
    assert found.verdict == "good"
    assert found.mass_kg == pytest.approx(expected.mass_kg, rel=1e-3)
    np.testing.assert_allclose(found.p_sensor_com_m, expected.p_sensor_com_m, atol=2e-4)
    np.testing.assert_allclose(found.parameters.R_flange_sensor, expected.parameters.R_flange_sensor, atol=2e-3)


def test_a_table_in_memory_is_read_by_its_names() -> None:
    import pyarrow

    plain = t(POSES) | wrench(POSES) | quaternion(POSES)
    expected = Table(plain).dataset().sha256()
    assert Table(pyarrow.table(plain), name="dict").dataset().sha256() == expected
    with pytest.raises(BadDataset, match=r"^dict: .*put a number into each cell"):
        Table({**plain, "fx": np.array(["a"] * 24)}).dataset()
    with pytest.raises(BadDataset, match=r"^dict: .*put a number into each cell"):
        Table({**plain, "fx": np.zeros(7)}).dataset()


@pytest.mark.parametrize("zone", ["", "Z", "+01:00"])
@pytest.mark.parametrize("between", ["T", " "])
def test_dates_are_times(zone: str, between: str, tmp_path: Path) -> None:
    lines = [f"2026-11-28{between}12:00:{k / 4:06.3f}{zone},1,2,3,4,5,6,0,0,0,1" for k in range(5)]
    data = csv(tmp_path, "timestamp,fx,fy,fz,tx,ty,tz,qx,qy,qz,qw", *lines).dataset()
    np.testing.assert_allclose(data.t_s, np.arange(5) / 4, atol=1e-6)
    start = np.datetime64("2026-11-28T12:00:00")
    dates = start + np.arange(24) * np.timedelta64(250, "ms")
    table = Table({"time": dates} | wrench(POSES) | quaternion(POSES))
    np.testing.assert_allclose(table.dataset().t_s, np.arange(24) / 4, atol=1e-6)


def test_standard_errors_are_those_of_the_axes_of_the_sensor() -> None:
    sigma = columns("sigma_fx sigma_fy sigma_fz sigma_tx sigma_ty sigma_tz", np.full((24, 6), 0.1))
    plain = wrench(POSES) | quaternion(POSES) | sigma
    assert Table(plain).dataset().wrench_cov is not None
    with pytest.raises(BadDataset, match="standard errors must be in sensor axes"):
        Table(plain, TableOptions(wrench_axes="tcp")).dataset()


def test_joint_angles_with_a_model_are_poses() -> None:
    q_rad = np.random.default_rng(1).uniform(-2, 2, (5, 6))
    forward = _forward("ur5e", None)
    assert forward is not None
    table = columns("fx fy fz tx ty tz", np.ones((5, 6))) | columns("q1 q2 q3 q4 q5 q6", np.degrees(4 * q_rad))
    found = Table(table, TableOptions(forward=forward)).dataset()
    np.testing.assert_allclose(found.R_base_flange, forward(4 * q_rad)[0], atol=1e-9)
    assert Table(table, TableOptions(forward=forward)).has_nominal_kinematics


MOVING = wrench(RECORDING) | quaternion(RECORDING)


@pytest.mark.parametrize(("unit", "size"), [("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)])
@pytest.mark.parametrize("origin_s", [0.0, 1.7e9])
def test_a_unit_of_time_is_found_where_it_is_certain(unit: str, size: float, origin_s: float) -> None:
    table = Table(t(RECORDING, "t", size, origin_s) | MOVING)
    assert table.words == ("" if unit == "s" else f"time in {unit}")
    assert table.rate_Hz("wrench") == pytest.approx(500, rel=1e-5)


def test_a_named_unit_beats_the_numbers() -> None:
    named = Table({"t [us]": 1e3 * RECORDING.t_s} | MOVING)  # 500 kHz, which the numbers alone would not suggest
    assert named.rate_Hz("wrench") == pytest.approx(5e5)
    assert Table({"t": 1e3 * RECORDING.t_s} | MOVING).words == "time in ms"
    given = Table({"t": 1e3 * RECORDING.t_s} | MOVING, TableOptions(columns={"t": "t [us]"}))
    assert given.rate_Hz("wrench") == pytest.approx(5e5)


def test_rows_that_follow_quickly_or_two_streams_are_in_motion() -> None:
    slow = {"t": 0.5 * np.arange(len(RECORDING.t_s))}
    assert Table(t(RECORDING) | MOVING).in_motion
    assert not Table(slow | MOVING).in_motion
    assert not Table(MOVING).in_motion
    assert Table(MOVING, TableOptions(rate_Hz=500.0)).in_motion
    assert not Table(t(POSES) | wrench(POSES) | quaternion(POSES)).in_motion


def test_a_signal_in_counts_is_said() -> None:
    names = {f"{name} [counts]": values for name, values in wrench(POSES).items()}
    assert Table(names | quaternion(POSES)).words == "wrench in counts"


def dwells(*counts: int, steps: Sequence[float] = (), turned_deg: float = 0.02) -> tuple[Any, Any]:
    """Return a table of dwells with these numbers of rows, in orientations 90° apart or more, and the orientations."""
    rng, poses = np.random.default_rng(4), Rotation.create_group("O")[: len(counts)]
    pose = np.repeat(np.arange(len(counts)), counts)
    jitter = Rotation.from_rotvec(np.radians(turned_deg) * rng.uniform(-1, 1, (len(pose), 3)))
    level = pose[:, None] + rng.normal(0, 0.01, (len(pose), 6))
    for row in steps:
        level[int(row) :] += 0.5
    return columns(MATRIX, (poses[pose] * jitter).as_matrix().reshape(-1, 9)) | columns(
        "fx fy fz tx ty tz", level
    ), poses


def test_successive_rows_at_rest_in_one_orientation_are_one_pose() -> None:
    counts = (20, 60, 45, 75, 40)
    rows, poses = dwells(*counts)
    table = Table(rows | {"t_s": np.arange(240.0)})
    data = table.dataset()
    assert data.n_samples.tolist() == list(counts)
    np.testing.assert_allclose(data.R_base_flange, poses.as_matrix(), atol=2e-4)
    np.testing.assert_allclose(data.wrench, np.arange(5)[:, None] * np.ones(6), atol=0.01)
    assert data.wrench_cov is not None
    sigma = np.sqrt(np.einsum("nii->ni", data.wrench_cov))
    np.testing.assert_allclose(sigma.mean(axis=1), 0.01 / np.sqrt(counts), rtol=0.5)
    np.testing.assert_allclose(data.t_s[:2], [9.5, 49.5])
    assert table.words == "240 rows at rest are 5 poses"


def test_a_step_of_the_wrench_begins_another_pose() -> None:
    rows, _ = dwells(100, 100, steps=[130])
    data = Table(rows).dataset()
    assert data.n_samples.tolist() == [100, 30, 70]
    np.testing.assert_allclose(data.wrench[:, 0], [0, 1, 1.5], atol=0.02)


def test_rows_between_two_poses_are_left_out() -> None:
    rows, _ = dwells(100, 5, 100)
    table = Table(rows)
    assert table.dataset().n_samples.tolist() == [100, 100]
    assert table.words == "200 rows at rest are 2 poses; 5 rows between them left out"


@pytest.mark.parametrize("turned_deg", [0.02, 30.0], ids=["short", "different orientations"])
def test_ordinary_tables_have_one_row_per_pose(turned_deg: float) -> None:
    rows, _ = dwells(*((190,) if turned_deg < 1 else (300,)), turned_deg=turned_deg)
    data = Table(rows).dataset()
    assert len(data) == len(rows["fx"])
    assert data.wrench_cov is None
    assert not data.n_samples.any()
