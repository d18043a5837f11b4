"""What the node publishes, to rclpy and to a second implementation, and how it reports faults."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from threading import Event, Thread
from typing import Any

import numpy as np
import psutil
import pytest
from scipy.spatial.transform import Rotation

from ftdrive.errors import ConfigError
from ftdrive.exports.registry import Settings, export_calibration
from ftdrive.stream.processing import Processor
from ftdrive.stream.samples import EventKind, Stages, StreamEvent, WrenchFrame
from ftdrivers.errors import NoRos2
from ftdrivers.ros2.middleware import Node, ros2_module
from tests.ros2.fake_cell import Stream
from tests.target_formulas import evaluate
from tests.unit.ftdrive.stream import simulated

HASH = "RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77"
"""Of geometry_msgs/msg/WrenchStamped, as ROS 2 Jazzy and Kilted announce it."""
WAIT_S = 20.0


def until(found: Callable[[], Any]) -> Any:
    """Wait for something; a busy computer may need long."""
    deadline_s = time.monotonic() + WAIT_S
    while not (value := found()):
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
    return value


class Served:
    """A node that serves a stream in a thread."""

    def __init__(self, stack: ExitStack, *arguments: str, tool: str = "", fails: tuple[Exception, ...] = ()) -> None:
        from ftdrive.servers.ros2 import Ros2Node

        self.stream = Stream()
        self.failures = list(fails)
        self._end = Event()
        self.node = Ros2Node(("--ros-args", *arguments) if arguments else (), tool=tool)
        stack.callback(self.node.close)
        thread = Thread(target=self._serve, daemon=True)
        stack.callback(thread.join, WAIT_S)
        stack.callback(self._end.set)
        thread.start()

    def _serve(self) -> None:
        read = self.stream.read

        def read_or_end() -> Any:
            if self._end.is_set():
                raise KeyboardInterrupt
            return read()

        self.stream.read = read_or_end  # type: ignore[method-assign]
        with suppress(KeyboardInterrupt):
            self.node.serve(self._open)

    @contextmanager
    def _open(self) -> Iterator[Any]:
        if self._end.is_set():
            raise KeyboardInterrupt
        if self.failures:
            raise self.failures[0]
        yield self.stream


class Listener:
    """A second node in this process."""

    def __init__(self, stack: ExitStack) -> None:
        self.ros = Node("listener")
        stack.callback(self.ros.close)
        self.node = self.ros.node
        self.reports: list[tuple[float, dict[str, tuple[int, str]]]] = []
        self.wrench_s: list[float] = []
        array = ros2_module("diagnostic_msgs.msg").DiagnosticArray
        self.node.create_subscription(array, "/diagnostics", self._report, 10)
        sensor_data = ros2_module("rclpy.qos").qos_profile_sensor_data
        wrench = ros2_module("geometry_msgs.msg").WrenchStamped
        self.node.create_subscription(wrench, "/ftdrive/wrench", self._received, sensor_data)
        self.ros.spin()

    def _report(self, array: Any) -> None:
        found = {one.name.partition(": ")[2]: (one.level[0], one.message) for one in array.status}
        self.reports.append((time.monotonic(), found))

    def _received(self, _: Any) -> None:
        self.wrench_s.append(time.monotonic())

    def call(self, service: str) -> Any:
        srv = ros2_module("std_srvs.srv").Trigger
        client = self.node.create_client(srv, f"/ftdrive/{service}")
        assert client.wait_for_service(WAIT_S)
        future = client.call_async(srv.Request())
        until(future.done)
        return future.result()

    def set(self, name: str, value: Any) -> Any:
        from rclpy.parameter import Parameter
        from rclpy.parameter_client import AsyncParameterClient

        client = AsyncParameterClient(self.node, "/ftdrive")
        assert client.wait_for_services(WAIT_S)
        future = client.set_parameters([Parameter(name, value=value)])
        until(future.done)
        answer: Any = future.result()
        return answer.results[0]


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def started(stack: ExitStack, *command: str) -> subprocess.Popen[str]:
    process = stack.enter_context(subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, text=True))
    stack.callback(process.kill)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def received(process: subprocess.Popen[str]) -> list[Any]:
    out, _ = process.communicate(timeout=60)
    return [json.loads(line) for line in out.splitlines()]


@pytest.mark.parametrize("topic", ["wrench_raw", "wrench"])
def test_both_implementations_receive_numbers_and_stamps_of_the_stream(stack: ExitStack, topic: str) -> None:
    pytest.importorskip("cyclonedds")
    wanted = 600
    clients = [
        started(stack, "-m", "tests.ros2.clients", name, f"/ftdrive/{topic}", str(wanted), "reliable")
        for name in ("rclpy", "cyclonedds")
    ]
    served = Served(stack, "-p", "reliable:=true", "-p", "axes:=base")
    with ThreadPoolExecutor() as pool:  # a pipe that is not read would stop a client
        first, second = pool.map(received, clients)
    info = served.stream.info
    raw = topic == "wrench_raw"
    sent = {
        int(t_ns): values.tolist()
        for block in served.stream.blocks
        for t_ns, values in zip(block.t_host_ns + info.utc_offset_ns, block.raw if raw else block.wrench, strict=True)
    }
    stamps = list(sent)
    for client, messages in (("rclpy", first), ("cyclonedds", second)):
        places = [stamps.index(one[0]) for one in messages]
        missing = sorted(set(range(places[0], places[-1])) - set(places))
        assert not missing, (client, places[0], missing)
        assert all(sent[t_ns] == numbers for t_ns, _, numbers, _ in messages)
        assert {frame for _, frame, _, _ in messages} == {"ft_sensor" if raw else "base_at_ft_sensor"}


def test_the_type_hash_is_that_of_the_interface(stack: ExitStack) -> None:
    Served(stack)
    listener = Listener(stack)
    (info,) = until(lambda: listener.node.get_publishers_info_by_topic("/ftdrive/wrench"))
    version_1 = "RIHS01_" + bytes(info.topic_type_hash.value).hex()
    assert (info.topic_type, version_1) == ("geometry_msgs/msg/WrenchStamped", HASH)
    assert info.qos_profile.reliability == ros2_module("rclpy.qos").ReliabilityPolicy.BEST_EFFORT


def test_a_silent_sensor_is_reported_and_nothing_is_published(stack: ExitStack) -> None:
    served, listener = Served(stack), Listener(stack)
    until(lambda: listener.wrench_s and listener.reports)
    served.stream.silent = True
    silent_s = time.monotonic()
    until(lambda: listener.reports[-1][1]["stream"][0] == 2)
    assert listener.reports[-1][1]["sensor"] == (2, "the sensor sent nothing new for 0.3 s")
    last_s = listener.wrench_s[-1]
    assert last_s - silent_s < 0.3  # what was under way
    assert not listener.call("tare").success
    assert listener.wrench_s[-1] == last_s
    served.stream.silent = False
    until(lambda: listener.wrench_s[-1] > last_s and listener.reports[-1][1]["stream"][0] == 0)


def test_a_wrong_calibration_is_reported_until_the_stream_opens(
    stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ftdrive.servers.ros2._RETRY_CONFIG_S", 1.0)
    wrong = ConfigError("the calibration is of another sensor: calibrate this cell")
    served, listener = Served(stack, fails=(wrong,)), Listener(stack)
    until(lambda: any(found["stream"] == (2, str(wrong)) for _, found in listener.reports))
    assert not listener.wrench_s
    served.failures.clear()
    until(lambda: listener.wrench_s)


def test_a_tare_in_contact_is_refused_with_a_reason(stack: ExitStack) -> None:
    served, listener = Served(stack), Listener(stack)
    until(lambda: listener.wrench_s)
    kinds: tuple[EventKind, ...] = ("tool", "gap")
    for kind in kinds:
        served.node.add(None, [StreamEvent(7, kind, "logged as information, then as a warning")])
    assert listener.call("tare").success
    assert served.stream.tares == 1
    served.stream.contact = True
    answer = listener.call("tare")
    assert (answer.success, answer.message) == (False, "3.4 N from the free tool")
    assert listener.call("undo_tare").success
    assert served.stream.tares == 0


def test_parameters_are_applied_or_rejected_with_a_reason(stack: ExitStack) -> None:
    served, listener = Served(stack), Listener(stack)
    until(lambda: listener.wrench_s)
    assert listener.set("axes", "base").successful
    assert listener.set("lowpass_Hz", 20).successful
    assert listener.set("about", [0.0, 0.0, 0.15]).successful
    assert served.stream.frame == WrenchFrame("base", (0.0, 0.0, 0.15))
    assert served.stream.stages.lowpass_Hz == 20.0
    assert listener.set("tool", "gripper").successful
    for name, value, why in (
        ("tool", "hammer", "no accepted calibration of the tool 'hammer'"),
        ("tool", 3, "tool cannot be 3"),
        ("axes", "world", "axes cannot be 'world': set one of sensor"),
        ("about", "tcp", "height of the sensor is not configured"),
        ("lowpass_Hz", -1.0, "set a frequency"),
        ("rate", 100.0, "read-only"),
    ):
        answer = listener.set(name, value)
        assert not answer.successful
        assert why in answer.reason
    assert served.stream.frame == WrenchFrame("base", (0.0, 0.0, 0.15))


@pytest.mark.parametrize(
    ("argument", "error"),
    [
        ("axes:=world", ConfigError),
        ("rate:=0.0", ConfigError),
        ("sensor_frame:=7", ConfigError),
        ("reliable:=often", ConfigError),
        ("axes", NoRos2),
    ],
)
def test_wrong_arguments_end_it_before_any_work(argument: str, error: type[Exception]) -> None:
    from ftdrive.servers.ros2 import Ros2Node

    with pytest.raises(error, match=r"axes|rate|sensor_frame|reliable"):
        Ros2Node(("--ros-args", "-p", argument))


def test_of_two_nodes_the_second_needs_another_name(stack: ExitStack) -> None:
    from ftdrive.servers.ros2 import Ros2Node

    Served(stack)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ftdrive.servers.ros2._DISCOVERY_S", 10.0)  # a busy computer
        with pytest.raises(ConfigError, match=r"a node /ftdrive is already running: .* __node:=ftdrive_2"):
            Ros2Node()
    other = Ros2Node(("--ros-args", "-r", "__node:=ftdrive_2"))
    assert other.name == "/ftdrive_2"
    other.close()


def test_subscribers_go_on_after_a_node_is_killed_and_restarted(stack: ExitStack) -> None:
    listener = Listener(stack)
    first = started(stack, "-m", "tests.ros2.fake_cell")
    until(lambda: listener.wrench_s)
    first.kill()
    first.wait()
    seen = len(listener.wrench_s)
    second = started(stack, "-m", "tests.ros2.fake_cell")
    until(lambda: len(listener.wrench_s) > seen + 100)
    second.send_signal(signal.SIGINT)
    assert second.wait(WAIT_S) == 0
    assert listener.node.count_publishers("/ftdrive/wrench") <= 1  # that which was killed may still be listed


def test_the_exported_broadcaster_computes_the_wrench_of_the_node(stack: ExitStack) -> None:
    calibration = simulated.calibrated()
    processor = Processor(simulated.info(calibration, 500.0), settings=Stages())
    R = Rotation.random(200, rng=np.random.default_rng(3)).as_matrix()
    listener, served = Listener(stack), Served(stack, "-p", "reliable:=true")
    processed = processor.process(simulated.paired(R, 500.0), last=True)
    received: dict[str, list[Any]] = {"wrench": [], "wrench_raw": []}
    wrench = ros2_module("geometry_msgs.msg").WrenchStamped
    for topic, messages in received.items():
        listener.node.create_subscription(wrench, f"/ftdrive/{topic}", messages.append, 1000)
    until(lambda: min(map(len, received.values())) > 10)
    served.stream.replaced = processed
    until(lambda: served.stream.replaced is None and min(map(len, received.values())) > 10)
    stamps = set((processed.t_host_ns + served.stream.info.utc_offset_ns).tolist())
    until(lambda: all(len(of_stamps(messages, stamps)) == len(R) for messages in received.values()))
    raw, compensated = (of_stamps(received[topic], stamps) for topic in ("wrench_raw", "wrench"))
    made = export_calibration(calibration, "ros2-control", Settings(), max_force_error_N=np.inf)
    context = {"R_flange_sensor": calibration.R_flange_sensor, "p_flange_sensor_m": np.zeros(3)}
    assert np.allclose(evaluate("ros2-control", made.text, R, raw, context), compensated, atol=1e-9)


def of_stamps(messages: list[Any], stamps: set[int]) -> Any:
    """Return the wrenches (n, 6) of these stamps."""
    return np.array(
        [
            [getattr(part, axis) for part in (one.wrench.force, one.wrench.torque) for axis in "xyz"]
            for one in messages
            if one.header.stamp.sec * 10**9 + one.header.stamp.nanosec in stamps
        ]
    )


def test_no_port_is_open_to_other_computers() -> None:
    node = Node("local")
    base = 7400 + 250 * int(os.environ["ROS_DOMAIN_ID"])  # of RTPS, in each domain
    try:
        at = {one.laddr.port: one.laddr.ip for one in psutil.Process().net_connections("udp4") if one.laddr}
    finally:
        node.close()
    found = {ip for port, ip in at.items() if base <= port < base + 250}
    assert found == {"127.0.0.1"}
