"""A graph in memory for the tests of devices by topic."""

import pytest

from tests.fake_clock import FakeClock
from tests.unit.drivers.ros2.graph_in_memory import Graph, install


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    graph = Graph(FakeClock())
    install(graph, monkeypatch)
    return graph
