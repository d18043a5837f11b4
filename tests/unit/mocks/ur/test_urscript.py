"""URScript on the emulated controller: what a program on the pendant does, and what is refused or ends it."""

import math
from textwrap import indent

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
  global poses = [[0.785, -1.745, 1.047, -0.873, 1.571, 0.785], [0.785, -1.745, 1.047, -0.873, 1.571, 0.0],
  local i = 0
  popup("Is the tool free?", title="Tour", blocking=True)
  while i < length(poses):
    movej(poses[i], a=1.4, v=1.05)
    sleep(0.5)
    textmsg("pose ", i + 1)
    i = i + 1
  end
end
""".replace("0.0],\n", "0.0]]\n")

GUARDED = """
def segment():
  global done = False
  thread mover():
    movej([0.785, -1.745, 1.047, -0.873, 1.571, 2.785], a=0.7, v=0.5)
    done = True
  end
  local hb = read_input_integer_register(24)
  local miss = 0
  thr = run mover()
  while not done:
    local x = read_input_integer_register(24)
    if x == hb:
      miss = miss + 1
    else:
      miss = 0
    end
    hb = x
    if (miss > 125) or (read_input_integer_register(25) != 0):
      kill thr
      stopj(2.0)
      write_output_integer_register(24, -1)
      halt
    end
    sync()
  end
  write_output_integer_register(24, 1)
end
"""


def new_robot(polyscope: tuple[int, int, int] = (5, 15, 0)) -> Robot:
    return Robot(World(Truth.drawn(0), MODELS["UR5e"], HOME, 0), RobotSettings(polyscope=polyscope))


def start(text: str, robot: Robot | None = None) -> Robot:
    """Upload a program and let it begin."""
    robot = robot or new_robot()
    (upload,) = take_uploads(bytearray(text.encode()))
    assert robot.upload(upload), robot.events[-1].why
    run(robot, 0.12)
    return robot


def run(robot: Robot, seconds: float) -> None:
    for _ in range(round(seconds * robot.frequency_hz)):
        robot.tick()


def said(robot: Robot) -> list[str]:
    return [event.why for event in robot.events if event.what == "textmsg"]


def end_of(robot: Robot) -> Event:
    return next(event for event in reversed(robot.events) if event.what.startswith("stopped"))


def results(*expressions: str, before: str = "", polyscope: tuple[int, int, int] = (5, 15, 0)) -> list[str]:
    """What expressions come to, as the log shows it."""
    lines = "\n".join([before, *(f"textmsg({expression})" for expression in expressions)])
    robot = start(f"def f():\n{indent(lines, '  ')}\nend\n", new_robot(polyscope))
    assert end_of(robot).why == "ended"
    return said(robot)


def why_it_fails(body: str, polyscope: tuple[int, int, int] = (5, 15, 0)) -> str:
    robot = start(f"def f():\n{body}\nend\n", new_robot(polyscope))
    assert robot.runtime == Runtime.STOPPED
    return end_of(robot).why


def test_an_exported_tour_asks_moves_and_speaks() -> None:
    robot = start(TOUR)
    run(robot, 1.0)
    assert (robot.popup, said(robot), robot.arm.at_rest) == ("Is the tool free?", ["poses: 3"], True)
    asked = next(event for event in robot.events if event.what == "popup")
    assert (asked.why, asked.detail["title"], asked.detail["blocking"]) == ("Is the tool free?", "Tour", True)
    assert answer(robot, "close popup") == "closing popup"
    run(robot, 0.1)
    assert answer(robot, "programState") == "PLAYING tour"
    run(robot, 6.0)
    assert said(robot)[1:] == ["pose 1", "pose 2"]
    assert robot.arm.q[5] == 0.0
    assert end_of(robot).why == "ended"


def test_a_move_takes_its_speed_from_its_arguments() -> None:
    robot = start("def f():\n  movej([0.785, -1.745, 1.047, -0.873, 1.571, 1.785], a=100, v=0.5)\nend\n")
    run(robot, 1.0)
    assert robot.arm.actual_qd[5] == pytest.approx(0.5, rel=1e-6)
    assert answer(robot, "running") == "Program running: true"
    run(robot, 1.1)
    assert answer(robot, "running") == "Program running: false"


def test_movej_with_a_time_takes_that_time() -> None:
    robot = start("def f():\n  movej([0.785, -1.745, 1.047, -0.873, 1.571, 1.785], t=1.5)\n  textmsg(1)\nend\n")
    run(robot, 1.46)
    assert said(robot) == []
    run(robot, 0.1)
    assert said(robot) == ["1"]


@pytest.fixture
def guarded() -> Robot:
    """The heartbeat of a guarded segment, while it beats."""
    robot = start(GUARDED)
    for beat in range(100):
        robot.write_inputs({"input_int_register_24": beat})
        run(robot, 0.01)
    assert robot.arm.actual_qd[5] == pytest.approx(0.5, rel=0.01)
    return robot


def test_a_guarded_segment_ends_while_the_heart_beats(guarded: Robot) -> None:
    for beat in range(500):
        guarded.write_inputs({"input_int_register_24": beat})
        run(guarded, 0.01)
    assert guarded.output_ints[24] == 1
    assert guarded.arm.q[5] == 2.785


def test_a_guarded_segment_stops_a_quarter_of_a_second_after_the_last_heartbeat(guarded: Robot) -> None:
    run(guarded, 0.24)
    assert guarded.arm.actual_qd[5] == pytest.approx(0.5, rel=0.01)
    run(guarded, 0.02 + 0.5 / 2.0)
    assert guarded.arm.at_rest
    assert guarded.output_ints[24] == -1
    run(guarded, 0.01)
    assert guarded.runtime == Runtime.STOPPED


def test_two_threads_cannot_both_move_the_arm() -> None:
    body = """
  thread mover():
    movej([0, -1.5, 1, -1, 1.5, 0])
  end
  run mover()
  sync()
  stopj(2)
"""
    assert "another thread (mover 1) is already controlling the robot" in why_it_fails(body)


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("1 + 2 * 3 - 4 / 8", "6.5"),
        ("(1 + 2) * -3", "-9"),
        ("7 % 3", "1"),
        ("-7.5 % 2", "-1.5"),
        ("not 1 == 2 and 3 >= 3", "True"),
        ("True xor True or False", "False"),
        ('"a" == "a"', "True"),
        ("[1, 2.5][1]", "2.5"),
        ("norm([3, 4])", "5.0"),
        ("norm(-2)", "2"),
        ("floor(-1.5)", "-2"),
        ("sqrt(pow(3, 2) + 16)", "5.0"),
        ("r2d(atan2(1, 1))", "45.0"),
        ("d2r(180)", str(math.pi)),
        ("p[0, 0, 1, 0, 0, 0]", "p[0, 0, 1, 0, 0, 0]"),
        ("pose_trans(p[1, 0, 0, 0, 0, 0], p[0, 2, 0, 0, 0, 0])", "p[1.0, 2.0, 0.0, 0.0, 0.0, 0.0]"),
        ("[1, 2] + [3, 4]", "[4, 6]"),
        ("2 * [3, 4]", "[6, 8]"),
        ('str_cat("q = ", to_str([1, True]))', "q = [1, True]"),
        ("length([1, 2, 3])", "3"),
    ],
)
def test_expressions(expression: str, value: str) -> None:
    assert results(expression) == [value]


def test_state_of_the_arm() -> None:
    q, offset, steady = results("get_actual_joint_positions()", "get_tcp_offset()", "is_steady()")
    assert q == str(list(HOME))
    assert offset == "p[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]"
    assert steady == "False"  # not yet


def test_inverse_of_forward_is_where_the_arm_stands() -> None:
    (away,) = results("norm(get_inverse_kin(get_forward_kin()) - get_actual_joint_positions())")
    assert float(away) < 1e-6


def test_scopes_as_in_the_manual() -> None:
    before = """
a = 0
def free():
  a = 1
end
def hidden():
  local a = 2
  inner = 5
  return a
end
def deeper():
  local a = 3
  def below():
    a = 4
  end
  below()
  return a
end
free()
"""
    assert results("a", "hidden()", "a", "deeper()", "a", before=before) == ["1", "2", "1", "3", "4"]


def test_functions_have_defaults_names_and_recursion() -> None:
    before = """
def power(x, n=2):
  if n == 0:
    return 1
  elif n == 1:
    return x
  else:
    return x * power(x, n=n - 1)
  end
end
"""
    assert results("power(3)", "power(n=3, x=2)", "power(5, 0)", before=before) == ["9", "8", "1"]


def test_loops_break_and_continue() -> None:
    before = """
i = 0
odd = 0
while True:
  i = i + 1
  if i > 9:
    break
  end
  if i % 2 == 0:
    continue
  end
  odd = odd + i
end
list = [0, 0]
list[1] = odd
"""
    assert results("list", before=before) == ["[0, 25]"]


def test_threads_run_side_by_side_and_are_joined() -> None:
    before = """
n = 0
thread count():
  while n < 5:
    n = n + 1
    sync()
  end
end
worker = run count()
join worker
"""
    assert results("n", before=before) == ["5"]


def test_the_end_of_the_program_ends_its_threads() -> None:
    robot = start("def f():\n  thread t():\n    sleep(0.05)\n    textmsg(1)\n  end\n  run t()\nend\n")
    run(robot, 0.2)
    assert said(robot) == []


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
        ("  def g():\n    z = 1\n  end\n  g()\n  textmsg(z)", "the variable z has no value here"),
        ("  while True:\n  end", "a loop needs sync"),
        ("  speedj([0, 0, 0, 0, 0, 0])", "speedj does not exist or is not modelled"),
        ("  movej([0, 0, 0])", "six joint values"),
        ("  movej([0, 0, 0, 0, 0, 0], speed=1)", "movej: got an unexpected keyword argument 'speed'"),
        ("  movej([0, 0, 0, 0, 0, 0], v=0)", "must be positive"),
        ("  movej(p[9, 9, 9, 0, 0, 0])", "no solution"),
        ("  if 1:\n  end", "a condition must be True or False, not 1"),
        ("  x = 1 / 0", "division by zero"),
        ('  x = "a" + 1', "is not possible"),
        ("  x = [1][1]", "[1] has no element 1"),
        ("  x = sleep(0)", "without a value"),
        ("  kill 3", "kill needs a thread, not 3"),
        ("  break", "break outside of a loop"),
        ("  write_output_integer_register(24, 1.5)", "no whole number"),
        ("  write_output_integer_register(48, 1)", "no register 48"),
        ("  thread t():\n  end\n  t()", "t is a thread: say run"),
        ("  x = sqrt(-1)", "sqrt"),
        ("  def g():\n    g()\n  end\n  g()", "call each other without an end"),
    ],
)
def test_run_time_errors_say_what_is_wrong(body: str, why: str) -> None:
    assert why in why_it_fails(body)


def test_lists_have_no_arithmetic_on_old_controllers() -> None:
    assert results("norm([3, 4])", polyscope=(5, 4, 0)) == ["5.0"]
    assert "before PolyScope 3.14 and 5.9" in why_it_fails("  x = [1] - [2]", polyscope=(5, 4, 0))


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("def f():\n  x = \nend\n", "line 2: a name expected, found the end of the line"),
        ("def f():\n  if x\n  end\nend\n", "line 2: ':' expected"),
        ("def f():\n  while True:\n  sync()\nend\n", "'end' expected|a name expected"),
        ("def f():\n  x = 1 ! 2\nend\n", "line 2: '! 2' is no URScript"),
        ("def f():\n  1 + 2\nend\n", "line 2: an assignment or a call expected"),
        ("def f(x):\nend\n", "a program has no parameters"),
        ("def f():\n  g(a=1, 2)\nend\n", "an argument with a name expected"),
        ("def f():\n  end = 1\nend\n", "line 2"),
    ],
)
def test_what_is_no_program_is_refused_with_the_line(text: str, why: str) -> None:
    with pytest.raises(UrscriptSyntaxError, match=why):
        parse(text, "f")
    robot = start("def g():\n  sleep(1)\nend\n")
    assert not robot.upload(Upload("f", text, secondary=False))
    assert "syntax error" in robot.events[-1].why
    assert answer(robot, "programState") == "PLAYING g"


WORDS = ["def f():\n", "thread t():\n", "if True:\n", "else:\n", "while x < 3:\n", "end\n", "break\n", "halt\n", "\n"]
WORDS += ["x = ", "x[1]", "f(", "a=", "run ", "kill x\n", "local ", "sync()\n", "not ", "1", "2.5", '"text"', "p[", "#"]
WORDS += [*"[]),+-", "==", "(" * 3000]


@given(st.lists(st.sampled_from(WORDS), max_size=25).map("".join) | st.text(max_size=50))
def test_whatever_is_sent_is_a_program_or_a_syntax_error_and_harms_nobody(text: str) -> None:
    """Also what happens to be a program: it runs for a while, ends, or is ended by an error."""
    robot = new_robot()
    if robot.upload(Upload("f", f"def f():\n{text}\nend\n", secondary=False)):
        run(robot, 0.12)
    else:
        assert "syntax error" in robot.events[-1].why
    assert robot.arm.at_rest


def test_one_line_alone_is_a_program_too() -> None:
    robot = start('textmsg("hello")\n')
    assert said(robot) == ["hello"]
