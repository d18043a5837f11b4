"""How patiently tests wait: for conditions, never for a time."""

import time
from collections.abc import Callable
from pathlib import Path

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
