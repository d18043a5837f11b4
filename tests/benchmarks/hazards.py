"""Every row of the hazard table that software can see, injected into a tour on the emulated cell, at real speed.

uv run python -m tests.benchmarks.hazards                # every row; about 40 minutes
uv run python -m tests.benchmarks.hazards --only 14 15   # some rows
uv run python -m tests.benchmarks.hazards --repeat 3     # each fault so often

Every run that was stopped is resumed, and its calibration compared with that of an undisturbed run. Noise alone puts
two runs of a noisy sensor 1.4 sigma of one run apart, which would hide what a fault leaves behind. So all runs but the
first have a tenth of the usual noise, and differences are in units of the standard deviation that the first run,
undisturbed and with the usual noise, states: the largest of any parameter must not exceed 1.
"""

import argparse
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from tests.benchmarks.common import show
from tests.benchmarks.hazard_rows import BEFOREHAND, FAULTS, UNSEEN, Beforehand, Fault, Json
from tests.benchmarks.hazard_sessions import QUIET, Observed, begin, disturb, undisturbed

BRAKING_S: Final = 0.29
"""From 60 deg/s with 300 deg/s2: 0.2 s; two looks of the guards, and the way of the command."""
AT_DEG: Final = 0.1
ATTEMPTS: Final = 3
"""On a busy machine a session may be stopped before the fault comes: that says nothing about the fault."""
GROUPS: Final = {
    "R": "R_flange_sensor",
    "F_b": "gravity_force_base_N",
    "F0": "force_bias_N",
    "P": "p_sensor_com_m",
    "T0": "torque_bias_Nm",
}


# -- results -----------------------------------------------------------------------------------------------------------


class Known:
    """Parameters with the names of a result: the truth of a cell, or what another run found."""

    def __init__(self, reported: Mapping[str, Any]) -> None:
        for name in GROUPS.values():
            setattr(self, name, np.array(reported[name]))


def result_of(folder: Path, answer: Json) -> CalibrationResult:
    """Read the newest result of a run."""
    found = list((folder / answer["run"]).glob("calibration*.json"))
    if not found:
        raise RuntimeError(f"{answer['verdict']}: {answer['findings']}")
    return CalibrationResult.load(max(found, key=lambda path: path.stat().st_mtime))


def largest(one: Any, other: Any, sigma: Mapping[str, Any]) -> dict[str, float]:
    """Largest difference of two results in each group, in units of `sigma`."""
    found = {}
    for short, name in GROUPS.items():
        if short == "R":
            difference = Rotation.from_matrix(one.R_flange_sensor @ other.R_flange_sensor.T).as_rotvec()
        else:
            difference = getattr(one, name) - getattr(other, name)
        found[short] = float(np.max(np.abs(difference / np.asarray(sigma[name]))))
    return found


def in_groups(groups: Mapping[str, float]) -> str:
    """Write them in one line."""
    return " ".join(f"{name} {value:.2f}" for name, value in groups.items())


# -- the table ---------------------------------------------------------------------------------------------------------


