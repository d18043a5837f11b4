"""A second publisher of a topic: found by looking again, and at once by stamps that are not in order."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from ftdrivers.errors import ProtocolError
from ftdrivers.ros2.subscription import OnePublisher
from tests.fake_clock import FakeClock


class Graph:
    """A node and its graph."""

    def __init__(self) -> None:
        self.node, self.names = self, ["one"]

    def get_publishers_info_by_topic(self, _topic: str) -> list[SimpleNamespace]:
        return [SimpleNamespace(node_name=name, node_namespace="/") for name in self.names]


@pytest.mark.parametrize("sign", ["a second", "stamps"])
def test_a_publisher_that_appears_late_is_found(sign: str) -> None:
    graph, clock = Graph(), FakeClock()
    publisher = OnePublisher(cast("Any", graph), "/ft/wrench", clock)
    publisher.check()
    graph.names = ["one", "other"]
    publisher.check()  # the next look is not due
    if sign == "a second":
        clock.sleep(1.1)
    with pytest.raises(ProtocolError, match="2 nodes publish /ft/wrench: /one, /other"):
        publisher.check(in_order=sign != "stamps")
