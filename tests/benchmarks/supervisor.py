"""A supervisor that leaves: how soon the arm rests, and whether event, message, exit code and resume are right.

    python -m tests.benchmarks.supervisor

Twenty trials on an emulated cell: the reader of `calibrate --json` killed, its standard output closed, its answers
closed, its terminal closed; each in mid-move and at rest, on both control paths. Then `verify` in mid-move and `push`
at its question, on both. The time runs from the cause to the standstill of the set-point, in the time of the cell. Exit
code 1 unless all are right and the arm rests within 0.3 s.
"""

import sys
import tempfile
from pathlib import Path

from ftdrive.cell.emulated import Station
from tests.system.command_line import CommandLine
from tests.system.supervisor_trial import ANSWERS, GONE, KINDS, Seen, push_trial, trial, verify_trial

WITHIN_S = 0.3


def is_right(seen: Seen, *, moving: bool) -> bool:
    """Judge a trial; the time to rest contains the braking, which takes milliseconds on this fast arm."""
    in_time = not moving if seen.rest_s is None else moving and seen.rest_s <= WITHIN_S
    return in_time and (seen.exit_code, len(seen.events), seen.resumed) == (GONE, 1, 0)


def main() -> int:
    """Run the trials."""
    right = count = 0

    def say(path: str, what: str, good: bool, rest_s: float | None = None) -> None:
        nonlocal right, count
        right, count = right + good, count + 1
        rests = "" if rest_s is None else f"{rest_s:.3f} s"
        sys.stdout.write(f"{path:8} {what:40} {'right' if good else 'WRONG':6} {rests}\n")
        sys.stdout.flush()

    for path in ("script", "ur-rtde"):
        with Station("serial", ["--seed", "3"], control_path=path) as station:
            for kind in KINDS:
                for moving in (True, False):
                    with tempfile.TemporaryDirectory() as folder:
                        seen = trial(kind, station, CommandLine(Path(folder)), moving=moving)
                    where = "mid-move" if moving else "at rest"
                    say(path, f"{kind}, {where}", is_right(seen, moving=moving), seen.rest_s)
            with tempfile.TemporaryDirectory() as folder:
                ftdrive = CommandLine(Path(folder))
                made = ftdrive.json("calibrate", "--config", ftdrive.connect(station), "--minimal", typed=ANSWERS)
                run = Path(folder) / made["run"]
                seen = verify_trial(station, ftdrive, run)
                say(path, "verify: reader killed, mid-move", is_right(seen, moving=True), seen.rest_s)
                code, _, sent = push_trial(station, ftdrive, run)
                say(path, "push: answers closed at its question", code == GONE and not sent)
    sys.stdout.write(f"{right} of {count}\n")
    return int(right != count)


if __name__ == "__main__":
    sys.exit(main())
