"""Plans as URScript programs for the pendant, or as tables; URScript functions that use `ftdrive serve-load`.

Ref: Universal Robots, "The URScript Programming Language", SW 5: movej, get_actual_joint_positions, popup, textmsg,
read_input_integer_register, read_input_float_register, write_output_integer_register, read_output_integer_register,
get_steptime, sync. Checked on hardware: no.
"""

from collections.abc import Iterator
from math import degrees, pi, radians
from typing import Any, Final

from ftdrive.errors import PlanRefused
from ftdrive.exports.formats import plain_ascii
from ftdrive.planning.approach import NEAR_RAD
from ftdrive.planning.geometry.scene import MOUNTINGS
from ftdrive.planning.plan import Plan
from ftdrive.servers.program import CODES, DOUBLES, INTEGERS, TRACKED, Condition, ServiceCommand, ServiceState
from ftdrivers.ur.rtde import LAST_REGISTER

FORMAT = "ftdrive.targets/1"
COLUMNS = "pose,orientation,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,speed_rad_s,acceleration_rad_s2,clearance_m"
_FASTEST_RAD_S, _FASTEST_RAD_S2 = pi + 1e-9, radians(300) + 1e-9


def plan_table(plan: Plan) -> str:
    """Return a plan as CSV: a line per pose, with speed, acceleration and clearance of the move to the next pose.

    The first line is a comment with the format, the plan's hash, the model, and whether the cell was emulated.
    """
    _require_exportable(plan)
    emulated = ", EMULATED cell: no real arm may follow this plan" if plan.emulated else ""
    lines = [f"# {FORMAT} plan {plan.to_dict()['sha256']} {plain_ascii(plan.description['model'])}{emulated}", COLUMNS]
    for i, step in enumerate(plan.steps, start=1):
        numbers = (*step.q_rad, step.speed_rad_s, plan.acceleration_rad_s2, step.clearance_m)
        lines.append(",".join([str(i), str(step.number), *(f"{number:.9g}" for number in numbers)]))
    return "\n".join(lines) + "\n"


APPROACH_RAD_S, APPROACH_RAD_S2 = radians(10), radians(20)


def program(plan: Plan, *, dwell_s: float) -> str:
    """Return a URScript function that visits the poses of a plan, dwells at each, and returns to the first.

    Raises `PlanRefused` if a move is not proven clear, or if no arm can reach a value in the plan.
    """
    _require_exportable(plan)
    return "".join(
        f"{line}\n"
        for line in ("def ftdrive_tour():", *(f"  {line}" if line else "" for line in _body(plan, dwell_s)), "end")
    )


