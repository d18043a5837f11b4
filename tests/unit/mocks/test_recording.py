"""A recording that is played back: which row when, what the arm has, and which files are refused."""

from pathlib import Path

import numpy as np
import pytest

from ftmocks.clock import CellClock
from ftmocks.kinematics import MODELS, forward
from ftmocks.recording import COLUMNS, RecordedArm, RecordedWorld, Recording
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.ur.uploads import Upload, start_upload
from ftmocks.world import Truth
from tests.unit.mocks.real_time import RealTime

DH = MODELS["UR5e"]
HOME = np.radians([45, -100, 60, -50, 90, 45])
RATE_HZ = 1000


def made(rows: int = 2001) -> Recording:
    """Row k holds the wrench (k, 2k, …, 6k) mN; joint 6 turns with 0.5 rad/s."""
    k = np.arange(float(rows))
    q_rad = HOME + np.outer(k / RATE_HZ, [0, 0, 0, 0, 0, 0.5])
    return Recording(7.0 + k / RATE_HZ, 1e-3 * np.outer(k, range(1, 7)), q_rad)


def row(wrench: np.ndarray) -> np.ndarray:
    rows: np.ndarray = np.round(1e3 * wrench[:, 0]).astype(int)
    return rows


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_the_arm_has_the_recorded_joints_and_takes_no_command() -> None:
    recording, real = made(), RealTime()
    clock = CellClock(real)
    world = RecordedWorld(recording, Truth.drawn(1), DH, 0, clock)
    robot = Robot(world, RobotSettings(), RecordedArm(DH, recording))
    start_s = clock.now_s()
    recording.play(start_s, 0.0, 1.0)
    for k in range(100):
        robot.tick(start_s + 0.002 * k)
        assert robot.arm.actual_q[5] == pytest.approx(HOME[5] + 0.5 * 0.002 * k, abs=1e-12)
        assert robot.arm.actual_qd[5] == pytest.approx(0.5)
    np.testing.assert_allclose(robot.tcp_pose("actual")[:3], forward(DH, robot.arm.actual_q)[:3, 3])
    assert not start_upload(robot, Upload("other", "def other():\n  sleep(1)\nend\n", secondary=False))
    assert "follows a recording" in robot.events[-1].why
    with pytest.raises(ValueError, match="follows a recording"):
        robot.hand_move(robot.arm.q, 0.3)


@pytest.mark.parametrize("units", [False, True])
def test_columns_are_found_by_their_names(tmp_path: Path, units: bool) -> None:
    unit = {"q": "_rad", "f": "_N", "t": "_Nm"} if units else {"q": "", "f": "", "t": ""}
    named = [name + unit[name.removeprefix("raw_")[0]] if name != "t_s" else name for name in COLUMNS]
    header = ["seq", *reversed(named), "status"]
    rows = ["".join(["9,", ",".join(str(10 * r + c) for c in reversed(range(13))), ",7"]) for r in range(3)]
    path = written(tmp_path / "peg.csv", "# ftdrive.recording/1\n" + ",".join(header) + "\n" + "\n".join(rows) + "\n")
    recording = Recording.read(path)
    assert (len(recording), recording.duration_s) == (3, 20.0)
    recording.play(0.0, 10.0, 1.0)
    np.testing.assert_array_equal(recording.wrench(np.zeros(1)), [[11, 12, 13, 14, 15, 16]])
    np.testing.assert_allclose(recording.joints(0.0).q, [17, 18, 19, 20, 21, 22])


HEADER = ",".join(COLUMNS)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "no column t_s, raw_fx"),
        (HEADER.replace("raw_ty,", "") + "\n", "no column raw_ty$"),
        (HEADER + "\n" + "0," * 12 + "0\n", "a recording needs two rows or more, but this file has 1"),
        (HEADER + "\n" + "0," * 12 + "0\n" + "0," * 12 + "0\n", "does not rise from row 1"),
        (HEADER + "\n" + "0," * 12 + "0\n" + "1," * 12 + "nan\n", "row 2 holds"),
        (HEADER + "\n" + "0," * 12 + "0\n" + "1," * 12 + "x\n", "'x'"),
    ],
)
def test_a_file_that_is_no_recording_is_refused(tmp_path: Path, text: str, why: str) -> None:
    with pytest.raises(ValueError, match=f"peg.csv.*{why}"):
        Recording.read(written(tmp_path / "peg.csv", text))
