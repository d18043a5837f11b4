"""What is said where rclpy is missing, and how Fast DDS is kept on loopback."""

import os
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from ftdrivers.errors import NoRos2
from ftdrivers.ros2.middleware import Node, _stay_on_loopback


def test_without_rclpy_one_sentence_says_both_ways_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(NoRos2, match=r"cannot import rclpy .*source ROS 2 .*on Linux x86-64 `.*ros2"):
        Node("ftdrive")


@pytest.mark.parametrize(
    ("variables", "stays"),
    [
        ({}, False),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, False),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, True),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "FASTRTPS_DEFAULT_PROFILES_FILE": "own.xml"}, False),
    ],
)
def test_a_node_of_this_computer_alone_binds_to_loopback(
    variables: dict[str, str], stays: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "environ", dict(variables))
    _stay_on_loopback()
    file = os.environ.get("FASTDDS_DEFAULT_PROFILES_FILE")
    assert (file is not None) is stays
    if file is not None:
        addresses = [one.text for one in ET.parse(file).iter("{http://www.eprosima.com}address")]
        assert addresses == ["127.0.0.1"]
