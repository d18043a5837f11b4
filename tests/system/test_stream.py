"""`stream` of an emulated cell, as its viewers see it."""

import re
import signal
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from ftdrive.stream import ros2
from tests.system.command_line import CommandLine, end_of, listen_for
from tests.unit.ftdrive.servers.fake_stream import Client


@pytest.mark.slow
def test_a_viewer_sees_no_force_on_a_free_tool(ftdrive: CommandLine) -> None:
    process = ftdrive.start("stream", "--simulate", "--sensor", "emulated://serial", "--port", "0", "--axes", "base")
    printed = listen_for(process, "Press Ctrl-C to stop.")
    (port,) = set(re.findall(r"ws://127\.0\.0\.1:(\d+)", printed))
    store = get_typestore(Stores.ROS2_HUMBLE)
    force_N = {}
    with Client.to(int(port)) as viewer:
        for topic in (ros2.RAW, ros2.COMPENSATED):
            viewer.subscribe(topic)
            while (received := viewer.message())[0] != topic:
                pass
            message: Any = store.deserialize_cdr(received[2], ros2.SCHEMAS[topic].name)
            force_N[message.header.frame_id] = np.linalg.norm([getattr(message.wrench.force, axis) for axis in "xyz"])
        viewer.call("tare")
        assert viewer.answer()["success"]
    assert force_N["sensor"] > 1
    assert force_N["base_at_sensor"] < 0.5
    process.send_signal(signal.SIGINT)
    code, said = end_of(process)
    assert (code, said.strip().splitlines()[-1]) == (130, "interrupted")
