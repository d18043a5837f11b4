"""What reading an arm at its full rate costs: age of a state, loss, and processor time.

    python tests/benchmarks/ur_reader.py [--seconds 60]

An emulated UR5e sends 500 samples a second. One follower reads all of them 50 times a second; a state is read 100
times a second. The age of a state is the time from the receipt of its sample until `state()` returns. Lost samples are
gaps in the controller's time. The processor time is that of this process. Exit code 1 when the 95th percentile of the
age exceeds 4 ms, a sample is lost, or the reader takes more than 6 % of a core.
"""

import argparse
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing

import numpy as np

from ftdrivers.clock import REAL
from ftdrivers.ur.arm import UrArm
from tests.wire.conftest import Station

AGE_S, SHARE = 0.004, 0.06
PERIOD_S = 0.002


def main() -> int:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    seconds = parser.parse_args().seconds
    with Station("--time-scale", "1") as station, closing(UrArm(station.host)) as arm:
        arm.open()
        device_s = []
        with arm.follow() as follow:
            reader_s = cpu_s(seconds, lambda: device_s.append(follow.read(timeout_s=0.02).t_device_s))
            stop = threading.Event()
            keeping = threading.Thread(target=lambda: [follow.read(timeout_s=0.02) for _ in iter(stop.is_set, True)])
            keeping.start()
            ages_s = [age_s(arm) for _ in range(int(100 * min(seconds, 10)))]
            stop.set()
            keeping.join()
    steps = np.rint(np.diff(np.concatenate(device_s)) / PERIOD_S)
    lost, count = int((steps - 1).sum()), len(steps) + 1
    share = reader_s / seconds
    median, p95, longest = 1e3 * np.percentile(ages_s, [50, 95, 100])
    sys.stdout.write(
        f"{count} samples in {seconds:g} s, {lost} lost; {share:.1%} of a core\n"
        f"age of a state: median {median:.2f} ms, p95 {p95:.2f} ms, longest {longest:.2f} ms\n"
    )
    return int(lost > 0 or share > SHARE or p95 > 1e3 * AGE_S)


def cpu_s(seconds: float, read: Callable[[], object]) -> float:
    """Read for some seconds; return the processor time that it took."""
    end_s, begin_s = time.monotonic() + seconds, time.process_time()
    while time.monotonic() < end_s:
        read()
        time.sleep(0.02)
    return time.process_time() - begin_s


def age_s(arm: UrArm) -> float:
    """Read a state and return its age."""
    state = arm.state()
    age_ns = REAL.now_ns() - state.t_host_ns
    time.sleep(0.01)
    return age_ns / 1e9


if __name__ == "__main__":
    sys.exit(main())
