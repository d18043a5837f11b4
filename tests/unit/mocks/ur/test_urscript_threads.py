"""URScript programs that wait and move: threads, the heartbeat of a guarded move, popups, settings."""

import pytest

from ftmocks.ur.modes import Runtime
from ftmocks.ur.robot import Robot
from tests.unit.mocks.ur.urscript_robot import results, run, start

GUARDED = """
def segment():
  global done = False
  thread mover():
    movej([0.785, -1.745, 1.047, -0.873, 1.571, 2.785], a=0.7, v=0.5)
    done = True
    return False
  end
  local hb = read_input_integer_register(24)
  local missed_s = 0.0
  thr = run mover()
  while not done:
    local x = read_input_integer_register(24)
    if x == hb:
      missed_s = missed_s + get_steptime()
    else:
      missed_s = 0.0
    end
    hb = x
    if (missed_s > 0.2) or (read_input_integer_register(25) != 0):
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


def beat(robot: Robot, seconds: float) -> None:
    """Let the client count its heartbeat every 8 ms."""
    for _ in range(round(seconds / 0.008)):
        robot.write_inputs({"input_int_register_24": robot.input_int(24) + 1})
        run(robot, 0.008)


@pytest.fixture
def guarded() -> Robot:
    """A guarded move of 2 rad, at its full speed while the heartbeat counts."""
    robot = start(GUARDED)
    beat(robot, 1.0)
    assert robot.arm.actual_qd[5] == pytest.approx(0.5, rel=0.01)
    return robot


def test_a_guarded_move_stops_when_the_heartbeat_stands_still(guarded: Robot) -> None:
    run(guarded, 0.19)
    assert guarded.arm.qd[5] == pytest.approx(0.5, rel=1e-9)
    run(guarded, 0.02)
    assert guarded.arm.qd[5] < 0.5
    run(guarded, 0.5 / 2.0)
    assert guarded.arm.at_rest
    assert guarded.output_ints[24] == -1
    run(guarded, 0.01)
    assert guarded.runtime == Runtime.STOPPED


SIDE_BY_SIDE = """
order = 0
n = 0
thread first():
  while n < 5:
    order = order * 10 + 1
    n = n + 1
    sync()
  end
  return False
end
thread second():
  while n < 5:
    order = order * 10 + 2
    sync()
  end
end
worker = run first()
run second()
order = order * 10 + 3
join worker
"""
OWN_VARIABLES = """
shared = 1
thread t():
  shared = 2
  own = 3
  return False
end
join run t()
own = 4
"""
CRITICAL = """
n = 0
thread t():
  enter_critical
  sleep(1)
  exit_critical
end
run t()
enter_critical
while n < 3:
  sync()
  n = n + 1
end
exit_critical
"""


@pytest.mark.parametrize(
    ("before", "values"),
    [
        (SIDE_BY_SIDE, {"order": "3121212121"}),  # in the order of their start, and joined
        (OWN_VARIABLES, {"shared": "2", "own": "4"}),
        (CRITICAL, {"n": "3"}),  # it is executed, and lets others run while it waits
    ],
    ids=["side-by-side", "own-variables", "critical-section"],
)
def test_threads(before: str, values: dict[str, str]) -> None:
    assert results(*values, before=before) == list(values.values())
