"""How patiently tests wait: for conditions, never for a time."""

import time
from collections.abc import Callable
from pathlib import Path

import serial

LIMIT_S = 30.0
"""Whatever must happen has happened by then, on a busy machine too."""


def wait_until(condition: Callable[[], object], limit_s: float = LIMIT_S) -> None:
    deadline_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline_s, "the condition never came true"
        time.sleep(0.002)


def control_process() -> int:
    """Return the process id of the newest control process of this process."""
    children = [int(pid) for path in Path("/proc/self/task").glob("*/children") for pid in path.read_text().split()]
    return max(pid for pid in children if b"control_child" in Path(f"/proc/{pid}/cmdline").read_bytes())


def drain(port: serial.Serial, quiet_s: float = 0.05) -> bytes:
    """Read what was on its way from a device that sends nothing more: a full terminal would lose its next answer.

    The port's time-out stays as it is, as pyserial sets all flags of the terminal again with it.
    """
    data = b""
    deadline_s = time.monotonic() + quiet_s
    while time.monotonic() < deadline_s:
        if port.in_waiting:
            data += port.read(port.in_waiting)
            deadline_s = time.monotonic() + quiet_s
        time.sleep(0.002)
    return data


def read_to(port: serial.Serial, answer: bytes) -> bytes:
    """Read up to an answer and return what came before it."""
    data = port.read_until(answer)
    assert data.endswith(answer), data[-100:]
    return data[: -len(answer)]
