"""Stream parameters that clients may set, for all protocols, and the parameters of the ROS 2 node."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from types import NoneType
from typing import TYPE_CHECKING, Any, Final, cast, get_args

from ftcalib.files import JSON
from ftdrive.cell.rules import is_number
from ftdrive.errors import ConfigError
from ftdrive.stream.samples import Axes, Point, Stages, WrenchFrame
from ftdrivers.ros2.middleware import ros2_module

if TYPE_CHECKING:
    from ftdrive.stream.stream import Stream

_FRAME: Final = {
    "axes": "Axes of ~/wrench: sensor, flange, base or tcp.",
    "about": "Reference point of the torque of ~/wrench: sensor, flange, tcp, or [x, y, z] in m from the flange.",
}
STAGE_TEXTS: Final[Mapping[str, str]] = {item.name: item.metadata["text"] for item in fields(Stages)}
"""Description of each setting of `Stages`, by name."""
_KINDS: Final[dict[str, type]] = {item.name: type(item.default) for item in fields(Stages)}
_EXPECTED: Final = {
    "axes": f"set one of {', '.join(get_args(Axes))}",
    "about": f"set one of {', '.join(get_args(Point))}, or x, y, z in metres from the flange",
    bool: "set true or false",
    NoneType: "set a frequency; 0 switches the filter off",
    float: "set a number from 0",
    int: "set a whole number from 0",
    str: "set a name of letters, digits and _ . / -, a letter first",
}


def checked_value(name: str, value: Any) -> JSON:
    """Return a parameter's value in the type that `WrenchFrame` or `Stages` requires; `ConfigError` if invalid."""
    kind = _KINDS.get(name)
    named = {"axes": get_args(Axes), "about": get_args(Point)}.get(name, ())
    if value in named or (kind is bool and isinstance(value, bool)):
        return cast("JSON", value)
    match name, value:
        case "about", [_, _, _] if all(map(is_number, value)):
            return tuple(float(x) for x in value)
    if kind in (NoneType, float, int) and is_number(value) and value >= 0 and (kind is not int or value == int(value)):
        return int(value) if kind is int else float(value) or (0.0 if kind is float else None)
    raise ConfigError(f"{name} cannot be {value!r}: {_EXPECTED.get(kind or name, 'there is no such parameter')}")


def parameters_of(frame: WrenchFrame, stages: Stages) -> dict[str, JSON]:
    """Return all parameters of a stream; a filter that is off has 0 Hz, because a parameter cannot be None."""
    return frame.to_dict() | {name: 0.0 if value is None else value for name, value in asdict(stages).items()}


def with_changes(frame: WrenchFrame, stages: Stages, changes: Iterable[tuple[str, Any]]) -> tuple[WrenchFrame, Stages]:
    """Return the frame and the stages with changed parameters. Raises `ConfigError` if a value is invalid."""
    of_frame, of_stages = asdict(frame), asdict(stages)
    for name, value in changes:
        (of_frame if name in of_frame else of_stages)[name] = checked_value(name, value)
    return WrenchFrame(**of_frame), Stages(**of_stages)


def set_stream(stream: "Stream", frame: WrenchFrame, stages: Stages, then: Callable[[], object] = lambda: None) -> None:
    """Set frame and stages of a stream, and call `then`; if either raises `ConfigError`, the stream is unchanged."""
    before = stream.frame, stream.stages
    try:
        stream.frame, stream.stages = frame, stages
        then()
    except ConfigError:
        stream.frame, stream.stages = before
        raise


_FRAME_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")


def _described_parameter(default: Any, text: str) -> Any:
    return field(default=default, metadata={"text": text})


@dataclass(frozen=True, slots=True)
class Fixed:
    """Parameters that are fixed while a node runs. Raises `ConfigError` for values that cannot be used."""

    rate: float = _described_parameter(
        500.0, "Highest rate of the wrench topics in Hz. A message is the mean of the samples of one interval."
    )
    reliable: bool = _described_parameter(
        False, "Reliable delivery. Otherwise best effort with depth 5, which a reliable subscriber cannot receive."
    )
    base_frame: str = _described_parameter("base", "Name of the controller's base frame: base for a UR, not base_link.")
    flange_frame: str = _described_parameter("tool0", "Name of the flange frame, z out: tool0 for a UR, not flange.")
    sensor_frame: str = _described_parameter("ft_sensor", "Name of the sensor frame, used by ~/wrench_raw.")
    publish_base_tf: bool = _described_parameter(
        False, "Also publish the transform from base to flange on /tf, which the arm's driver usually does."
    )

    def __post_init__(self) -> None:
        for item in fields(self):
            value, kind = getattr(self, item.name), type(item.default)
            if kind is float:
                is_right, fix = is_number(value) and 1 <= value <= 2000, "set 1 to 2000 Hz"
            else:
                is_right, fix = isinstance(value, kind), _EXPECTED[kind]
            if not is_right or (kind is str and not _FRAME_NAME.fullmatch(value)):
                raise ConfigError(f"the parameter {item.name} cannot be {value!r}: {fix}")


_FIXED: Final[Mapping[str, str]] = {item.name: item.metadata["text"] for item in fields(Fixed)}
_TEXTS: Final = {
    **_FRAME,
    **STAGE_TEXTS,
    "tool": "Name of the tool whose newest accepted calibration is applied; empty for the initial calibration.",
    **_FIXED,
}


class NodeParameters:
    """Declares the parameters on an rclpy node, and applies changes by clients.

    ROS arguments replace `frame` and `tool`. Raises `ConfigError` if one of their values cannot be used.
    """

    def __init__(self, node: Any, frame: WrenchFrame, tool: str) -> None:
        self.apply: Callable[[WrenchFrame, Stages, str], None] = lambda *_: None
        """Called with the new frame, stages and tool to apply them; raises `ConfigError` to reject them."""
        defaults = parameters_of(frame, Stages()) | {"tool": tool} | asdict(Fixed())
        messages = ros2_module("rcl_interfaces.msg")
        given = {}
        for name, value in defaults.items():
            descriptor = messages.ParameterDescriptor(
                description=_TEXTS[name],
                read_only=name in _FIXED,
                # 20 and 20.0 are both valid frequencies; invalid values are rejected with a reason
                dynamic_typing=True,
            )
            given[name] = _as_builtin(node.declare_parameter(name, value, descriptor).value)
        fixed, tool = {name: given.pop(name) for name in _FIXED}, given.pop("tool")
        self.frame, self.stages = with_changes(frame, Stages(), given.items())
        self.tool, self.fixed = _checked_tool(tool), Fixed(**fixed)
        node.add_on_set_parameters_callback(self._set)

    def _set(self, changes: Sequence[Any]) -> Any:
        """Apply all changes or none. Called in the node's thread."""
        result = ros2_module("rcl_interfaces.msg").SetParametersResult
        # other parameters, such as use_sim_time, belong to rclpy
        given = {one.name: _as_builtin(one.value) for one in changes if one.name in _TEXTS.keys() - _FIXED.keys()}
        try:
            tool = _checked_tool(given.pop("tool", self.tool))
            now = *with_changes(self.frame, self.stages, given.items()), tool
            self.apply(*now)
        except ConfigError as error:
            return result(successful=False, reason=str(error))
        self.frame, self.stages, self.tool = now
        return result(successful=True)


def _as_builtin(value: Any) -> Any:
    return list(value) if isinstance(value, Sequence) and not isinstance(value, str) else value


def _checked_tool(value: object) -> str:
    if not isinstance(value, str):
        raise ConfigError(f"tool cannot be {value!r}: set the name of a tool")
    return value
