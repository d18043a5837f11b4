"""What is said where rclpy is missing."""

import sys

import pytest

from ftdrivers.errors import NoRos2
from ftdrivers.ros2.middleware import Node


def test_without_rclpy_one_sentence_says_both_ways_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(NoRos2, match=r"cannot import rclpy .*source a ROS 2 .*pip install 'ftdrive\[ros2\]'"):
        Node("ftdrive")