def _body(plan: Plan, dwell_s: float) -> Iterator[str]:
    sha256 = plan.sha256
    steps, model = plan.steps, plain_ascii(plan.description["model"])
    name = f"ftdrive plan {sha256[:12]}"
    first = _joint_row(steps[0].q_rad)
    emulated = "EMULATED CELL: no real arm may follow this plan. " if plan.emulated else ""
    yield f"# ftdrive plan {sha256}"
    yield f"# for a {model} with this tool, mm from the flange face:"
    for part in plan.description["tool"]:
        yield f"#   {_cylinder(part)}"
    yield "# proven clear, along all moves, of the arm itself and of these surroundings (mm, base axes):"
    yield from (f"#   {plain_ascii(line)}" for line in _scene(plan.description["scene"]))
    yield f"# {plain_ascii(plan.room_in_words())}"
    yield f"# Speed: {_speeds(plan)}."
    yield from (f"# {plain_ascii(sentence)}" for sentence in plan.why)
    yield "#"
    yield "# In PolyScope: a Script node of type File with this file, then one of type Line with ftdrive_tour()"
    yield "#"
    yield "# WARNINGS"
    for warning in _warnings(model, is_nominal=plan.kinematics is None):
        yield f"# - {warning}"
    yield ""
    yield f'textmsg("{name}: {len(steps)} poses")'
    yield (
        f'popup("{emulated}Only for a {model} with the tool of {name}. Keep the space '
        f"{plan.ball_in_words()} (the wrist){'' if plan.arm_rests else ' and the space around the whole arm'} free, "
        f"cables slack, hand on the emergency stop. Speed: {_speeds(plan)}. "
        'First time: speed slider at 30 percent. Continue moves the arm.", '
        f'title="ftdrive", warning=True, blocking=True)'
    )
    yield f"local first = {first}"
    yield "local here = get_actual_joint_positions()"
    yield "local joint = 0"
    yield "while joint < 6:"
    yield f"  if norm(here[joint] - first[joint]) > {NEAR_RAD:.6f}:"
    yield f'    textmsg("{name}: too far from its first pose, nothing was moved")'
    yield (
        f'    popup("The arm is more than {degrees(NEAR_RAD):.0f} degrees from the first pose: jog all joints to '
        f'{", ".join(f"{degrees(q):.0f}" for q in steps[0].q_rad)} degrees, then start again.", '
        'title="ftdrive", error=True, blocking=True)'
    )
    yield "    halt"
    yield "  end"
    yield "  joint = joint + 1"
    yield "end"
    yield ""
    yield "# Move to the first pose: slow, and not proven clear."
    yield f"movej({first}, a={APPROACH_RAD_S2:.6f}, v={APPROACH_RAD_S:.6f})"
    for i, step in enumerate((*steps, steps[0]), start=1):
        if i > 1:
            yield f"movej({_joint_row(step.q_rad)}, a={plan.acceleration_rad_s2:.6f}, v={steps[i - 2].speed_rad_s:.6f})"
        where = f"pose {i} of {len(steps)}" if i <= len(steps) else "pose 1 again"
        yield f'textmsg("{name}: {where}, orientation R{step.number:02d}")'
        yield f"sleep({dwell_s:.3f})"
    yield f'textmsg("{name}: done")'
    yield 'popup("The tour is complete.", title="ftdrive", blocking=False)'


def _warnings(model: str, *, is_nominal: bool) -> Iterator[str]:
    yield "This is not a safety function. The plan does not consider real cables, fixtures and people."
    yield f"Run it on a {model} with exactly this tool and mounting; in another cell the moves are not proven clear."
    if not is_nominal:
        yield "It is proven with the measured kinematics of one arm: on another one distances are up to 20 mm smaller."
    yield "The tool turns in all directions, also upside down: nothing loose, no fluid, nothing in the gripper."
    yield (
        f"The approach to the first pose is not in the plan: the program stops unless each joint is within "
        f"{degrees(NEAR_RAD):.0f} degrees of it."
    )
    yield "The first time: speed slider at 30 percent, hand on the emergency stop."
    yield "Nothing guards the motion but the arm's own safety system: while it runs, ftdrive can only listen."


def _speeds(plan: Plan) -> str:
    fastest_deg_s = degrees(max(step.speed_rad_s for step in plan.steps))
    tip_m_s = plan.description["speeds"]["tip_m_s"]
    limit = "are NOT LIMITED" if tip_m_s is None else f"up to {1e3 * tip_m_s:.0f} mm/s"
    return f"joints up to {fastest_deg_s:.0f} deg/s, the tips of the tool {limit}"


def _joint_row(q_rad: tuple[float, ...]) -> str:
    return f"[{', '.join(f'{round(q, 6) + 0.0:.6f}' for q in q_rad)}]"


def _scene(scene: dict[str, Any]) -> Iterator[str]:
    lean_rad = float(scene["lean_rad"])
    names = [name for name, angle in MOUNTINGS.items() if abs(lean_rad - angle) < 1e-9]
    yield f"mounted: {names[0] if names else f'base leans {degrees(lean_rad):.1f} deg towards its -x'}"
    # the first plane of a scene is the surface on which the arm is mounted
    for plane in scene["planes"]:
        normal = ":".join(f"{value:.6g}" for value in plane["normal"])
        place_mm = 1e3 * float(plane["offset_m"])
        yield f"plane {normal}:{place_mm:.1f}, the arm stays where normal times position is at least this value"
    for box in scene["boxes"]:
        yield f"box {':'.join(f'{1e3 * float(value):.1f}' for value in (*box['low_m'], *box['high_m']))}"
    if len(scene["planes"]) <= 1 and not scene["boxes"]:
        yield "nothing else: free space around the arm. Any table, wall or fixture is NOT in the plan"


