"""Who publishes a topic, which messages have which numbers, and whose clock gave their stamps."""

from typing import Any, cast

import pytest

from ftdrivers.errors import ConnectError, ProtocolError
from ftdrivers.ros2.middleware import Received, clock_diagnosis, subscribe
from tests.unit.drivers.ros2.graph_in_memory import RELIABLE, Graph

TOPIC, KIND = "/ft/wrench", "geometry_msgs/msg/WrenchStamped"


def subscribed(graph: Graph, *, reliable: bool = False) -> tuple[str, list[Received]]:
    """Return the publisher and the list that is filled with what it sends."""
    got: list[Received] = []
    return subscribe(cast("Any", graph), TOPIC, KIND, got.append, graph.clock, reliable=reliable), got


def test_names_and_a_second_publisher_are_awaited(graph: Graph) -> None:
    graph.clock.at(1.0, lambda: graph.add(TOPIC, KIND, "_NODE_NAME_UNKNOWN_"))
    graph.clock.at(1.3, graph.publishers.clear)
    graph.clock.at(1.3, lambda: graph.add(TOPIC, KIND, "driver", space="/cell/"))
    assert subscribed(graph)[0] == "/cell/driver"
    assert graph.clock.now_s() == pytest.approx(1001.8, abs=0.06)
    graph.clock.at(0.45, lambda: graph.add(TOPIC, KIND, "_NODE_NAME_UNKNOWN_"))
    with pytest.raises(ProtocolError, match="2 nodes publish /ft/wrench: /cell/driver, a program without a node"):
        subscribed(graph)


def test_another_type_and_delivery_that_is_not_offered_are_refused(graph: Graph) -> None:
    graph.add(TOPIC, "geometry_msgs/msg/PoseStamped")
    with pytest.raises(ConnectError, match=r"/ft/wrench has the type geometry_msgs/msg/PoseStamped, but "):
        subscribed(graph)
    graph.publishers.clear()
    graph.add(TOPIC, KIND)
    with pytest.raises(ConnectError, match="published with best effort only"):
        subscribed(graph, reliable=True)
    subscribed(graph)
    assert graph.profiles[TOPIC].reliability == "best effort"
    assert graph.kinds[TOPIC] == "WrenchStamped"
    graph.publishers.clear()
    graph.add(TOPIC, KIND, reliability=RELIABLE)
    subscribed(graph, reliable=True)
    assert graph.profiles[TOPIC].reliability == "reliable"
    assert graph.profiles[TOPIC].depth >= 100  # a reader that pauses for a moment loses nothing


@pytest.mark.parametrize(
    ("behind_ms", "words"),
    [
        (-1.5, "is -1.5 ms old by the clock of this computer"),
        (29.0, "is 29.0 ms old by the clock of this computer"),
        (-2.5, "2 ms ahead of that of this computer"),
        (-40.0, "40 ms ahead of that of this computer"),
        (31.0, "31 ms behind that of this computer"),
    ],
)
def test_stamps_of_another_clock_are_reported(graph: Graph, behind_ms: float, words: str) -> None:
    graph.wall_ahead_s = 5.0
    found = clock_diagnosis(cast("Any", graph), 1005.0 - 1e-3 * behind_ms)
    assert words in found.found
    assert found.passed


def test_a_topic_that_subscribers_alone_know_is_no_topic_of_its_type(graph: Graph) -> None:
    graph.get_topic_names_and_types = lambda: [(TOPIC, [KIND])]  # type: ignore[method-assign]
    with pytest.raises(ConnectError, match="no topic has this type"):
        subscribed(graph)
