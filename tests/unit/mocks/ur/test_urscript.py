"""URScript on the emulated controller: the language, and which texts are refused or end with an error."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftmocks.ur.dashboard import answer
from ftmocks.ur.uploads import Upload, start_upload
from ftmocks.ur.urscript.library import functions
from ftmocks.ur.urscript.parser import parse
from ftmocks.ur.urscript.syntax import NotEmulated, UrscriptSyntaxError
from tests.unit.mocks.ur.urscript_robot import HOME, failure, new_robot, results, run, start

BUILT_IN = functions((5, 15, 0))


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("1 + 2 * 3 - 4 / 8", "6.5"),
        ("(1 + 2) * (-3)", "-9"),
        ("-7.5 % 2", "-1.5"),
        ('"a" != "b"', "True"),
        ("1 != True", "True"),
        ("not 1 == 2 and 3 >= 3", "True"),
        ("True xor True or False", "False"),
        ("False and undefined_yet", "False"),
        ("[p[0, 0, 3, 0, 0, 0], p[0, 0, 1, 0, 0, 0]][1][2]", "1"),
        ("p[0, 0, 1, 0, 0, 0]", "p[0, 0, 1, 0, 0, 0]"),
        ("norm([3,\n  4  # in the next line\n])", "5.0"),
        ("9.03E-5 * .5", "4.515e-05"),
        ("floor(-1.5)", "-2"),
        ("get_actual_joint_positions()", str(list(HOME))),
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


@pytest.mark.parametrize(
    ("body", "place", "why"),
    [
        ("  x = y\n  y = 1", (2, 3), "the variable y has no value here"),
        ("  def g():\n    z = 1\n  end\n  g()\n  textmsg(z)", (6, 3), "the variable z has no value here"),
        ("  while True:\n  end", (2, 3), "a loop needs sync"),
        ("  movej([0, 0, 0])", (2, 3), "movej: q must be a list of 6 numbers, not [0, 0, 0]"),
        ("  movej([0, 0, 0, 0, 0, 0], speed=1)", (2, 3), "movej: got an unexpected keyword argument 'speed'"),
        ("  if 1:\n  end", (2, 3), "a condition must be True or False, not 1"),
        ("  x = 1 / 0", (2, 3), "division by zero"),
        ('  x = "a" + 1', (2, 3), "a + 1 is not possible"),
        ("  x = 1 + norm([1, True])", (2, 11), "norm: a must be a number, not True"),
        ("  break", (2, 3), "break outside of a loop"),
        ("  write_output_integer_register(48, 1)", (2, 3), "must be a whole number from 0 to 47, not 48"),
        ("  thread t():\n  end\n  t()", (4, 3), "t is a thread: write run"),
        ("  def g():\n    g()\n  end\n  g()", (3, 5), "functions call each other"),
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
        ("def f():\n  while True:\n  sleep(1)\nend\n", (5, 1), "'end' expected"),
        ("def f():\n  x = 1 ! 2\nend\n", (2, 9), "'! 2' is not URScript"),
        ("def f(x):\nend\n", (1, 1), "a program has no parameters"),
        ("def f():\n  sleep(a=1, 2)\nend\n", (2, 14), "a named argument expected after"),
        ("def f():\nend\nx = 1\n", (3, 1), "nothing more expected"),
        ("def f():\n  x = 1 < 2 < 3\nend\n", (2, 13), "one comparison expected"),
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
        ("def illegal_fun():\n  calldoesntexist()\nend", (2, 3), "compile_error_name_not_found:calldoesntexist:"),
    ],
)
def test_errors_read_as_on_a_controller(text: str, place: tuple[int, int], report: str) -> None:
    with pytest.raises(UrscriptSyntaxError) as rejected:
        parse(text, "f", BUILT_IN)
    assert (rejected.value.place, rejected.value.report) == (place, report)


@pytest.mark.parametrize(
    ("text", "place", "what"),
    [
        ("def f():\n  x = 2 ^ 3\nend\n", (2, 9), "'^'"),
        ("def f():\n  x = [[1, 2], [3, 4]]\nend\n", (2, 7), "a list of lists (a matrix)"),
        ("def f():\n  switch x:\nend\n", (2, 3), "'switch'"),
    ],
)
def test_what_is_urscript_is_not_called_an_error(text: str, place: tuple[int, int], what: str) -> None:
    with pytest.raises(NotEmulated, match=f"{re.escape(what)} is valid URScript, but not emulated here") as rejected:
        parse(text, "f", BUILT_IN)
    assert rejected.value.place == place


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("  h = 0\n  thread t():\n    sync()\n  end\n  h = run t()", "h changes its type from int to Thread"),
        ("  x = True\n  def g():\n    x = 1\n  end", "x changes its type from bool to int"),
        ("  def g(a):\n    if a:\n      return 1\n    end\n    return 1.5\n  end", "g returns float and int"),
        ("  def g(a):\n    if a:\n      return\n    end\n    return True\n  end", "g returns bool and nothing"),
    ],
)
def test_a_type_that_changes_is_rejected_where_the_text_shows_it(body: str, why: str) -> None:
    with pytest.raises(UrscriptSyntaxError, match=why):
        parse(f"def f():\n{body}\nend\n", "f", BUILT_IN)


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("  t = 0\n  t = t + get_steptime()\n  t = is_steady()", "the variable t changes from float to bool"),
        ("  def g(a):\n    return a\n  end\n  x = g(1)\n  y = g(1.5)", "the value of g changes from int to float"),
        ("  q = [1, 2]\n  q = [1, 2, 3]", "Resizing of 'List' is not supported: q has 2 elements"),
        ("  q = [1, 2]\n  q[0] = q", "a list of lists is not emulated"),
    ],
)
def test_a_type_that_changes_while_the_program_runs_ends_it(body: str, why: str) -> None:
    assert why in failure(body).why


@pytest.mark.parametrize(
    ("text", "doubt"),
    [
        ("def f():\n  while False:\n    x = 1\n  end\nend\n", "line 3: x gets its first value inside a loop"),
        (
            "def f():\n  x = 1\n  def g():\n    return x\n  end\nend\n",
            "line 4: x is not declared global in the program",
        ),
        ("def f():\n  # why\n  sync()\nend\n", "the program has lines of comment"),
        (f"def {'n' * 32}():\nend\n", "has more than 31 characters"),
        ("def f():\n  if True:\n    global x = 1\n  end\nend\n", "line 3: 'global' inside an if or while"),
        ("def f():\n  x = 1 + -2\nend\n", "line 2: a sign after '+'"),
        ("def f():\n  x = 9.03E-5\nend\n", "line 2: 9.03E-5 has an exponent"),
    ],
)
def test_what_reports_contradict_about_runs_and_is_recorded(text: str, doubt: str) -> None:
    robot = start(text)
    (found,) = robot.events[0].detail["doubts"]
    assert doubt in found


def test_a_program_that_is_rejected_leaves_the_running_one() -> None:
    robot = start("def g():\n  sleep(1)\nend\n")
    assert not start_upload(robot, Upload("f", "def f():\n  speedj([0, 0, 0, 0, 0, 0])\nend\n", secondary=False))
    refused = robot.events[-1]
    assert "syntax error: line 2: the name speedj does not exist, or is not modelled" in refused.why
    assert refused.detail == {"error": "compile_error_name_not_found:speedj:", "line": 2, "column": 3}
    assert answer(robot, "programState") == "PLAYING g"


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
