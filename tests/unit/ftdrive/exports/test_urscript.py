"""A plan as a program for the pendant, run here by the interpreter of the emulated controller, and functions for one.

tests/wire runs the functions.
"""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from math import radians
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from click.testing import CliRunner, Result
from syrupy.assertion import SnapshotAssertion

from ftdrive import __version__
from ftdrive.cli import cli
from ftdrive.errors import PlanRefused, exit_code
from ftdrive.exports import urscript
from ftdrive.exports.urscript import functions
from ftdrive.planning.plan import Plan
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.ur.urscript.program import Program
from ftmocks.ur.urscript.urmath import norm


class Pendant:
    """The emulated controller's interpreter; it knows only the functions that an export uses, which take no time."""

    def __init__(self, q_rad: list[float]) -> None:
        self.q_rad = q_rad
        self.moves: list[tuple[list[float], float, float]] = []
        self.said: list[str] = []
        self.rests: list[float] = []

    def run(self, text: str) -> None:
        known: dict[str, Callable[..., Any]] = {
            "movej": self._movej,
            "textmsg": lambda _, words: self.said.append(words),
            "popup": lambda _, words, **_options: self.said.append(words),
            "sleep": lambda _, seconds: self.rests.append(seconds),
            "norm": norm,
            "get_actual_joint_positions": lambda _: list(self.q_rad),
        }
        arm = SimpleNamespace(release=lambda _: None)
        robot = cast(Robot, SimpleNamespace(settings=RobotSettings(), arm=arm))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("ftmocks.ur.urscript.program.functions", lambda _: known)
            assert not Program(robot, "ftdrive_tour", text).step()

    def _movej(self, _: object, q: list[float], *, a: float, v: float) -> None:
        self.moves.append((q, a, v))
        self.q_rad = list(q)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("plan") / "plan.json"
    outcome = CliRunner().invoke(
        cli, ["plan", "--model", "ur5e", "--tool", "0:33:80", "--tool", "33:200:100:0:5", "--output", str(path)]
    )
    assert outcome.exit_code == 0, outcome.output
    return path


@pytest.fixture(scope="module")
def plan(path: Path) -> Plan:
    return Plan.load(path)


def export(path: Path, *arguments: str) -> Result:
    return CliRunner().invoke(cli, ["export", "plan", str(path), *arguments])


def test_the_program_visits_what_was_planned_as_it_was_planned(plan: Plan) -> None:
    first = list(plan.steps[0].q_rad)
    pendant = Pendant([angle + radians(29) for angle in first])
    pendant.run(urscript.program(plan, dwell_s=3.5))
    assert len(pendant.moves) == len(plan.steps) + 1
    goals = np.array([goal for goal, _, _ in pendant.moves])
    np.testing.assert_allclose(goals, [*(step.q_rad for step in plan.steps), first], atol=1e-6)
    np.testing.assert_allclose(
        [v for _, _, v in pendant.moves[1:]], [step.speed_rad_s for step in plan.steps], atol=1e-6
    )
    np.testing.assert_allclose([a for _, a, _ in pendant.moves[1:]], plan.acceleration_rad_s2, atol=1e-6)
    assert pendant.moves[0][2] <= radians(10) + 1e-6  # the way there is not proven
    assert pendant.rests == [3.5] * (len(plan.steps) + 1)
    poses = [words for words in pendant.said if ": pose " in words]
    assert [int(words[-2:]) for words in poses] == [*(step.number for step in plan.steps), plan.steps[0].number]
    assert "pose 1 of 24" in poses[0]


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("away_deg", [31, -31, 360])
def test_far_from_the_first_pose_nothing_moves(plan: Plan, joint: int, away_deg: float) -> None:
    q = list(plan.steps[0].q_rad)
    q[joint] += radians(away_deg)
    pendant = Pendant(q)
    pendant.run(urscript.program(plan, dwell_s=1.0))
    assert pendant.moves == []
    assert "jog all joints to 45, -100, 60" in pendant.said[-1]


