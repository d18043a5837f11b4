"""The functions with which a URScript program uses `ftdrive serve-load`.

Ref: Universal Robots, "The URScript Programming Language", SW 5: read_input_integer_register,
read_input_float_register, write_output_integer_register, read_output_integer_register, get_steptime, sync.
Checked on hardware: no.
"""

from typing import Final

from ftdrive.servers.program import CODES, DOUBLES, INTEGERS, TRACKED, Command, Condition, State
from ftdrivers.ur.rtde import LAST_REGISTER

# Without a new live counter for so long the service is gone; the states below 0 have no other meaning.
STALE_S: Final = 0.06
# So long a request may take.
LIMIT_S: Final = 2.0
GONE, LATE, UNSEEN = -1, -2, -3


def functions(first: int, *, example: bool = False) -> str:
    """Write the functions for registers from `first` on, and a program that uses them.

    Parameters
    ----------
    first : int
        As given to `serve-load --first`.
    example : bool
        Append a program that weighs a part and sets the payload.
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
        **{one.name: str(int(one)) for one in (*Command, *State)},
    }
    tracks = first + len(DOUBLES + TRACKED) <= LAST_REGISTER + 1
    text = _TEXT + (_BIAS if tracks else "") + (_EXAMPLE if example else "")
    for name, value in values.items():
        text = text.replace(f"<{name}>", value)
    return text


_TEXT = """\
# Functions for `ftdrive serve-load`, registers from <FIRST>.
# A state of 0 is good. <GONE>: the service is gone, or its sensor is silent. <LATE>: no answer in time.
# Refused: <CODES>.
# With any other state than 0 all numbers are 0: never use them.

# Whether wrench and weight are up to date; takes one to some cycles.
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
# The state is 0 when nothing touches, 1 in contact, 2 with a load that was not weighed: the wrench is valid then.
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

# Tare the empty gripper at rest: 0 is good. Call it before each grasp.
def ftd_zero():
  return ftd_request(<ZERO>)
end

# 0 if the service answers.
def ftd_status():
  return ftd_request(<STATUS>)
end

# Weigh the part at rest, in 0.6 s: [state, mass, sigma, smallest mass, x, y, z, sigma of x, y, z], kg and m.
# Centre of mass in flange axes from the flange. A mass of 0 is an empty gripper. The wrench is without the part from
# now on.
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
# since it was seen last. Needs `serve-load --track`. <UNSEEN>: it is not followed, or was not seen yet.
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

# An example: the payload of the tool alone is that of `ftdrive export calibration --format ur-payload`.
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
