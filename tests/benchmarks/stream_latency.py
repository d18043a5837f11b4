"""Latency from a block to a WebSocket client, and what the server costs, at 7 kHz.

    python -m tests.benchmarks.stream_latency [seconds]

Blocks of 10 ms with both wrenches of each sample, poses and joint angles at 500 Hz, frames and arrows at 60 Hz. Each
client is a process of its own that takes every topic; it measures from the moment before the block is written. CPU is
that of the whole server process, less what it takes to make the blocks. A busy machine shows in latency, not in CPU.
"""

import json
import socket
import struct
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from typing import Any, cast

import numpy as np

from ftdrive.cell.emulated_clock import EmulatedClock
from ftdrive.live import ros2
from ftdrive.servers.foxglove import FoxgloveServer
from tests.unit.ftdrive.servers.fake_stream import INFO, RATE_HZ, FakeStream, block

BLOCK_S = 0.01
TARGET_P95_MS = 10.0
EVERY = 100
"""Of so many wrenches the client keeps one time of arrival."""
UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
)
TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
MESSAGE = struct.Struct("<BIQ")
"""Operation, channel, time in ns."""


def run_client(port: int, clock: str) -> None:
    """Receive until the server closes; print latencies in ms, counts, and when every 100th wrench arrived.

    It reads frames itself, because a WebSocket library takes half a core for 15 000 messages a second.

    Parameters
    ----------
    port : int
    clock : str
        Page of the emulated cell whose time the messages have; empty for that of the computer.
    """
    now_ns = EmulatedClock(clock).now_ns if clock else time.monotonic_ns
    latency_ms, arrivals_ns = list[float](), list[int]()
    count, compensated, buffer = 0, -1, bytearray()
    with socket.create_connection(("127.0.0.1", port)) as client:
        client.sendall(UPGRADE)
        while b"\r\n\r\n" not in buffer:
            buffer += client.recv(1 << 16)
        del buffer[: buffer.index(b"\r\n\r\n") + 4]
        received, ended, arrived_ns = b"\0", False, 0
        while received and not ended:
            for opcode, frame in take_frames(buffer):
                if opcode == BINARY:
                    _, channel, t_ns = MESSAGE.unpack_from(frame)
                    if channel == compensated:
                        if len(latency_ms) % EVERY == 0:
                            arrivals_ns.append(arrived_ns)
                        latency_ms.append((arrived_ns - t_ns) * 1e-6)
                    count += 1
                elif opcode == CLOSE:
                    ended = True
                elif opcode == PING:
                    client.sendall(bytes([0x80 | PONG, 0x80, 0, 0, 0, 0]))
                elif opcode == TEXT and (message := json.loads(frame))["op"] == "advertise":
                    ids = {channel["topic"]: channel["id"] for channel in message["channels"]}
                    compensated = ids[ros2.COMPENSATED]
                    wanted = [{"id": number, "channelId": number} for number in ids.values()]
                    send(client, {"op": "subscribe", "subscriptions": wanted})
                    send(client, {"op": "getParameters", "parameterNames": []})
                elif opcode == TEXT and message["op"] == "parameterValues":  # answered in order: it has subscribed
                    sys.stdout.write("ready\n")
                    sys.stdout.flush()
            received = b"" if ended else client.recv(1 << 18)
            arrived_ns = now_ns()
            buffer += received
    p50, p95, most = np.percentile(latency_ms[len(latency_ms) // 10 :], [50, 95, 100])
    sys.stdout.write(
        json.dumps(
            {"p50": p50, "p95": p95, "max": most, "wrenches": len(latency_ms), "all": count, "arrivals_ns": arrivals_ns}
        )
        + "\n"
    )


def take_frames(buffer: bytearray) -> list[tuple[int, bytes]]:
    """Remove the complete WebSocket frames (opcode, content) from a buffer."""
    frames, at = [], 0
    while len(buffer) >= at + (2 if len(buffer) > at + 1 and buffer[at + 1] < 126 else 10):
        size, begin = buffer[at + 1], at + 2
        if size == 126:
            size, begin = int.from_bytes(buffer[begin : begin + 2], "big"), begin + 2
        elif size == 127:
            size, begin = int.from_bytes(buffer[begin : begin + 8], "big"), begin + 8
        if len(buffer) < begin + size:
            break
        frames.append((buffer[at] & 15, bytes(buffer[begin : begin + size])))
        at = begin + size
    del buffer[:at]
    return frames


def send(client: socket.socket, message: dict[str, Any]) -> None:
    """Send a text message."""
    data = json.dumps(message).encode()
    client.sendall(struct.pack(">BBH4x", 0x80 | TEXT, 0xFE, len(data)) + data)  # the mask is 0


def measure(clients: int, duration_s: float) -> bool:
    """Stream to some clients; print one line; return whether the target is met."""
    stream = FakeStream()
    stream.info = replace(INFO, utc_offset_ns=0)
    with closing(FoxgloveServer(cast(Any, stream), port=0)) as server:
        command = [sys.executable, "-m", "tests.benchmarks.stream_latency", "client", str(server.port)]
        processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(clients)]
        for process in processes:
            assert process.stdout is not None
            process.stdout.readline()
        writing_s, start_s, n, cpu_s = [], time.monotonic(), round(BLOCK_S * RATE_HZ), -time.process_time()
        blocks = round(duration_s / BLOCK_S)
        for i in range(blocks):
            time.sleep(max(0.0, start_s + i * BLOCK_S - time.monotonic()))
            making_s = time.thread_time()
            made = block(n, i * n)
            cpu_s -= time.thread_time() - making_s
            before_ns = time.monotonic_ns()
            server.write(replace(made, t_host_ns=np.arange(before_ns - n + 1, before_ns + 1)))
            writing_s.append((time.monotonic_ns() - before_ns) * 1e-9)
        cpu_s += time.process_time()
        time.sleep(0.5)  # what is under way
    outcomes = [json.loads(process.communicate()[0]) for process in processes]
    worst_ms = max((outcome["p95"] for outcome in outcomes), default=0.0)
    lost = sum(blocks * n - outcome["wrenches"] for outcome in outcomes)
    passed = worst_ms <= TARGET_P95_MS and lost == 0
    p50, most = (max((outcome[key] for outcome in outcomes), default=0.0) for key in ("p50", "max"))
    sys.stdout.write(
        f"{clients} clients: latency p50 {p50:.2f} p95 {worst_ms:.2f} max {most:.1f} ms "
        f"(target p95 {TARGET_P95_MS:g}), "
        f"lost {lost} of {clients * blocks * n}, write p95 {np.percentile(writing_s, 95) * 1e3:.2f} ms, "
        f"CPU {100 * cpu_s / duration_s:.1f} %   {'pass' if passed else 'FAIL'}\n"
    )
    return passed


def main() -> int:
    """Run."""
    if sys.argv[1:2] == ["client"]:
        run_client(int(sys.argv[2]), (*sys.argv, "")[3])
        return 0
    duration_s = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    return sum(not measure(clients, duration_s) for clients in (0, 1, 3))


if __name__ == "__main__":
    sys.exit(main())
