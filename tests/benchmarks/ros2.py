"""The node of `ftdrive ros2` beside a plain publisher of rclpy: lost messages, latency and CPU at 500 Hz.

    uv run --isolated --group ros2 python -m tests.benchmarks.ros2 [--seconds 60] [--sensor ur-ft]

An emulated cell at real pace, the node and its reliable subscribers are processes of their own: first one subscriber of
rclpy, for latency and CPU, then one more of Cyclone DDS. What they receive is compared with the blocks that the stream
of the node gave. Latency: from the receipt of a sample by our driver to the subscriber's callback. Samples that arrived
while the stream was being opened are left out, because they wait until the rates are measured. A plain publisher sends
the same message at the same rate and nothing else. Two free cores are needed, so the load is printed too. Exit code 1
if a target is missed.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import click
import numpy as np

from ftdrive.cell.emulated import REAL_PACE, Station
from ftdrive.live.samples import Block
from ftdrive.live.stream import CompensatedStream
from ftdrive.servers.rates import Averaged
from ftdrivers.clock import REAL
from tests.unit.ftdrive.live.simulated import calibrated_from

RATE_HZ = 500.0
PASSES = ("plain", ("rclpy",)), ("node", ("rclpy",)), ("node", ("rclpy", "cyclonedds"))
LATENCY_MS, CPU = 10.0, 0.35
RELIABLE = ("--ros-args", "-p", "reliable:=true", "-p", "axes:=base")


class Ended(Exception):
    """The benchmark has what it needs."""


class Kept(CompensatedStream):
    """Keeps what it gives, until stdin is closed."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.blocks: list[Block] = []
        self.begin = 0.0, 0.0, 0
        """Time in s, CPU time in s and time in ns of the first block."""
        self.ended = threading.Event()

    def __enter__(self) -> Self:
        super().__enter__()
        self.received = self._stack.enter_context(self._sensor.follow())
        return self

    def read(self, timeout_s: float = 1.0) -> Block:
        if self.ended.is_set():
            raise Ended
        block = super().read(timeout_s)
        if not self.blocks:
            self.begin = time.monotonic(), time.process_time(), time.monotonic_ns()
        self.blocks.append(block)
        return block


def play_node(sensor: str, out: Path) -> None:
    """Serve a stream; write stamps, wrenches and the share of a core that this process used."""
    from ftdrive.servers.ros2 import Ros2Node

    with Station(sensor, REAL_PACE) as station, closing(Ros2Node(RELIABLE)) as node:
        stream = Kept(replace(station.cell, clock=REAL), calibrated_from(station.truth))
        watch(stream.ended)
        try:
            node.serve(lambda: stream)
        except Ended:
            share = (time.process_time() - stream.begin[1]) / (time.monotonic() - stream.begin[0])
        averaged = Averaged(stream.info.sensor_rate_Hz, RATE_HZ)
        means = [averaged.add(block) for block in stream.blocks]
        t_ns = np.concatenate([one.t_host_ns for one in means])
        received, block = stream.received.read(0.0), Block.concatenate(stream.blocks)
        last = np.searchsorted(block.t_host_ns, t_ns) + (averaged.count - 1) // 2  # sample of each mean
        received_ns = received.t_host_ns[np.searchsorted(received.seq, block.seq[last.clip(max=len(block) - 1)])]
        utc_ns, wrench = stream.info.utc_offset_ns, np.concatenate([one.wrench for one in means])
        is_late = received_ns < stream.begin[2]
        np.savez(out, t_ns=t_ns + utc_ns, wrench=wrench, share=share, received_ns=received_ns + utc_ns, opening=is_late)


def play_plain(out: Path) -> None:
    """Publish the same message at the same rate and quality of service, with nothing before it."""
    import rclpy
    from geometry_msgs.msg import WrenchStamped
    from rclpy.qos import QoSProfile

    rclpy.init()
    publisher = rclpy.create_node("ftdrive").create_publisher(WrenchStamped, "~/wrench", QoSProfile(depth=5000))
    ended = threading.Event()
    watch(ended)
    sent: list[int] = []
    begin = time.monotonic(), time.process_time()
    while not ended.is_set():
        time.sleep(max(0.0, begin[0] + len(sent) / RATE_HZ - time.monotonic()))
        message = WrenchStamped()
        message.header.frame_id = "base_at_ft_sensor"
        t_ns = time.time_ns()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
        publisher.publish(message)
        sent.append(t_ns)
    share = (time.process_time() - begin[1]) / (time.monotonic() - begin[0])
    opening = np.zeros(len(sent), bool)
    np.savez(out, t_ns=sent, wrench=np.zeros((len(sent), 6)), share=share, received_ns=sent, opening=opening)