def _cylinder(part: dict[str, Any]) -> str:
    mm = {name: f"{1e3 * float(value):.1f}" for name, value in part.items()}
    aside = f", axis at x {mm['x_m']}, y {mm['y_m']}" if float(part["x_m"]) or float(part["y_m"]) else ""
    return f"from {mm['from_m']} to {mm['to_m']}, diameter {mm['diameter_m']}{aside}"


def _require_exportable(plan: Plan) -> None:
    """Raise `PlanRefused` for a sweep, unmeasured surroundings, a move not proven clear, or values no arm can reach."""
    # A plan that is not proven clear is refused, because the exported text could not show that.
    if plan.sweep is not None:
        raise PlanRefused("this plan is a sweep, which no other program can follow: export the plan of a tour")
    if not plan.measured:
        raise PlanRefused(
            "tool, planes and boxes of this plan are not marked as measured: "
            "measure them, set measured = true in [workcell], and make a new plan"
        )
    if not plan.certified:
        raise PlanRefused("a move of the plan is not proven clear, so the plan is not exported: make a new plan")
    angles = [angle for step in plan.steps for angle in step.q_rad]
    if (
        any(len(step.q_rad) != 6 for step in plan.steps)
        or not all(abs(angle) <= 2 * pi + 1e-9 for angle in angles)
        or not all(0 < step.speed_rad_s <= _FASTEST_RAD_S for step in plan.steps)
        or not 0 < plan.acceleration_rad_s2 <= _FASTEST_RAD_S2
    ):
        raise PlanRefused("the plan has a joint angle, speed or acceleration that no arm can reach: make a new plan")


# URScript functions take `serve-load` as stopped if its live counter does not change for this time, s.
STALE_S: Final = 0.06
# Time-out, s, of a request to `serve-load`; states of a request that has no answer or no value.
LIMIT_S: Final = 2.0
GONE, LATE, UNSEEN = -1, -2, -3


def functions(first: int, *, example: bool = False) -> str:
    """Return the URScript functions for `serve-load`, with registers from `first` on, as in `serve-load --first`.

    With `example`, append a program that weighs a part and sets the payload.
    """
    integers = {name: f"read_input_integer_register({first + i})" for i, name in enumerate(INTEGERS)}
    doubles = {name: f"read_input_float_register({first + i})" for i, name in enumerate(DOUBLES + TRACKED)}
    values = {
        **integers,
        "FIRST": str(first),
        "COMMAND": str(first + 1),
        "STALE_S": str(STALE_S),
        "LIMIT_S": str(LIMIT_S),
        "GONE": str(GONE),
        "LATE": str(LATE),
        "STALE": str(int(Condition.STALE)),
        "CODES": ", ".join(f"{number} {name or 'ready'}" for name, number in CODES.items()),
        "WRENCH": ", ".join(doubles[name] for name in DOUBLES[:6]),
        "WEIGHT": ", ".join(doubles[name] for name in DOUBLES[6:]),
        "BIAS": ", ".join(doubles[name] for name in TRACKED[:6]),
        "AGE": doubles["bias_age"],
        "UNSEEN": str(UNSEEN),
        "ZEROS": ", ".join(["0.0"] * len(DOUBLES[6:])),
        **{one.name: str(int(one)) for one in (*ServiceCommand, *ServiceState)},
    }
    tracks = first + len(DOUBLES + TRACKED) <= LAST_REGISTER + 1
    text = _TEXT + (_BIAS if tracks else "") + (_EXAMPLE if example else "")
    for name, value in values.items():
        text = text.replace(f"<{name}>", value)
    return text


