"""Programs as PolyScope saves them: texts of our own with its constructs, of each generation.

The constructs and their sources: docs/reference/urscript-constructs.md.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pytest

from ftmocks.disturbances import Push
from ftmocks.kinematics import MODELS, Vector6, forward, pose_of, vector6
from ftmocks.ur.dashboard import answer
from ftmocks.ur.modes import Runtime
from ftmocks.ur.robot import Robot
from tests.unit.mocks.ur.urscript_robot import HOME, end_of, logged, new_robot, results, run, start

POLYSCOPE = {"3": (3, 15, 0), "5": (5, 15, 0), "10": (10, 11, 0)}


def java(value: float) -> str:
    """A number as PolyScope writes it."""
    if value and not 1e-3 <= abs(value) < 1e7:
        mantissa, exponent = f"{value:.15e}".split("e")
        return f"{float(mantissa)}E{int(exponent)}"
    return repr(float(value))


def pose(q: Sequence[float]) -> str:
    """The pose of the flange at joint angles, without the zero in front of the point."""
    values = pose_of(forward(MODELS["UR5e"], q))
    return "p[" + ", ".join(f"{value:.12f}".replace("0.", ".", 1) for value in values) + "]"


def at(*turned: float) -> Vector6:
    """Joint angles off the start, rad."""
    return vector6([q + turn for q, turn in zip(HOME, (*turned, *[0.0] * 6), strict=False)])


def waypoint(name: str, q: Sequence[float]) -> str:
    joints = ", ".join(map(java, q))
    return f"global {name}_p={pose(q)}\n  global {name}_q=[{joints}]"


NEAR = vector6([math.pi / 4 + 0.1, *HOME[1:5], 9.03e-5 + HOME[5]])
FAR = at(0.2, 0.1)
LOW = at(0.1, 0.05)
NEAR_, FAR_, LOW_ = waypoint("Waypoint_1", NEAR), waypoint("Waypoint_2", FAR), waypoint("Waypoint_3", LOW)
MOVEJ = "movej(get_inverse_kin({0}_p, qnear={0}_q), a=1.3962634015954636, v=1.0471975511965976)".format

DOMAINS = """set_standard_analog_input_domain(0, 1)
  set_standard_analog_input_domain(1, 1)
  set_tool_analog_input_domain(0, 1)
  set_tool_analog_input_domain(1, 1)
  set_analog_outputdomain(0, 0)
  set_analog_outputdomain(1, 0)
  set_input_actions_to_default()"""
TOOL = """set_tool_communication(False, 115200, 0, 1, 1.5, 3.5)
  set_tool_output_mode(0)
  set_tool_digital_output_mode(0, 1)
  set_tool_digital_output_mode(1, 1)
  set_tool_voltage(0)"""
COUNTER = """step_count_4c0f_11 = {zero}
  thread Step_Counter_Thread_7d1e_22():
    while (True):
      step_count_4c0f_11 = step_count_4c0f_11 + {one}
      sync()
    end
  end
  run Step_Counter_Thread_7d1e_22()""".format
PREAMBLE = {
    "3": f"""{DOMAINS}
  set_tool_voltage(0)
  set_tcp(p[0.0,0.0,0.0,0.0,0.0,0.0])
  set_payload(0.0)
  set_gravity([9.82, 1.803904735144051E-15, 6.013015783813504E-16])
  set_safety_mode_transition_hardness(1)
  {COUNTER(zero=0, one=1)}""",
    "5": f"""global _hidden_verificationVariable=0
  set_gravity([0.0, 0.0, 9.82])
  set_tcp(p[0.0,0.0,0.0,0.0,0.0,0.0])
  set_target_payload(0.000000, [0.000000, 0.000000, 0.000000], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
  {TOOL}
  set_safety_mode_transition_hardness(1)
  {DOMAINS}
  {COUNTER(zero="0.0", one="1.0")}""",
    "10": f"""global _hidden_verificationVariable = 0
  set_gravity([0.0, 0.0, 9.82])
  set_tcp(p[0.0,0.0,0.0,0.0,0.0,0.0], "Tool_flange")
  set_target_payload(0.5, [0.0, 0.0, 5.0E-2], [9.03E-5, 9.03E-5, 9.03E-5, 0.0, 0.0, 0.0])
  {TOOL}
  {DOMAINS}""",
}
TOWARDS = """def calculate_point_to_move_towards(feature, direction, position_distance):
    local posDir=[direction[0], direction[1], direction[2]]
    if (norm(posDir) < 1e-6):
      return get_target_waypoint()
    end
    local unit=normalize(posDir)
    local step=p[unit[0] * position_distance, unit[1] * position_distance, unit[2] * position_distance, 0, 0, 0]
    local wanted=pose_sub(pose_trans(feature, step), feature)
    return pose_add(get_target_tcp_pose(), wanted)
  end"""


def contact(robot: Robot) -> None:
    """Something opposes the tool, which moves down."""
    robot.world.touch("push", Push(np.array([0.0, 0.0, 30.0, 0.0, 0.0, 0.0])))


class Saved(NamedTuple):
    """A program, what the operator does 0.6 s after its start, and what becomes of it."""

    name: str
    generation: str
    body: str
    says: list[str]
    """Messages in the log of the pendant."""
    seconds: float = 1.5
    ends: bool = True
    """Else it plays on."""
    meanwhile: Callable[[Robot], object] = lambda _: None
    stands: Vector6 | None = None
    """Where the arm is in the end."""
    shows: Callable[[Robot], object] = lambda _: True


PROGRAMS = [
    Saved(
        "waypoints on a wall",
        "3",
        f"""{NEAR_}
  {FAR_}
  $ 1 "Robot Program"
  $ 2 "MoveJ"
  $ 3 "Waypoint_1"
  {MOVEJ("Waypoint_1")}
  $ 4 "MoveL"
  $ 5 "Waypoint_2"
  movel(Waypoint_2_p, a=1.2, v=0.25)
  textmsg(step_count_4c0f_11 > 100)""",
        ["True"],
        seconds=3.5,
        stands=FAR,
        shows=lambda r: r.target_gravity_m_s2 == (9.82, 1.803904735144051e-15, 6.013015783813504e-16),
    ),
    Saved(
        "installation node with lines of comment",
        "3",
        """# begin: URCap Installation Node
  #   Source: Sensor_Node, 1.0.3, Example
  #   Type: Sensor
  ###########################################
  # Talks to nothing
  ###########################################

  def relative(P_from, P_to, Pi):
    # only this line, and
    # this one
    return pose_trans(P_to, pose_trans(pose_inv(P_from), Pi))
  end

  def difference(list1, list2):
    global node_list=list1
    i=0
    while i<length(list1):
      node_list[i]=list1[i] - list2[i]
      i=i+1
    end
    return node_list
  end
  if (not get_standard_digital_in(0) == False):
   popup("Not connected", "Sensor", error=True)
  # in front of else
  elif (norm(difference([3,4], [0,0])) == 5):
    # nothing is done here
  else:
    # nor here
  end
  # end: URCap Installation Node
  $ 1 "Robot Program"
  $ 2 "'a comment of the tree'"
  # 'a comment of the tree'
  textmsg(relative(p[0,0,0,0,0,0], p[0,0,.5,0,0,0], p[0,0,.25,0,0,0])[2])
  textmsg(node_list)
  $ 3 "Halt"
  halt""",
        ["0.75", "[3, 4]"],
    ),
    Saved(
        "move down until contact",
        "5",
        f"""{TOWARDS}
  global move_thread_flag_3=0
  thread move_thread_3():
    enter_critical
    move_thread_flag_3 = 1
    local towardsPos=calculate_point_to_move_towards(p[0.0,0.0,0.0,0.0,0.0,0.0], [0.0,0.0,-1.0], 1000.0)
    movel(towardsPos, a=1.2, v=0.02)
    move_thread_flag_3 = 2
    exit_critical
  end
  move_thread_flag_3 = 0
  move_thread_han_3 = run move_thread_3()
  global start_z=get_actual_tcp_pose()[2]
  while (True):
    local targetTcpDirection=get_target_tcp_speed()
    local stepsToRetract=tool_contact(direction=targetTcpDirection)
    if (stepsToRetract > 0):
      kill move_thread_han_3
      stopl(3.0)
      local backTrackMovement=get_actual_joint_positions_history(stepsToRetract)
      local contactPose=get_forward_kin(backTrackMovement)
      local posDir=[targetTcpDirection[0],targetTcpDirection[1],targetTcpDirection[2]]
      local retractTo=contactPose
      if (norm(posDir) > 1e-6):
        local unit=normalize(posDir)
        retractTo = pose_sub(contactPose, p[unit[0] * 0.0, unit[1] * 0.0, unit[2] * 0.0, 0, 0, 0])
      end
      movel(retractTo, a=3.0, v=0.1)
      break
    end
    sync()
  end
  global moved=start_z-get_actual_tcp_pose()[2]
  textmsg(moved > 0.005)
  textmsg(moved < 0.03)""",
        ["True", "True"],
        meanwhile=contact,
    ),
    Saved(
        "move of PolyScope X",
        "10",
        f"""{FAR_}
  # Move
  $ 3 "Move" "breakAfter"
  {MOVEJ("Waypoint_2")}
  textmsg(is_steady())""",
        ["False"],
        seconds=2.5,
        stands=FAR,
        shows=lambda r: r.payload_inertia == (9.03e-5, 9.03e-5, 9.03e-5, 0.0, 0.0, 0.0),
    ),
    Saved(
        "watch of a contribution",
        "10",
        """eject_error_flag = 0
  thread watch_a084():
    set_tool_digital_out(0,False)
    sleep(0.2)
    set_standard_digital_out(7,True)
    eject_error_flag = 1
    return False
  end
  ma = run watch_a084()
  while (get_standard_digital_in(2) == False):
    if (eject_error_flag == 1):
      kill ma
      popup("Check the switch.",title="Not ejected.",error=True,blocking=True)
      break
    end
    sync()
  end
  kill ma
  textmsg(eject_error_flag)""",
        ["1"],
        meanwhile=lambda r: answer(r, "close popup"),
        shows=lambda r: r.signals.outputs == 1 << 7,
    ),
]


@pytest.mark.parametrize("saved", PROGRAMS, ids=lambda saved: f"{saved.generation}: {saved.name}")
def test_what_polyscope_saves_runs_to_its_end(saved: Saved) -> None:
    text = f"def saved():\n  {PREAMBLE[saved.generation]}\n  {saved.body}\nend\n"
    robot = start(text, new_robot(POLYSCOPE[saved.generation]))
    run(robot, 0.6)
    saved.meanwhile(robot)
    run(robot, saved.seconds)
    assert logged(robot) == saved.says
    if saved.ends:
        assert end_of(robot).why == "ended"
    assert (robot.runtime == Runtime.PLAYING) is not saved.ends
    if saved.stands is not None:
        assert robot.arm.q == pytest.approx(saved.stands, abs=1e-6)
    assert saved.shows(robot)


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("floor(r2d(d2r(1.5)) + 0.1)", "1"),
        ("pose_trans(p[1, 0, 0, 0, 0, d2r(90)], p[1, 0, 0, 0, 0, 0])[1]", "1.0"),
        ("pose_add(p[0, 0, 1, 0, 0, 0], pose_inv(p[0, 0, 2, 0, 0, 0]))[2]", "-1.0"),
        ("floor(100 * norm(pose_add(p[1, 0, 0, 1, 0, 0], pose_sub(p[0, 2, 0, 0, 0, 1], p[1, 0, 0, 1, 0, 0]))))", "223"),
        ("point_dist(p[0, 0, 0, 0, 0, 0], interpolate_pose(p[0, 0, 0, 0, 0, 0], p[3, 4, 0, 0, 0, 1], 0.5))", "2.5"),
        ("norm(get_inverse_kin(get_forward_kin())[3] - d2r(-50)) < 1E-6", "True"),
        ("get_target_tcp_speed()", str([0.0] * 6)),
        ("get_configurable_digital_in(0) or get_tool_digital_in(1) or get_digital_out(9)", "False"),
    ],
)
def test_functions_of_poses_numbers_and_signals(expression: str, value: str) -> None:
    assert results(expression) == [value]


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("  set_tool_voltage()", "set_tool_voltage: missing a required argument: 'voltage'"),
        ("  set_standard_digital_out(8, True)", "the number of a digital signal must be a whole number from 0 to 7"),
        ("  x = get_inverse_kin(p[9, 0, 0, 0, 0, 0])", "get_inverse_kin: x: no solution for the pose"),
        ("  x = pose_inv([0, 0, 0, 0, 0, 0])", "pose_inv: p_from must be a pose, not [0, 0, 0, 0, 0, 0]"),
        ("  x = normalize([0, 0])", "normalize: [0, 0] has no direction"),
    ],
)
def test_wrong_arguments_end_the_program(body: str, why: str) -> None:
    robot = start(f"def f():\n{body}\nend\n")
    run(robot, 3.0)
    assert any(why in event.why for event in robot.events)
    assert robot.runtime != Runtime.PLAYING


def test_a_question_that_the_operator_cancels_ends_the_program() -> None:
    robot = start('def f():\n  x = request_boolean_from_primary_client("Go on?")\n  textmsg(x)\nend\n')
    assert robot.popup == "Go on?"
    answer(robot, "close popup")
    run(robot, 0.1)
    assert (end_of(robot).why, logged(robot)) == ("ended", [])