def test_a_person_is_asked_before_the_first_move(plan: Plan) -> None:
    lines = urscript.program(plan, dwell_s=1.0).splitlines()
    asked = next(i for i, line in enumerate(lines) if line.strip().startswith("popup("))
    assert "blocking=True" in lines[asked]
    assert asked < next(i for i, line in enumerate(lines) if "get_actual_joint_positions" in line)
    assert not any("movej" in line for line in lines[:asked])


SCENE = {
    "planes": [{"normal": [0, 0, 1], "offset_m": 0}, {"normal": [-1, 0, 0], "offset_m": -0.8}],
    "boxes": [{"low_m": [0.5, 0.5, 0], "high_m": [0.7, 0.7, 0.2]}],
    "lean_rad": radians(30),
}


def with_scene(plan: Plan) -> Plan:
    return replace(plan, description={**plan.description, "scene": SCENE})


def with_unlimited_tips(plan: Plan) -> Plan:
    return replace(plan, description={**plan.description, "speeds": {**plan.description["speeds"], "tip_m_s": None}})


def with_a_moved_base_joint(plan: Plan) -> Plan:
    moved = replace(plan.steps[1], q_rad=(0.5, *plan.steps[1].q_rad[1:]))
    return replace(plan, steps=(plan.steps[0], moved, *plan.steps[2:]))


@pytest.mark.parametrize("change", [replace, with_scene, with_unlimited_tips, with_a_moved_base_joint])
def test_header_and_question_say_what_it_does(
    change: Callable[[Plan], Plan], plan: Plan, snapshot: SnapshotAssertion
) -> None:
    changed = change(plan)
    sha256 = changed.to_dict()["sha256"]
    text = urscript.program(changed, dwell_s=1.0).replace(sha256, "SHA256").replace(sha256[:12], "SHA256")
    lines = [line.strip() for line in text.splitlines() if line.strip().startswith(("#", "popup("))]
    assert "\n".join(lines).replace(__version__, "VERSION") == snapshot