_TEXT = """\
# Functions for `ftdrive serve-load`, registers from <FIRST>.
# A state of 0 means success. <GONE>: the service or its sensor does not respond. <LATE>: no answer in time.
# Refused: <CODES>.
# In any other state, all numbers are 0: do not use them. Only `ftd_wrench` has further valid states.

# Whether wrench and weight are up to date; takes one to three cycles.
def ftd_alive():
  local before = <live>
  local still = 0.0
  while still < <STALE_S>:
    sync()
    still = still + get_steptime()
    if <live> != before:
      return <condition> != <STALE>
    end
  end
  return False
end

# [state, fx, fy, fz, tx, ty, tz] of the contact, N and N*m, as set in serve-load (base axes, about the TCP).
# The wrench is valid in states 0 (free tool), 1 (contact) and 2 (a load that was not weighed).
def ftd_wrench():
  if not ftd_alive():
    return [<GONE>, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
  end
  return [<condition>, <WRENCH>]
end

# Send a request and wait for its answer; return its state.
def ftd_request(command):
  local number = read_output_integer_register(<FIRST>) + 1
  if number > 1000000000:
    number = 1
  end
  if not ftd_alive():
    return <GONE>
  end
  write_output_integer_register(<COMMAND>, command)
  write_output_integer_register(<FIRST>, number)
  local last = <live>
  local still = 0.0
  local waited = 0.0
  local step = get_steptime()
  while waited < <LIMIT_S>:
    sync()
    waited = waited + step
    still = still + step
    if <live> != last:
      last = <live>
      still = 0.0
    end
    if still > <STALE_S>:
      return <GONE>
    end
    if <number> == number:
      if <state> == <READY>:
        return 0
      end
      if <state> == <REFUSED>:
        return <code>
      end
    end
  end
  return <LATE>
end

# Tare the empty gripper at rest; return 0 for success. Call it before each grasp.
def ftd_zero():
  return ftd_request(<ZERO>)
end

# 0 if the service answers.
def ftd_status():
  return ftd_request(<STATUS>)
end

# Weigh the part at rest, in 0.6 s: [state, mass, sigma, smallest mass, x, y, z, sigma of x, y, z], kg and m.
# Centre of mass in flange axes from the flange. A mass of 0 is an empty gripper. From now on, the weight of the
# part is subtracted from the wrench.
def ftd_weigh():
  local state = ftd_request(<WEIGH>)
  if state != 0:
    return [state, <ZEROS>]
  end
  return [0, <WEIGHT>]
end

# [mass, x, y, z] of tool and part together, from ftd_weigh and the payload of the tool alone.
def ftd_payload(weight, tool_kg, tool_cog):
  local mass = tool_kg + weight[1]
  local x = (tool_kg * tool_cog[0] + weight[1] * weight[4]) / mass
  local y = (tool_kg * tool_cog[1] + weight[1] * weight[5]) / mass
  local z = (tool_kg * tool_cog[2] + weight[1] * weight[6]) / mass
  return [mass, x, y, z]
end
"""

_BIAS = """\

# [state, age, fx, fy, fz, tx, ty, tz]: change of the bias since the calibration, N and N*m, sensor axes, and seconds
# since it was last observed. Needs `serve-load --track`. <UNSEEN>: it is not tracked, or not yet observed.
def ftd_bias():
  if not ftd_alive():
    return [<GONE>, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
  end
  local age = <AGE>
  if <tracking> == 0 or age < 0:
    return [<UNSEEN>, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
  end
  return [0, age, <BIAS>]
end
"""

_EXAMPLE = """\

# Example. `ftdrive export calibration --format ur-payload` gives the payload of the tool alone.
def ftd_example(tool_kg, tool_cog):
  if ftd_zero() != 0:
    popup("The scale has no zero.", title="ftdrive", error=True, blocking=True)
    halt
  end
  # close the gripper and lift the part here, then rest
  local weight = ftd_weigh()
  if weight[0] != 0:
    popup("The part was not weighed.", title="ftdrive", error=True, blocking=True)
    halt
  end
  local payload = ftd_payload(weight, tool_kg, tool_cog)
  set_target_payload(payload[0], [payload[1], payload[2], payload[3]])
end
"""
