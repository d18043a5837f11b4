"""What clients may set of a stream, whichever protocol brings it, and the parameters of the node of ROS 2."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Final, get_args

from ftcalib.files import JSON
from ftdrive.cell.rules import is_number
from ftdrive.errors import ConfigError
from ftdrive.live.samples import Axes, Point, Stages, WrenchFrame
from ftdrivers.ros2.middleware import ros2_module

_EXPECTED = {
    "axes": f"set one of {', '.join(get_args(Axes))}",
    "about": f"set one of {', '.join(get_args(Point))}, or x, y, z in metres from the flange",
    **dict.fromkeys(("bias", "gravity", "inertia"), "set true or false"),
    **dict.fromkeys(("notch_Hz", "lowpass_Hz"), "set a frequency; 0 switches the filter off"),
    **dict.fromkeys(("deadband_N", "deadband_Nm"), "set a number from 0"),
}


def checked_value(name: str, value: Any) -> JSON:
    """Return the value as the frame or the stages have it; raises `ConfigError`."""
    match name, value:
        case "axes", str() if value in get_args(Axes):
            return value
        case "about", str() if value in get_args(Point):
            return value
        case "about", [_, _, _] if all(map(is_number, value)):
            return tuple(float(x) for x in value)
        case (("bias" | "gravity" | "inertia"), bool()):
            return value
        case (("notch_Hz" | "lowpass_Hz"), _) if is_number(value) and value >= 0:
            return float(value) or None
        case (("deadband_N" | "deadband_Nm"), _) if is_number(value) and value >= 0:
            return float(value)
    raise ConfigError(f"{name} cannot be {value!r}: {_EXPECTED.get(name, 'there is no such parameter')}")


_FRAME_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")
_FRAME: Final = {
    "axes": "Axes of ~/wrench: sensor, flange, base or tcp.",
    "about": "Reference point of the torque of ~/wrench: sensor, flange, tcp, or [x, y, z] in m from the flange.",
}
_STAGES: Final = {
    "bias": "Subtract the bias.",
    "gravity": "Subtract the weight of the load.",
    "inertia": "Subtract the inertial wrench of the load; needs [sensor] height_mm.",
    "notch_Hz": "Frequency of the notch filter; 0 is off.",
    "lowpass_Hz": "Frequency of the low-pass filter; 0 is off.",
    "deadband_N": "Forces below it are 0.",
    "deadband_Nm": "Torques below it are 0.",
}
_TOOL: Final = "Name of the tool whose newest accepted calibration is applied; empty: the calibration of the start."


def _described(default: Any, text: str) -> Any:
    return field(default=default, metadata={"text": text})


@dataclass(frozen=True, slots=True)
class Fixed:
    """Parameters that a running node does not change."""

    rate: float = _described(
        500.0, "Highest rate of the wrench topics in Hz. A message is the mean of the samples of one interval."
    )
    reliable: bool = _described(
        False, "Reliable delivery. Otherwise best effort, depth 5, of which a reliable subscriber receives nothing."
    )
    base_frame: str = _described("base", "Frame of the controller's base: base of a UR, not base_link.")
    flange_frame: str = _described("tool0", "Frame of the flange, z out of it: tool0 of a UR, not flange.")
    sensor_frame: str = _described("ft_sensor", "Frame of the sensor, which ~/wrench_raw has.")
    publish_base_tf: bool = _described(
        False, "Also publish base to flange on /tf, which a driver of the arm usually does."
    )


_FIXED: Final[Mapping[str, str]] = {item.name: item.metadata["text"] for item in fields(Fixed)}


class NodeParameters:
    """Declares the parameters on a node, and applies what clients set.

    Parameters
    ----------
    node
        Of rclpy.
    frame : WrenchFrame
        Without another value in the arguments of ROS.
    tool : str

    Raises
    ------
    ConfigError
        A value in the arguments of ROS cannot be used.
    """

    def __init__(self, node: Any, frame: WrenchFrame, tool: str) -> None:
        self._node = node
        self.apply: Callable[[WrenchFrame, Stages, str], None] | None = None
        """Applies what is set, or raises `ConfigError`; None while there is no stream."""
        off = {name: 0.0 if value is None else value for name, value in asdict(Stages()).items()}
        given = {name: self._declare(name, value, _FRAME[name]) for name, value in frame.to_dict().items()}
        given |= {name: self._declare(name, value, _STAGES[name]) for name, value in off.items()}
        usable: dict[str, Any] = {name: checked_value(name, value) for name, value in given.items()}
        self.frame = WrenchFrame(**{name: usable[name] for name in _FRAME})
        self.stages = Stages(**{name: usable[name] for name in _STAGES})
        self.tool = _checked_tool(self._declare("tool", tool, _TOOL))
        values = {item.name: self._declare(item.name, item.default, _FIXED[item.name]) for item in fields(Fixed)}
        self.fixed = _checked_fixed(values)
        node.add_on_set_parameters_callback(self._set)

    def _declare(self, name: str, value: object, description: str) -> Any:
        messages = ros2_module("rcl_interfaces.msg")
        descriptor = messages.ParameterDescriptor(
            description=description,
            read_only=name in _FIXED,
            # 20 and 20.0 are both a frequency; what cannot be used is rejected with a reason
            dynamic_typing=True,
        )
        found = self._node.declare_parameter(name, value, descriptor).value
        return list(found) if isinstance(found, Sequence) and not isinstance(found, str) else found

    def _set(self, changes: Sequence[Any]) -> Any:
        """Apply all changes or none; called in the thread of the node."""
        result = ros2_module("rcl_interfaces.msg").SetParametersResult
        frame, stages, tool = asdict(self.frame), asdict(self.stages), self.tool
        try:
            for change in changes:
                value = list(change.value) if hasattr(change.value, "tolist") else change.value
                if change.name == "tool":
                    tool = _checked_tool(value)
                elif change.name in frame or change.name in stages:
                    (frame if change.name in frame else stages)[change.name] = checked_value(change.name, value)
            now = WrenchFrame(**frame), Stages(**stages), tool
            if self.apply is not None:
                self.apply(*now)
        except ConfigError as error:
            return result(successful=False, reason=str(error))
        self.frame, self.stages, self.tool = now
        return result(successful=True)


def _checked_tool(value: object) -> str:
    if not isinstance(value, str):
        raise ConfigError(f"tool cannot be {value!r}: set the name of a tool")
    return value


def _checked_fixed(values: dict[str, Any]) -> Fixed:
    for item in fields(Fixed):
        value = values[item.name]
        if item.name == "rate":
            is_right = isinstance(value, int | float) and not isinstance(value, bool) and 1 <= value <= 2000
            fix = "set 1 to 2000 Hz"
        elif isinstance(item.default, bool):
            is_right, fix = isinstance(value, bool), "set true or false"
        else:
            is_right = isinstance(value, str) and _FRAME_NAME.fullmatch(value) is not None
            fix = "set a name of letters, digits and _ . / -, a letter first"
        if not is_right:
            raise ConfigError(f"the parameter {item.name} cannot be {value!r}: {fix}")
    return Fixed(**values)
