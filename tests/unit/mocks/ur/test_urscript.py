"""URScript on the emulated controller: what a program on the pendant does, and what is refused or ends it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocks.kinematics import MODELS, vector6
from mocks.ur.dashboard import answer
from mocks.ur.events import Event
from mocks.ur.modes import Runtime
from mocks.ur.robot import Robot, RobotSettings
from mocks.ur.script import Upload, take_uploads
from mocks.ur.urscript.syntax import UrscriptSyntaxError, parse
from mocks.world import Truth, World

HOME = vector6(np.radians([45, -100, 60, -50, 90, 45]))

TOUR = """
# made for the test
def tour():
  textmsg("poses: ", 3)
  local poses = [[0.785, -1.745, 1.047, -0.873, 1.571, 0.785], [0.785, -1.745, 1.047, -0.873, 1.571, 0.0],
  local i = 0
  popup("Is the tool free?", title="Tour", blocking=True)
  while i < 2:
    movej(poses[i], a=1.4, v=1.05)
    sleep(0.5)
    textmsg("pose ", i + 1)
    i = i + 1
  end
end
""".replace("0.0],\n", "0.0]]\n")


def new_robot() -> Robot:
    return Robot(World(Truth.drawn(0), MODELS["UR5e"], HOME, 0), RobotSettings())


def start(text: str) -> Robot:
    """Upload a program and let it begin."""
    robot = new_robot()
    (upload,) = take_uploads(bytearray(text.encode()))
    assert robot.upload(upload), robot.events[-1].why
    run(robot, 0.12)
    return robot


def run(robot: Robot, seconds: float) -> None:
    for _ in range(round(seconds * robot.frequency_hz)):
        robot.tick()


def logged(robot: Robot) -> list[str]:
    return [event.why for event in robot.events if event.what == "textmsg"]


def end_of(robot: Robot) -> Event:
    return next(event for event in reversed(robot.events) if event.what.startswith("stopped"))


def result(expression: str, before: str = "") -> str:
    """Value of an expression, as the log shows it."""
    robot = start(f"def f():\n{before}  textmsg({expression})\nend\n")
    assert end_of(robot).why == "ended"
    return logged(robot)[-1]


def why_it_fails(body: str) -> str:
    robot = start(f"def f():\n{body}\nend\n")
    assert robot.runtime == Runtime.STOPPED
    return end_of(robot).why


def test_an_exported_tour_asks_moves_and_speaks() -> None:
    robot = start(TOUR)
    run(robot, 1.0)
    assert (robot.popup, logged(robot), robot.arm.at_rest) == ("Is the tool free?", ["poses: 3"], True)
    asked = next(event for event in robot.events if event.what == "popup")
    assert (asked.why, asked.detail["title"], asked.detail["blocking"]) == ("Is the tool free?", "Tour", True)
    assert answer(robot, "close popup") == "closing popup"
    run(robot, 0.1)
    assert answer(robot, "programState") == "PLAYING tour"
    run(robot, 6.0)
    assert logged(robot)[1:] == ["pose 1", "pose 2"]
    assert robot.arm.q[5] == 0.0
    assert end_of(robot).why == "ended"


def test_a_move_takes_its_speed_from_its_arguments() -> None:
    robot = start("def f():\n  movej([0.785, -1.745, 1.047, -0.873, 1.571, 1.785], a=100, v=0.5)\nend\n")
    run(robot, 1.0)
    assert robot.arm.actual_qd[5] == pytest.approx(0.5, rel=1e-6)
    assert answer(robot, "running") == "Program running: true"
    run(robot, 1.1)
    assert answer(robot, "running") == "Program running: false"


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("1 + 2 * 3 - 4 / 8", "6.5"),
        ("(1 + 2) * -3", "-9"),
        ("1 + 1 == 2", "True"),
        ("3 >= 3.5", "False"),
        ('"a" != "b"', "True"),
        ("[1, 2.5][1]", "2.5"),
        ("norm([3, 4])", "5.0"),
        ("norm(-2)", "2.0"),
        ("get_actual_joint_positions()", str(list(HOME))),
        (r'"no \escape"', r"no \escape"),
    ],
)
def test_expressions(expression: str, value: str) -> None:
    assert result(expression) == value


def test_loops_and_conditions() -> None:
    before = """
  i = 0
  sum = 0
  while i < 10:
    i = i + 1
    if i > 5:
      if i != 7:
        sum = sum + i
      end
    end
  end
"""
    assert result("sum", before) == "33"


def test_halt_ends_the_program_inside_any_block() -> None:
    robot = start('def f():\n  while True:\n    if 1 < 2:\n      halt\n    end\n  end\n  textmsg("after")\nend\n')
    assert (end_of(robot).why, logged(robot)) == ("ended", [])


def test_sleep_lasts_in_the_time_of_the_controller() -> None:
    for scale in (1.0, 20.0):
        robot = Robot(World(Truth.drawn(0), MODELS["UR5e"], HOME, 0), RobotSettings(time_scale=scale))
        robot.upload(Upload("f", "def f():\n  sleep(1.0)\nend\n", secondary=False))
        while robot.runtime != Runtime.PLAYING:
            robot.tick()
        begun = robot.timestamp_s
        while robot.runtime == Runtime.PLAYING:
            robot.tick()
        assert robot.timestamp_s - begun == pytest.approx(1.0, abs=2.1 * robot.period_s * scale)


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("  x = y", "the variable y has no value here"),
        ("  while True:\n  end", "a loop needs sleep"),
        ("  speedj([0, 0, 0, 0, 0, 0])", "speedj does not exist or is not modelled"),
        ("  movej([0, 0, 0])", "six joint values"),
        ("  movej([0, 0, 0, 0, 0, 0], speed=1)", "movej: got an unexpected keyword argument 'speed'"),
        ("  movej([0, 0, 0, 0, 0, 0], v=0)", "must be positive"),
        ("  if 1:\n  end", "a condition must be True or False, not 1"),
        ("  x = 1 / 0", "division by zero"),
        ('  x = "a" + 1', "must be a number"),
        ("  x = [1] + [2]", "must be a number"),
        ("  x = [1][1]", "[1] has no element 1"),
        ("  x = sleep(0)", "without a value"),
        ("  x = " + "norm(" * 150 + "1" + ")" * 150 + " + 1" * 950, "nested too deeply"),
    ],
)
def test_run_time_errors_say_what_is_wrong(body: str, why: str) -> None:
    assert why in why_it_fails(body)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("def f():\n  x = \nend\n", "line 2"),
        ("def f():\n  if x\n  end\nend\n", "line 2"),
        ("def f():\n  while True:\n  sleep(1)\nend\n", "'end' expected"),
        ("def f():\n  x = 1 ! 2\nend\n", "line 2: '! 2' is no URScript"),
        ("def f():\n  1 + 2\nend\n", "line 2: an assignment or a call expected"),
        ("def f(x):\nend\n", "line 1"),
        ("def f():\n  g(a=1, 2)\nend\n", "line 2"),
        ("def f():\n  end = 1\nend\n", "line 2"),
        ("def f():\nend\nx = 1\n", "line 3: nothing more expected"),
        ("def f():\n  x = 'single'\nend\n", "line 2"),
        ("def f():\n  x = (1, 2)\nend\n", "line 2: .* not modelled"),
        ("def f():\n  x = 1 < 2 < 3\nend\n", "line 2: .* not modelled"),
        ("def f():\n  x = 1 in y\nend\n", "line 2: .* not modelled"),
        ("def f():\n  x = None\nend\n", "line 2: .* not modelled"),
        ("def f():\n  thread t():\n  end\nend\n", "line 2"),
    ],
)
def test_what_is_no_program_is_rejected_with_the_line(text: str, why: str) -> None:
    with pytest.raises(UrscriptSyntaxError, match=why):
        parse(text)
    robot = start("def g():\n  sleep(1)\nend\n")
    assert not robot.upload(Upload("f", text, secondary=False))
    assert "syntax error" in robot.events[-1].why
    assert answer(robot, "programState") == "PLAYING g"


WORDS = ["def f():\n", "if True:\n", "while x < 3:\n", "end\n", "halt\n", "\n", "x = ", "x[1]", "f(", "a=", "run "]
WORDS += ["local ", "sleep(1)\n", "-", "1", "2.5", '"text"', "#", *"[]),+", "==", "(" * 3000, "-" * 3000, "1 + " * 3000]


@given(st.lists(st.sampled_from(WORDS), max_size=25).map("".join) | st.text(max_size=50))
def test_any_text_is_a_program_or_a_syntax_error_and_moves_nothing(text: str) -> None:
    """Also what happens to be a program: it runs for a while, ends, or is ended by an error."""
    robot = new_robot()
    if robot.upload(Upload("f", f"def f():\n{text}\nend\n", secondary=False)):
        run(robot, 0.12)
    else:
        assert "syntax error" in robot.events[-1].why
    assert robot.arm.at_rest


def test_one_line_alone_is_a_program_too() -> None:
    robot = start('textmsg("hello")\n')
    assert logged(robot) == ["hello"]