class Table:
    """Rows as they come, counted; one that breaks is a row that failed."""

    def __init__(self, folder: Path, rows: int) -> None:
        self.folder, self.rows, self.done, self.failed = folder, rows, 0, 0
        self.plan, self.sigma, self.reference = Path(), dict[str, Any](), dict[str, Any]()
        self.worst = dict.fromkeys(GROUPS, 0.0)

    def begin(self) -> None:
        """Run undisturbed: slow and with the usual noise for the unit, then twice fast and quiet."""
        first = undisturbed(self.folder, (), "--minimal")
        self.plan = self.folder / first["run"] / "plan.json"
        self.sigma = dict(result_of(self.folder, first).sigma)
        quiet = [undisturbed(self.folder, QUIET, "--plan", str(self.plan), "--fast") for _ in range(2)]
        one, other = (result_of(self.folder, answer) for answer in quiet)
        self.reference = {name: getattr(one, name) for name in GROUPS.values()}
        show(f"load {os.getloadavg()[0]:.1f}; differences in sigma of one run with the usual noise")
        for name, groups in (
            (
                "the undisturbed run from the truth, noise as usual",
                self._from_truth(result_of(self.folder, first), first),
            ),
            ("the same with a tenth of the noise", self._from_truth(one, quiet[0])),
            ("two undisturbed runs with a tenth of the noise", largest(one, other, self.sigma)),
        ):
            show(f"{name:52} {in_groups(groups)}")

    def _from_truth(self, result: CalibrationResult, answer: Json) -> dict[str, float]:
        return largest(result, Known(answer["truth"]), self.sigma)

    def row(self, head: str, look: Callable[[], tuple[str, Sequence[str]]]) -> None:
        """Say one row: what was seen, and what is wrong with it."""
        self.done += 1
        try:
            seen, complaints = look()
        except Exception as error:  # the other rows are worth something without it
            seen, complaints = "", [f"broke off: {error!r}"]
        self.failed += bool(complaints)
        show(f"{self.done:2}/{self.rows} {head} {seen}  {'FAIL: ' + '; '.join(complaints) if complaints else 'pass'}")

    def fault(self, fault: Fault) -> tuple[str, Sequence[str]]:
        """Judge what a fault did."""
        limit_s = fault.detect_s + (0.0 if fault.at == "sample" or fault.ends_its_move else BRAKING_S)
        seen, attempts = disturb(self.folder, self.plan, fault), 1
        while not _came(fault, seen) and attempts < ATTEMPTS:
            seen, attempts = disturb(self.folder, self.plan, fault), attempts + 1
        reacted_ns = seen.reported_ns if fault.ends_its_move else seen.stands_ns
        took_s = None if reacted_ns is None else (reacted_ns - seen.injected_ns) / 1e9
        complaints = [*_wrong_reaction(fault, seen, took_s, limit_s), *self._wrong_end(fault, seen)]
        differs = "not resumed"
        if seen.resumed is None:
            complaints.append("not resumed")
        else:
            groups = largest(result_of(self.folder, seen.resumed), Known(self.reference), self.sigma)
            self.worst = {name: max(value, groups[name]) for name, value in self.worst.items()}
            differs = in_groups(groups)
            if max(groups.values()) > 1:
                complaints.append("another calibration")
        how = "reported" if fault.ends_its_move else "held" if fault.at == "sample" else "stopped"
        hazards = f", guard {seen.hazards[0]}" if seen.hazards else ""
        reaction = "none" if took_s is None else f"{how} after {took_s:.2f} s{hazards}"
        if complaints:
            complaints.append(f"reported: {(seen.words or seen.last_words)[:160]}")
        if seen.before or attempts > 1:
            differs += f"  (attempt {attempts}, held {seen.before} times before by something else)"
        return f"{reaction:30} {limit_s:5.2f} s {seen.kept:4}  {differs}", complaints

    def _wrong_end(self, fault: Fault, seen: Observed) -> Iterator[str]:
        if not fault.ends_its_move:
            return
        goal_deg = np.degrees(json.loads(self.plan.read_text())["steps"][fault.stop - 1]["q_rad"])
        off_deg = float(np.abs(seen.ended_at_deg - goal_deg).max())
        if off_deg > AT_DEG:
            yield f"ended {off_deg:.1f} degrees from the goal of its move"

    def beforehand(self, row: Beforehand) -> tuple[str, Sequence[str]]:
        """Judge how a session begins where something is odd."""
        answer, code, moved, said = begin(self.folder, self.plan, row)
        complaints = [] if code == row.code else [f"exit code {code}, not {row.code}"]
        if row.code:
            if moved:
                complaints.append("MOVED")
            if row.words.lower() not in said.lower():
                complaints.append(f"no word of '{row.words}'")
            return f"exit code {code}: {said[:150]}", complaints
        if answer is None:
            return said[:150], [*complaints, "no result"]
        groups = largest(result_of(self.folder, answer), Known(self.reference), self.sigma)
        if max(groups.values()) > 1:
            complaints.append("another calibration")
        return f"goes on, and rightly: {in_groups(groups)}", complaints


def _came(fault: Fault, seen: Observed) -> bool:
    """Whether the fault was injected, and in a move where it should."""
    return bool(seen.injected_ns and (seen.was_moving or fault.at not in {"move", "approach"}))


def _wrong_reaction(fault: Fault, seen: Observed, took_s: float | None, limit_s: float) -> Iterator[str]:
    if not _came(fault, seen):
        yield "not injected in a move"
    if took_s is None:
        yield "no reaction"
    elif took_s > limit_s:
        yield "late"
    if fault.hazards and not (seen.hazards and seen.hazards[0] in fault.hazards):
        yield f"named as {list(seen.hazards)}"
    if fault.words not in seen.words:
        yield f"no word of '{fault.words}'"
    if seen.moved_while_held:
        yield "moved while held"
    expected = 0 if fault.at == "approach" else fault.stop - 1
    if seen.kept != expected:
        yield f"{seen.kept} poses kept, not {expected}"
    if _moved_by_two(seen.diary):
        yield "sent off while a person moved it"


def _moved_by_two(diary: Sequence[Json]) -> bool:
    """Whether a move was commanded between the beginning of a move by hand and its end."""
    by_hand = False
    for event in diary:
        if event["what"] == "hand-move":
            by_hand = True
        elif event["by"] == "arm" and event["what"] == "stands":
            by_hand = False
        elif by_hand and event["by"] == "rtde" and event.get("why") == "moveJ":
            return True
    return False


def main() -> int:
    """Print the table; the exit code is the number of rows that failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", help="rows of the hazard table, or names")
    parser.add_argument("--repeat", type=int, default=1)
    options = parser.parse_args()

    def wanted(row: Fault | Beforehand) -> bool:
        return not options.only or not {row.name, *row.row.split(", ")}.isdisjoint(options.only)

    faults = [*filter(wanted, FAULTS)] * options.repeat
    beforehand = [*filter(wanted, BEFOREHAND)]
    folder = Path(tempfile.mkdtemp(prefix="ftdrive-hazards-"))
    table = Table(folder, len(faults) + len(beforehand))
    try:
        table.begin()
        show(f"\n{'':5} row   {'fault':32} {'reaction':30} {'limit':>7} kept  difference from undisturbed, sigma")
        for fault in faults:
            table.row(f"{fault.row:5} {fault.name:32}", partial(table.fault, fault))
        show(f"\nlargest difference of a resumed run, by group: {in_groups(table.worst)}")
        show("\nbefore anything moves")
        for row in beforehand:
            table.row(f"{row.row:5} {row.name:32}", partial(table.beforehand, row))
        show("\nnot injected here")
        for name, why in UNSEEN.items():
            show(f"{name:32} {why}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    show(f"\n{table.failed} rows failed")
    return table.failed


if __name__ == "__main__":
    raise SystemExit(main())