def watch(ended: threading.Event) -> None:
    """Set an event when stdin is closed."""

    def wait() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait, daemon=True).start()


def measured(
    folder: Path, role: str, subscribers: tuple[str, ...], sensor: str, seconds: float
) -> tuple[Any, dict[str, Any]]:
    """Run a publisher and clients; return what was sent, and stamp, wrench and time of receipt by client."""
    files = {name: folder / f"{role}-{name}" for name in subscribers}
    with ExitStack() as stack:
        clients = []
        for name, path in files.items():
            command = [sys.executable, "-m", "tests.ros2.clients", name, "/ftdrive/wrench"]
            command += [str(round(seconds * RATE_HZ)), "reliable"]
            clients.append(subprocess.Popen(command, stdout=stack.enter_context(path.open("w"))))
            stack.callback(clients[-1].kill)
            while not path.stat().st_size:
                time.sleep(0.05)
        out = folder / f"{role}.npz"
        command = [sys.executable, "-m", "tests.benchmarks.ros2", "--role", role, "--sensor", sensor, "--out", str(out)]
        publisher = stack.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE))
        stack.callback(publisher.kill)
        for client in clients:
            client.wait(seconds + 60)
        publisher.communicate(timeout=30)
    received = {}
    for name, path in files.items():
        lines = [json.loads(line) for line in path.read_text().splitlines()[1:]]
        stamps, _, numbers, arrived = zip(*lines, strict=True)
        received[name] = np.array(stamps), np.array(numbers), np.array(arrived)
    return np.load(out), received


def main() -> int:
    """Print the rows."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--sensor", default="ur-ft", help="of the emulated cell: ur-ft has 500 Hz, serial 7 kHz")
    parser.add_argument("--role", choices=("node", "plain"), help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role == "node":
        play_node(options.sensor, options.out)
        return 0
    if options.role == "plain":
        play_plain(options.out)
        return 0
    os.environ |= {"ROS_DOMAIN_ID": str(1 + os.getpid() % 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    failed, plain = 0, (0.0, 0.0)

    def row(what: str, figure: str, target: str, good: bool) -> None:
        nonlocal failed
        failed += not good
        click.echo(f"{what:36} {figure:>44}   target {target:8} {'ok' if good else 'FAIL'}")

    with tempfile.TemporaryDirectory() as name:
        for role, subscribers in PASSES:
            sent, received = measured(Path(name), role, subscribers, options.sensor, options.seconds)
            t_ns, wrench = sent["t_ns"], sent["wrench"]
            for client, (stamps, numbers, _) in received.items():
                places = np.searchsorted(t_ns, stamps)
                missing = places[-1] - places[0] + 1 - len(set(places))
                equal = np.array_equal(t_ns[places], stamps) and np.array_equal(wrench[places], numbers)
                before = f"{places[0]} before the first"
                row(f"{role}, {client}: missing", f"{missing} of {len(stamps)}, {before}", "0", missing == 0)
                row(f"{role}, {client}: equal to the stream", str(equal), "True", equal)
            if len(received) > 1:
                continue
            ((stamps, _, arrived),) = received.values()
            latency = np.percentile(
                1e-6 * (arrived - sent["received_ns"][places])[~sent["opening"][places]], [50, 95, 99]
            )
            share = float(sent["share"])
            if role == "plain":
                plain = latency[1], share
            words = f"p50 {latency[0]:.1f}, p95 {latency[1]:.1f}, p99 {latency[2]:.1f} ms"
            words += f", p95 {latency[1] / plain[0]:.1f} x plain"
            row(f"{role}, {client}: latency", words, f"{LATENCY_MS:g} ms", bool(latency[1] <= LATENCY_MS))
            words = f"{share:.1%} of a core, {share / plain[1]:.2f} x plain"
            row(f"{role}: CPU", words, f"{CPU:.0%}", share <= CPU)
            click.echo(f"load of the computer {os.getloadavg()[0]:.1f}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
