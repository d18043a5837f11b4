"""The options that say what a table does not: their effect on `solve`, and one sentence for what cannot be."""

import json
from collections.abc import Callable
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from ftdrive import cli
from ftdrive.runs.source import _forward
from tests.ros2.seven_joints import URDF
from tests.unit.ftdrive.tables.test_layouts import POSES, quaternion, t, text, wrench

Solved = Callable[..., tuple[int, str, str]]
PLAIN = t(POSES) | wrench(POSES) | quaternion(POSES)


@pytest.fixture
def solved(run: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch) -> Solved:
    """Solve a table in an empty folder; return exit code, stdout and stderr, where no computer is slow."""
    monkeypatch.setattr("ftdrive.terminal.console.Timer", MagicMock())

    def call(table: dict[str, np.ndarray], *options: str) -> tuple[int, str, str]:
        Path("poses.csv").write_text(text(table))
        return run("solve", "poses.csv", "--json", *options)

    return call


def parameters(outcome: tuple[int, str, str]) -> np.ndarray:
    assert outcome[0] == 0, outcome[2]
    found = json.loads(outcome[1])
    names = ("R_flange_sensor", "gravity_force_base_N", "force_bias_N", "p_sensor_com_m", "torque_bias_Nm")
    return np.concatenate([np.ravel(found[name]) for name in names])


def near(one: np.ndarray, other: np.ndarray) -> None:
    np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.slow
def test_columns_may_be_named_on_the_line_and_in_a_file(solved: Solved) -> None:
    renamed = {f"c {i}": values for i, values in enumerate(PLAIN.values())}
    names = {name: f"c {i}" for i, name in enumerate(PLAIN)}
    expected = parameters(solved(PLAIN))
    near(
        parameters(solved(renamed, "--columns", ",".join(f"{ours}={theirs}" for ours, theirs in names.items()))),
        expected,
    )
    lines = [f'{ours} = "{theirs}"' for ours, theirs in names.items()]
    Path("columns.toml").write_text("\n".join(["[columns]", *lines]))
    near(parameters(solved(renamed, "--columns", "columns.toml")), expected)


@pytest.mark.slow
def test_a_unit_may_have_a_size(solved: Solved) -> None:
    scaled = PLAIN | {name: values / 0.82 for name, values in wrench(POSES).items() if name.startswith("f")}
    near(
        parameters(solved(scaled, "--columns", "fx=fx [.82 N],fy=fy [0.82 N],fz=fz [8.2e-1 N]")),
        parameters(solved(PLAIN)),
    )


@pytest.mark.slow
def test_the_sign_reverses_what_is_read(solved: Solved) -> None:
    reaction = PLAIN | {name: -values for name, values in wrench(POSES).items()}
    near(parameters(solved(reaction, "--sign", "-1")), parameters(solved(PLAIN)))


def test_a_urdf_makes_poses_of_joint_angles(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    forward = _forward(None, f"{path}?base=link1")
    assert forward is not None
    R, p_m = forward(np.zeros((2, 6)))
    np.testing.assert_allclose(p_m[:, 2], 1.3)
    np.testing.assert_allclose(R[0], np.diag([1, -1, -1]), atol=1e-9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--columns", "fx"], "--columns fx: give NAME=COLUMN separated by commas"),
        (["--columns", "empty.toml"], "empty.toml has no columns"),
        (["--columns", "fx=Force"], "the columns are t, fx, fy"),
        (["--tcp", "1,2"], "--tcp is '1,2': give 3 or 6 numbers"),
        (["--euler", "xy"], "--euler xy: give rpy, ABC"),
        (["--model", "UR99"], "--model UR99: the models are UR3"),
        (["--model", "ur5e", "--urdf", "a.urdf"], "--model and --urdf both describe the arm"),
        (["--urdf", "arm.urdf"], "7 moving joints, not 6"),
        (["--wrench-topic", "/ft"], "are only for a ROS bag"),
    ],
)
def test_an_option_that_cannot_be_used_is_one_sentence(options: list[str], words: str, solved: Solved) -> None:
    Path("empty.toml").write_text("[other]\n")
    Path("arm.urdf").write_text(URDF)
    code, out, err = solved(PLAIN, *options)
    assert code in (2, 6)
    assert out == ""
    assert words in err
    assert err.count("error:") + err.count("Error:") == 1


@pytest.mark.slow
def test_options_of_a_table_do_not_go_with_other_data(solved: Solved) -> None:
    near(parameters(solved(PLAIN)), parameters(solved(PLAIN, "--rate", "1")))  # poses have their times in any case
    from ftdrive import read_dataset

    read_dataset("poses.csv").save("dataset.json")
    assert cli.run(["solve", "dataset.json", "--sign", "-1"]) == 2
