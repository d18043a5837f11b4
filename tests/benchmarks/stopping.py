"""How soon a stopped arm brakes and rests, by speed, cause and control path, in the time of an emulated cell.

    python -m tests.benchmarks.stopping [--trials 5] [--stop-deceleration 300]

A UR5e at real speed turns joint 6 at 15, 30 and 60 deg/s. The cause is a stop as the guards command it, or a network
that fails in both directions, after which only the program of the path `script` stops the arm. Columns: median and
longest time until braking begins and until the set-point rests, median and largest angle from the cause to rest.
"""

import argparse
import sys

import numpy as np

from ftdrivers.ur.control import ControlPath
from tests.benchmarks.common import show
from tests.wire.conftest import Station
from tests.wire.stop_trial import Cause, stop

ROWS: tuple[tuple[ControlPath, Cause], ...] = (("script", "stop"), ("ur-rtde", "stop"), ("script", "network"))


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--stop-deceleration", type=float, default=300.0, help="deg/s²")
    options = parser.parse_args()
    show("path     cause    deg/s   brakes s        rests s         angle deg")
    for path, cause in ROWS:
        for speed_deg_s in (15.0, 30.0, 60.0):
            with Station("--time-scale", "1") as station:
                stops = [
                    stop(station, path, cause, speed_deg_s, options.stop_deceleration) for _ in range(options.trials)
                ]
            columns = np.array([(one.brakes_s, one.rests_s, one.turned_deg) for one in stops])
            figures = "   ".join(
                f"{median:5.2f} to {most:5.2f}"
                for median, most in zip(np.median(columns, axis=0), columns.max(axis=0), strict=True)
            )
            show(f"{path:8} {cause:8} {speed_deg_s:4.0f}   {figures}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
