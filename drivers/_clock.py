"""The clock by which silence is judged."""

import sys
import time


def awake_s() -> float:
    """Seconds of a clock that goes on while the computer sleeps, where there is one."""
    if sys.platform == "linux":
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()
