"""What clients may set of a stream, by Foxglove and by ROS 2: checked, and all of it or nothing."""

from array import array
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from ftdrive.errors import ConfigError
from ftdrive.servers import parameters as of_ros2
from ftdrive.servers.parameters import NodeParameters, checked_value
from ftdrive.stream.samples import Stages, WrenchFrame

FRAME = WrenchFrame("base", "tcp")


@pytest.mark.parametrize(
    ("name", "value", "fix"),
    [
        ("axes", "tool", "set one of sensor, flange, base, tcp"),
        ("about", "base", "or x, y, z in metres from the flange"),
        ("about", [0.1, 0.2, True], "x, y, z"),
        ("about", [0.1, 0.2, float("nan")], "x, y, z"),
        ("gravity", 1, "set true or false"),
        ("notch_Hz", -1, "set a frequency; 0 switches the filter off"),
        ("deadband_N", -0.1, "set a number from 0"),
        ("tara", True, "there is no such parameter"),
    ],
)
def test_another_value_is_rejected_with_those_that_are_right(name: str, value: Any, fix: str) -> None:
    with pytest.raises(ConfigError, match=rf"{name} cannot be .*: .*{fix}"):
        checked_value(name, value)


class FakeNode:
    """A node whose arguments of ROS give some values; they arrive as rclpy has them."""

    def __init__(self, **given: Any) -> None:
        self.given = given
        self.declared: dict[str, Any] = {}
        self._changed: Callable[[list[Any]], Any]

    def declare_parameter(self, name: str, value: Any, descriptor: Any) -> Any:
        self.declared[name] = descriptor
        return SimpleNamespace(value=self.given.get(name, value))

    def add_on_set_parameters_callback(self, callback: Any) -> None:
        self._changed = callback

    def set(self, **values: Any) -> Any:
        return self._changed([SimpleNamespace(name=name, value=one) for name, one in values.items()])


@pytest.fixture(autouse=True)
def _no_ros2(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = SimpleNamespace(ParameterDescriptor=SimpleNamespace, SetParametersResult=SimpleNamespace)
    monkeypatch.setattr(of_ros2, "ros2_module", lambda _: fake)


@pytest.mark.parametrize(
    ("name", "value", "fix"),
    [
        ("rate", 0.9, "set 1 to 2000 Hz"),
        ("rate", 2001, "set 1 to 2000 Hz"),
        ("reliable", 1, "set true or false"),
        ("base_frame", "1base", "a letter first"),
    ],
)
def test_a_node_with_a_wrong_fixed_parameter_does_not_start(name: str, value: Any, fix: str) -> None:
    with pytest.raises(ConfigError, match=f"the parameter {name} cannot be {value!r}: .*{fix}"):
        NodeParameters(FakeNode(**{name: value}), FRAME, "")


def test_a_node_applies_all_changes_or_none() -> None:
    node, applied = FakeNode(), list[Any]()
    found = NodeParameters(node, FRAME, "")
    assert node.set(axes="sensor").successful
    found.apply = lambda *now: applied.append(now)
    assert node.set(about=array("d", [0.0, 0.1, 0.2]), bias=False, tool="drill", use_sim_time=True).successful
    now = WrenchFrame("sensor", (0.0, 0.1, 0.2)), Stages(bias=False), "drill"
    assert applied == [now]
    assert (found.frame, found.stages, found.tool) == now
    for changes, reason in (
        ({"gravity": False, "tool": 3}, "tool cannot be 3: set the name of a tool"),
        ({"gravity": False, "axes": "x"}, "axes cannot be 'x'"),
    ):
        refused = node.set(**changes)
        assert not refused.successful
        assert reason in refused.reason
    assert applied == [now]
    assert found.stages == Stages(bias=False)
