"""servoj: a program that evaluates a curve every cycle, and what the controller stops."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from ftmocks.ur.modes import Runtime, SafetyMode
from tests.unit.mocks.ur.urscript_robot import HOME, logged, run, start

TURN_RAD_S, LOOKAHEAD_S, SERVO_LAG_S = 1.5, 0.1, 0.005
SWEEP = """def sweep():
  def target(t):
    local q = [0, 0, 0, 0, 0, 0]
    local i = 0
    while i < length(q):
      q[i] = home[i]
      i = i + 1
    end
    q[4] = q[4] + 0.4 * sin(1.5 * t) * sin(1.5 * t)
    q[5] = q[5] - 0.8 * (1 - cos(1.5 * t))
    return q
  end
  thread mover():
    local k = 0
    while k * get_steptime() < 5:
      if k * get_steptime() < 8 * 3.141592653589793 / 6:
        servoj(target(k * get_steptime()), t=get_steptime(), lookahead_time=0.1, gain=300)
      else:
        servoj(home, t=get_steptime(), lookahead_time=0.1, gain=300)
      end
      k = k + 1
    end
    stopj(4)
    textmsg("swept")
  end
  home = get_target_joint_positions()
  local moving = run mover()
  while read_input_integer_register(24) == 0:
    sync()
  end
  kill moving
  stopj(4)
  textmsg("stopped")
end
"""


def curve(t: NDArray[np.float64]) -> NDArray[np.float64]:
    turn = TURN_RAD_S * np.clip(t, 0.0, 2 * math.pi / TURN_RAD_S)
    return np.array([HOME[4] + 0.4 * np.sin(turn) ** 2, HOME[5] - 0.8 * (1 - np.cos(turn))]).T


@pytest.mark.slow
def test_another_thread_stops_the_sweep() -> None:
    robot = start(SWEEP)
    run(robot, 1.5)
    assert max(map(abs, robot.arm.qd)) > 0.3
    robot.write_inputs({"input_int_register_24": 1})
    run(robot, 0.5)
    assert logged(robot) == ["stopped"]
    assert robot.arm.at_rest
    assert robot.runtime == Runtime.STOPPED


@pytest.mark.parametrize(
    ("step_rad", "stops"), [(math.radians(180) * 0.002 * 0.99, False), (math.radians(180) * 0.002 * 1.01, True)]
)
def test_a_target_beyond_the_speed_of_the_joint_is_a_protective_stop(step_rad: float, stops: bool) -> None:
    robot = start(
        "def f():\n  q = get_target_joint_positions()\n  k = 0\n"
        "  while k < 100:\n    q[5] = q[5] - 0.002\n    servoj(q, t=0.002)\n    k = k + 1\n  end\n"
        f"  q[5] = q[5] - {step_rad}\n  servoj(q, t=0.002)\n  sleep(1)\n  stopj(4)\nend\n"
    )
    run(robot, 0.6)
    assert (robot.safety_mode == SafetyMode.PROTECTIVE_STOP) is stops
    if stops:
        (stop,) = [event for event in robot.events if event.by == "safety"]
        assert "joint 6 jumps by -0.0063 rad in 0.002 s" in stop.why
        assert robot.runtime == Runtime.PAUSED
        assert robot.arm.at_rest
