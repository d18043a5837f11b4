"""URScript on the emulated controller: the language, and which texts are refused or end with an error."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftmocks.ur.dashboard import answer
from ftmocks.ur.uploads import Upload, start_upload
from ftmocks.ur.urscript.library import functions
from ftmocks.ur.urscript.parser import parse
from ftmocks.ur.urscript.syntax import UrscriptSyntaxError
from tests.unit.mocks.ur.urscript_robot import HOME, end_of, failure, logged, new_robot, results, run, start

BUILT_IN = functions((5, 15, 0))


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("1 + 2 * 3 - 4 / 8", "6.5"),
        ("(1 + 2) * -3", "-9"),
        ("7 % 3", "1"),
        ("-7.5 % 2", "-1.5"),
        ("1 + 1 == 2", "True"),
        ("3 >= 3.5", "False"),
        ('"a" != "b"', "True"),
        ("1 != True", "True"),
        ("not 1 == 2 and 3 >= 3", "True"),
        ("True xor True or False", "False"),
        ("False and undefined_yet", "False"),
        ("[1, 2.5][1]", "2.5"),
        ("[[1, 2], [3, 4]][1][0]", "3"),
        ("p[0, 0, 1, 0, 0, 0][2]", "1"),
        ("p[0, 0, 1, 0, 0, 0]", "p[0, 0, 1, 0, 0, 0]"),
        ("norm([3,\n  4  # in the next line\n])", "5.0"),
        ("1 +\n  2 *\n 3", "7"),
        ("norm(-2)", "2.0"),
        ("floor(-1.5)", "-2"),
        ("get_actual_joint_positions()", str(list(HOME))),
        ("get_target_joint_positions()", str(list(HOME))),
        ("get_target_joint_speeds()", str([0.0] * 6)),
        ("get_tcp_offset()", "p[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]"),
        ("get_steptime()", "0.002"),
        ("is_within_safety_limits([0, 0, 0, 0, 0, 7])", "False"),
        ("read_input_integer_register(47)", "0"),
        (r'"no \escape"', r"no \escape"),
    ],
)
def test_expressions(expression: str, value: str) -> None:
    before = "if False:\n  undefined_yet = True\nend"
    assert results(expression, before=before) == [value]


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
def spreading():
  global b = 6
end
free()
spreading()
"""
    assert results("a", "hidden()", "a", "deeper()", "a", "b", before=before) == ["1", "2", "1", "3", "4", "6"]


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
while True:   # for ever
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
copy = list
list[1] = odd
"""
    assert results("list", "copy", before=before) == ["[0, 25]", "[0, 0]"]


def test_halt_ends_the_program_inside_any_block_of_any_thread() -> None:
    body = '  while True:\n    if 1 < 2:\n      halt\n    end\n  end\n  textmsg("after")\n'
    for text in (f"def f():\n{body}end\n", f"def f():\n  thread t():\n  {body}\n  end\n  run t()\n  sleep(9)\nend\n"):
        robot = start(text)
        assert (end_of(robot).why, logged(robot)) == ("ended", [])


@pytest.mark.parametrize(
    ("body", "place", "why"),
    [
        ("  x = y\n  y = 1", (2, 3), "the variable y has no value here"),
        ("  def g():\n    z = 1\n  end\n  g()\n  textmsg(z)", (6, 3), "the variable z has no value here"),
        ("  while True:\n  end", (2, 3), "a loop needs sync"),
        ("  movej([0, 0, 0])", (2, 3), "movej: q must be a list of 6 numbers, not [0, 0, 0]"),
        ("  movej([0, 0, 0, 0, 0, 0], speed=1)", (2, 3), "movej: got an unexpected keyword argument 'speed'"),
        ("  movej([0, 0, 0, 0, 0, 0], v=0)", (2, 3), "must be positive"),
        ("  if 1:\n  end", (2, 3), "a condition must be True or False, not 1"),
        ("  x = 1 / 0", (2, 3), "division by zero"),
        ('  x = "a" + 1', (2, 3), "a + 1 is not possible"),
        ("  x = [1] + [2]", (2, 3), "[1] + [2] is not possible"),
        ("  x = [1][1]", (2, 3), "[1] has no element 1"),
        ("  x = 1 + norm([1, True])", (2, 11), "norm: a must be a number, not True"),
        ("  x = sleep(0)", (2, 7), "x = a function without a value"),
        ("  kill 3", (2, 3), "kill needs another thread, not 3"),
        ("  break", (2, 3), "break outside of a loop"),
        ("  write_output_integer_register(24, 1.5)", (2, 3), "must be a whole number"),
        ("  write_output_integer_register(48, 1)", (2, 3), "must be a whole number from 0 to 47, not 48"),
        ("  thread t():\n  end\n  t()", (4, 3), "t is a thread: write run"),
        ("  def g(a):\n  end\n  g()", (4, 3), "g: the argument a is missing"),
        ("  def g():\n    g()\n  end\n  g()", (3, 5), "functions call each other"),
        ("  x = 1" + " + 1" * 950, (2, 3), "functions call each other"),
    ],
)
def test_run_time_errors_say_what_is_wrong_and_where(body: str, place: tuple[int, int], why: str) -> None:
    end = failure(body)
    assert why in end.why
    assert why in end.detail["error"]
    assert (end.detail["line"], end.detail["column"]) == place


@pytest.mark.parametrize(
    ("text", "place", "why"),
    [
        ("def f():\n  x = \nend\n", (3, 1), "a name expected, found 'end'"),
        ("def f():\n  if x\n  end\nend\n", (3, 3), "':' expected"),
        ("def f():\n  while True:\n  sleep(1)\nend\n", (5, 1), "'end' expected"),
        ("def f():\n  x = 1 ! 2\nend\n", (2, 9), "'! 2' is no URScript"),
        ("def f():\n  1 + 2\nend\n", (3, 1), "an assignment or a call expected"),
        ("def f(x):\nend\n", (1, 1), "a program has no parameters"),
        ("def f():\n  sleep(a=1, 2)\nend\n", (2, 14), "an argument with a name expected"),
        ("def f():\n  end = 1\nend\n", (2, 7), "the end of the line expected"),
        ("def f():\nend\nx = 1\n", (3, 1), "nothing more expected"),
        ("def f():\n  x = 'single'\nend\n", (2, 7), "is no URScript"),
        ("def f():\n  x = (1, 2)\nend\n", (2, 9), "'\\)' expected"),
        ("def f():\n  x = 1 < 2 < 3\nend\n", (2, 13), "one comparison expected"),
        ("def f():\n  x = None\nend\n", (2, 7), "a name expected"),
        ("def f():\n  3 = x\nend\n", (2, 7), "only a variable"),
        ("(" * 3000, (1, 1), "nested too deeply"),
    ],
)
def test_what_is_no_program_is_rejected_with_its_place(text: str, place: tuple[int, int], why: str) -> None:
    with pytest.raises(UrscriptSyntaxError, match=why) as rejected:
        parse(text, "f", BUILT_IN)
    assert rejected.value.place == place
    line = (*text.split("\n"), "")[place[0] - 1]
    assert rejected.value.report == f"syntax_error_on_line:{place[0]}:{line}:"


@pytest.mark.parametrize(
    ("text", "place", "report"),
    [  # as URSim reports them
        ("def silly()\nend\n", (2, 1), "syntax_error_on_line:2:end:"),
        ('def silly():\n txtmsg("")\nend\n', (2, 2), "compile_error_name_not_found:txtmsg:"),
        ('def f():\n  textmsg("log ", get_tcp_offset()\nend\n', (3, 1), "syntax_error_on_line:3:end:"),
        ("def f():\n  x = abs(-1)\nend\n", (2, 7), "compile_error_name_not_found:abs:"),
        ("def illegal_fun():\n  calldoesntexist()\nend", (2, 3), "compile_error_name_not_found:calldoesntexist:"),
    ],
)
def test_errors_read_as_on_a_controller(text: str, place: tuple[int, int], report: str) -> None:
    with pytest.raises(UrscriptSyntaxError) as rejected:
        parse(text, "f", BUILT_IN)
    assert (rejected.value.place, rejected.value.report) == (place, report)


def test_a_program_that_is_rejected_leaves_the_running_one() -> None:
    robot = start("def g():\n  sleep(1)\nend\n")
    assert not start_upload(robot, Upload("f", "def f():\n  speedj([0, 0, 0, 0, 0, 0])\nend\n", secondary=False))
    refused = robot.events[-1]
    assert "syntax error: line 2: the name speedj does not exist, or is not modelled" in refused.why
    assert refused.detail == {"error": "compile_error_name_not_found:speedj:", "line": 2, "column": 3}
    assert answer(robot, "programState") == "PLAYING g"


def test_a_function_exists_from_its_version_on() -> None:
    text = "def f():\n  set_target_payload(1, [0, 0, 0.1], [0, 0, 0, 0, 0, 0])\nend\n"
    for polyscope, known in {(5, 9, 0): False, (5, 10, 0): True, (3, 14, 0): False, (10, 11, 0): True}.items():
        assert start_upload(new_robot(polyscope), Upload("f", text, secondary=False)) is known


WORDS = ["def f():\n", "thread t():\n", "if True:\n", "else:\n", "while x < 3:\n", "end\n", "break\n", "halt\n", "\n"]
WORDS += ["x = ", "x[1]", "f(", "a=", "run ", "kill x\n", "join x\n", "local ", "sync()\n", "sleep(1)\n", "not ", "1"]
WORDS += ["enter_critical\n", "2.5", '"text"', "p[", "#", *"[]),+-", "==", "(" * 3000, "-" * 3000, "1 + " * 3000]


@given(st.lists(st.sampled_from(WORDS), max_size=25).map("".join) | st.text(max_size=50))
def test_any_text_is_a_program_or_a_syntax_error_and_moves_nothing(text: str) -> None:
    """Also what happens to be a program: it runs for a while, ends, or is ended by an error."""
    robot = new_robot()
    if start_upload(robot, Upload("f", f"def f():\n{text}\nend\n", secondary=False)):
        run(robot, 0.12)
    else:
        assert "syntax error" in robot.events[-1].why
    assert robot.arm.at_rest


def test_one_line_alone_is_a_program_too() -> None:
    robot = start('textmsg("hello")\n')
    assert logged(robot) == ["hello"]
