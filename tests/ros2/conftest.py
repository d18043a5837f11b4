"""Tests that need rclpy: `uv run --isolated --group ros2 pytest -m ros2`. On loopback, each in its domain."""

import os
from itertools import count
from pathlib import Path
from zlib import crc32

import pytest

_HERE = Path(__file__).parent
_MODULES = ("rclpy", "geometry_msgs.msg", "sensor_msgs.msg", "diagnostic_msgs.msg", "std_srvs.srv", "std_msgs.msg")
_numbers = count()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all tests of this folder."""
    for item in items:
        if item.path.parent == _HERE:
            item.add_marker(pytest.mark.ros2)
            item.add_marker(pytest.mark.filterwarnings("ignore::DeprecationWarning"))  # in rclpy and its imports


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    """A domain of its own, among those whose ports are below the ephemeral ones of Linux."""
    for module in _MODULES:
        pytest.importorskip(module, reason="the group ros2 is not installed")
    run = crc32(os.environ.get("PYTEST_XDIST_TESTRUNUID", str(os.getpid())).encode())
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + (run + 50 * worker + next(_numbers)) % 100))  # two workers never share
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    monkeypatch.delenv("RMW_IMPLEMENTATION", raising=False)