def test_a_plan_printed_as_json_is_a_plan(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    printed = CliRunner().invoke(cli, ["plan", "--model", "ur5e", "--tool", "0:200:100", "--minimal", "--json"])
    path.write_text(printed.stdout)
    assert export(path, "--format", "csv").exit_code == 0
    path.write_text(printed.stdout.replace('"limited_by"', '"limited-by"'))
    assert "changed" in str(export(path, "--format", "csv").exception)


@pytest.mark.parametrize("missing", [{}, {"measured": False}])
def test_placeholders_do_not_reach_the_pendant(missing: dict[str, bool], plan: Plan, tmp_path: Path) -> None:
    described = {key: value for key, value in plan.description.items() if key != "measured"}
    path = tmp_path / "plan.json"
    replace(plan, description=described | missing).save(path)
    for target in ("urscript", "csv"):
        refused = export(path, "--format", target)
        assert isinstance(refused.exception, PlanRefused)
        assert "measured = true" in str(refused.exception)
        assert refused.stdout == ""


GOLDEN = """\
  movej([0.785398, -1.745329, 1.047198, -0.872665, 1.570796, 0.785398], a=0.349066, v=0.174533)
  textmsg("ftdrive plan HASH: pose 1 of 24, orientation R01")
  sleep(4.000)
  movej([0.785398, -1.745329, 1.047198, -0.872665, 1.570796, -0.785398], a=1.396263, v=SPEED)
  textmsg("ftdrive plan HASH: pose 2 of 24, orientation R10")
  sleep(4.000)
"""


def test_golden_lines_and_the_same_each_time(path: Path, plan: Plan) -> None:
    text = export(path, "--format", "urscript").stdout
    assert text == export(path, "--format", "urscript").stdout
    speed = f"{plan.steps[0].speed_rad_s:.6f}"
    assert GOLDEN.replace("HASH", plan.to_dict()["sha256"][:12]).replace("SPEED", speed) in text
    assert text.isascii()
    assert text.startswith("def ftdrive_tour():\n")
    assert [line for line in text.splitlines() if line.rstrip() != line] == []
    # The controller ends at this end.
    assert re.findall(r"^\S.*$", text, re.MULTILINE) == ["def ftdrive_tour():", "end"]


@pytest.mark.parametrize("model", ['"\nend\nmovej([9,0,0,0,0,0])\n#', "a\r\nhalt", 'x")\u2028movej([0])', "\\", "\0"])
def test_no_text_leaves_its_comment_or_string(plan: Plan, model: str) -> None:
    hostile = replace(plan, why=(model,), description={**plan.description, "model": model})
    usual, text = (urscript.program(each, dwell_s=1.0) for each in (plan, hostile))
    assert text.isascii()
    assert len(text.splitlines()) == len(usual.splitlines()) - len(plan.why) + 1
    pendant = Pendant(list(plan.steps[0].q_rad))
    pendant.run(text)
    assert len(pendant.moves) == len(plan.steps) + 1


@pytest.mark.parametrize(
    "change",
    [
        {"certified": False},
        {"speed_rad_s": 0.0},
        {"speed_rad_s": float("nan")},
        {"speed_rad_s": 4.0},
        {"q_rad": (7.0, 0.0, 0.0, 0.0, 0.0, 0.0)},
        {"q_rad": (float("inf"), 0.0, 0.0, 0.0, 0.0, 0.0)},
        {"q_rad": (0.0,) * 5},
    ],
)
def test_what_no_arm_should_follow_is_refused(plan: Plan, change: dict[str, Any]) -> None:
    steps = (*plan.steps[:5], replace(plan.steps[5], **change), *plan.steps[6:])
    for target in (lambda plan: urscript.program(plan, dwell_s=1.0), urscript.plan_table):
        with pytest.raises(PlanRefused):
            target(replace(plan, steps=steps))


def test_table_of_targets(path: Path, plan: Plan) -> None:
    text = export(path, "--format", "csv").stdout
    first, names, *lines = text.splitlines()
    assert first == f"# ftdrive.targets/1 plan {plan.to_dict()['sha256']} UR5e"
    values = np.array([[float(cell) for cell in line.split(",")] for line in lines])
    assert len(names.split(",")) == values.shape[1]
    np.testing.assert_allclose(values[:, 2:8], [step.q_rad for step in plan.steps], atol=1e-8)
    np.testing.assert_allclose(values[:, 8], [step.speed_rad_s for step in plan.steps], atol=1e-8)
    assert values[:, 1].tolist() == [step.number for step in plan.steps]


def test_a_file_of_another_kind_and_an_edited_plan_are_refused(path: Path, tmp_path: Path) -> None:
    (other := tmp_path / "other.json").write_text('{"format": "ftdrive.dataset/1"}')
    refused = export(other, "--format", "urscript").exception
    assert refused is not None
    assert exit_code(refused) == 6
    assert f"{other}: the format is" in str(refused)
    edited = tmp_path / "edited.json"
    edited.write_text(path.read_text().replace('"speed_rad_s": 1.0471975511965976', '"speed_rad_s": 3.0'))
    refused = export(edited, "--format", "urscript").exception
    assert refused is not None
    assert exit_code(refused) == 7
    assert "changed" in str(refused)


def test_the_command_prints_or_saves(tmp_path: Path) -> None:
    def printed(*arguments: str) -> str:
        return CliRunner().invoke(cli, ["export", "urscript", *arguments]).stdout

    assert printed("--first", "26") == functions(26)
    answer = json.loads(printed("--json", "--example"))
    assert (answer["text"], answer["file"]) == (functions(24, example=True), None)
    path, other = (str(tmp_path / name) for name in ("ftd.script", "two.script"))
    assert "".join(printed("-o", path).split()) == f"Saved{path}"
    assert Path(path).read_text() == functions(24)
    assert json.loads(printed("--json", "-o", other))["file"] == other
