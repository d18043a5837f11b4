"""Every row of the hazard table that software can see, injected into a tour on the emulated cell, at real speed.

uv run python tests/benchmarks/hazards.py                # every row; about 30 minutes
uv run python tests/benchmarks/hazards.py --only 14 15   # some rows
uv run python tests/benchmarks/hazards.py --repeat 3     # each fault so often

Every run that was stopped is resumed, and its calibration compared with that of an undisturbed run. Noise alone puts
two runs of a noisy sensor 1.4 sigma of one run apart, which would hide what a fault leaves behind. So all runs but the
first have a tenth of the usual noise, and differences are told in units of the standard deviation that the first run,
undisturbed and with the usual noise, states: the largest of any parameter must not exceed 1.
"""

import argparse
import json
import os
import queue
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from calib import CalibrationResult
from ftdrive.config import FORMAT, CellConfig
from ftdrive.simulation import Station
from tests.benchmarks.hazard_rows import BEFOREHAND, FAULTS, UNSEEN, Beforehand, Child, Fault, Json, Scene

Array = NDArray[np.float64]

REAL_TIME: Final = ("--time-scale", "1", "--seed", "11")
QUIET: Final = ("--noise", "0.005,0.0002")
"""A tenth of the usual. Without any, the sensor would be taken for a stuck one."""
DEEP_S: Final = 0.6
"""A fault comes so long after the arm has set off: it is at full speed then."""
BRAKING_S: Final = 0.35
"""From 60 deg/s with 4 rad/s2: 0.26 s; two looks of the guards, and the way of the command."""
AT_DEG: Final = 0.1
PATIENCE_S: Final = 120.0
GROUPS: Final = {
    "R": "R_flange_sensor",
    "F_b": "gravity_force_base_N",
    "F0": "force_bias_N",
    "P": "p_sensor_com_m",
    "T0": "torque_bias_Nm",
}


@dataclass
class Observed:
    """What a fault did."""

    injected_ns: int = 0
    stands_ns: int | None = None
    told_ns: int | None = None
    hazards: tuple[int, ...] = ()
    kept: int = 0
    was_moving: bool = False
    moved_while_held: bool = False
    ended_at_deg: Array = field(default_factory=lambda: np.zeros(6))
    resumed: Json | None = None
    words: str = ""
    diary: Sequence[Json] = ()


# -- conducting a session ----------------------------------------------------------------------------------------------


def conduct(scene: Scene, fault: Fault | None = None, seen: Observed | None = None) -> Json | None:
    """Answer every question, let the fault happen, mend it; returns the result, or None when the process ended."""
    injected, tries, deadline = seen is None or bool(seen.injected_ns), 0, time.monotonic() + PATIENCE_S
    hazards: list[int] = []
    while time.monotonic() < deadline:
        try:
            item = scene.child.lines.get(timeout=1.0)
        except queue.Empty:
            continue
        if item is None:
            break
        at_ns, event = item
        name = event.get("event")
        if name is None:
            return event
        if name == "run-opened":
            scene.run = scene.folder / event["folder"]
        if fault is None or seen is None:
            if name == "question":
                scene.child.say(_agree(event))
            continue
        if name == "guard-tripped":
            hazards.append(event["hazard"])
            seen.told_ns, seen.words = seen.told_ns or at_ns, seen.words or event["words"]
        if _here(event, fault) and not injected:
            injected = True
            inject(scene, fault, seen)
            if fault.resumed:
                break
        if name == "question":
            if "resume" not in event["answers"]:
                scene.child.say(_agree(event))
                continue
            if not tries:
                _held(scene, fault, seen, hazards)
                if fault.restart:
                    scene.child.say("quit")
                    continue
                fault.mend(scene)
            tries += 1
            time.sleep(0.0 if tries == 1 else 1.0)
            scene.child.say("resume" if tries < 15 else "quit")
    return None


def _here(event: Json, fault: Fault) -> bool:
    if fault.at == "approach":  # the session says it after the answer
        return event["event"] == "asked" and str(event["question"]).startswith("The arm goes")
    return (event["event"], event.get("state"), event.get("stop")) == ("state-changed", fault.at, fault.stop)


def inject(scene: Scene, fault: Fault, seen: Observed) -> None:
    """Let it happen, in a move when the arm is at full speed."""
    if fault.at in {"move", "approach"}:
        deadline = time.monotonic() + PATIENCE_S / 4
        while not scene.state()["moving"]:
            if time.monotonic() > deadline:
                return
            time.sleep(0.005)
        time.sleep(DEEP_S)
        seen.was_moving = bool(scene.state()["moving"])
    seen.injected_ns = time.monotonic_ns()
    fault.inject(scene)


def _held(scene: Scene, fault: Fault, seen: Observed, hazards: Sequence[int]) -> None:
    """Note how things are while the session waits for a person."""
    deadline = time.monotonic() + 15
    while fault.ends_its_move and scene.state()["moving"] and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)
    now_ns, state = time.monotonic_ns(), scene.state()
    seen.hazards, seen.kept = tuple(hazards), len(scene.poses())
    times = arm_events(state["events"], "stands", seen.injected_ns, now_ns)
    seen.stands_ns = seen.told_ns if fault.at == "sample" else max(times, default=None)
    again = times and arm_events(state["events"], "moves", min(times), now_ns)
    seen.moved_while_held = bool(state["moving"] or again)
    seen.ended_at_deg = np.degrees(state["q_rad"])


def arm_events(diary: Sequence[Json], what: str, after_ns: int, before_ns: int) -> list[int]:
    """When the arm began to move or to stand, host time."""
    times = [e["t_host_ns"] for e in diary if e["by"] == "arm" and e["what"] == what]
    return [t for t in times if after_ns < t < before_ns]


def _agree(question: Json) -> str:
    return "yes" if "yes" in question["answers"] else str(question["answers"][0])


def write_config(folder: Path, cell: CellConfig) -> Path:
    """Write the cell as its user would."""
    path = folder / f"cell-{len(list(folder.glob('cell-*')))}.toml"
    tool, work = cell.tool, cell.workcell
    mass = "" if tool.mass_kg is None else f"mass_kg = {tool.mass_kg}\n"
    path.write_text(
        f'format = "{FORMAT}"\n'
        f'[robot]\nhost = "{cell.robot.host}"\nmodel = "{cell.robot.model}"\n'
        f"speed_deg_s = {cell.robot.speed_deg_s}\nacceleration_deg_s2 = {cell.robot.acceleration_deg_s2}\n"
        f'[sensor]\nurl = "{cell.sensor.url}"\n'
        f"[tool]\ncylinders_mm = {[list(row) for row in tool.cylinders_mm]}\n{mass}"
        f'[workcell]\nmounting = "{work.mounting}"\nmeasured = {str(work.measured).lower()}\n'
        f"planes_mm = {[list(row) for row in work.planes_mm]}\nboxes_mm = {[list(row) for row in work.boxes_mm]}\n"
        f"[sampling]\naverage_s = {cell.sampling.average_s}\n"
    )
    return path


@contextmanager
def cell(folder: Path, *options: str) -> Iterator[tuple[Station, Path]]:
    """Switch an emulated cell on, and describe it."""
    with Station("can", [*REAL_TIME, *options]) as station:
        yield station, write_config(folder, station.cell)


def posture(q_deg: ArrayLike) -> str:
    """Option that lets a cell begin there."""
    return "--start-q-deg=" + ",".join(str(float(angle)) for angle in np.asarray(q_deg))


# -- the three kinds of rows -------------------------------------------------------------------------------------------


def undisturbed(folder: Path, options: Sequence[str], *arguments: str) -> Json:
    """Run a session in which nothing happens."""
    with cell(folder, *options) as (station, config):
        scene = Scene(station, folder, Child(folder, "--config", config, *arguments))
        try:
            answer = conduct(scene)
        finally:
            scene.child.end()
        if answer is None:
            raise RuntimeError((folder / "stderr.txt").read_text())
        return answer | {"truth": station.truth}


def disturb(folder: Path, plan: Path, fault: Fault) -> Observed:
    """Run a session, let the fault happen, mend it, go on to the end."""
    seen, options = Observed(), list(QUIET)
    if fault.at == "approach":
        q_deg = np.degrees(json.loads(plan.read_text())["steps"][0]["q_rad"])
        options.append(posture(q_deg + np.array([0, 0, 0, 0, 0, 40])))
    with cell(folder, *options) as (station, config):
        scene = Scene(station, folder, Child(folder, "--config", config, "--plan", plan, "--fast"))
        try:
            seen.resumed = conduct(scene, fault, seen)
            if fault.resumed and seen.injected_ns:
                time.sleep(2.0)
                scene.child.process.poll()
                times = arm_events(scene.state()["events"], "stands", seen.injected_ns, time.monotonic_ns())
                seen.stands_ns = max(times, default=None)
                seen.kept = len(scene.poses())
                fault.mend(scene)
            scene.child.end()
            seen.diary = scene.state()["events"]
            if fault.restart and seen.injected_ns and scene.run is not None:
                q_deg = np.degrees(scene.state()["q_rad"])
                station.__exit__()
                with cell(folder, *QUIET, posture(q_deg)) as (again, other):
                    scene = Scene(again, folder, Child(folder, "--config", other, "--resume", scene.run, "--fast"))
                    seen.resumed = conduct(scene)
            elif seen.resumed is None and scene.run is not None:
                scene.child = Child(folder, "--config", config, "--resume", scene.run, "--fast")
                seen.resumed = conduct(scene)
        finally:
            scene.child.end()
    return seen


def begin(folder: Path, plan: Path, row: Beforehand) -> tuple[Json | None, int, bool, str]:
    """Begin a session where something is odd: its result, exit code, whether the arm moved, what was said."""
    with Station(row.sensor, [*REAL_TIME, *QUIET, *row.options]) as station:
        config = write_config(folder, row.change(station.cell))
        if row.do is not None:
            station.control(**row.do)
        arguments = [str(plan) if word == "PLAN" else word for word in row.arguments]
        scene = Scene(station, folder, Child(folder, "--config", config, *arguments))
        try:
            answer = conduct(scene)
            code = scene.child.process.wait(10)
        finally:
            scene.child.end()
        moved = any(e["by"] == "arm" and e["what"] == "moves" for e in scene.state()["events"])
    words = (folder / "stderr.txt").read_text().strip().splitlines()
    said = next((line for line in words if line.startswith("error")), words[-1] if words else "")
    return answer, code, moved, said


# -- results -----------------------------------------------------------------------------------------------------------


class Known:
    """Parameters with the names of a result: the truth of a cell, or what another run found."""

    def __init__(self, told: Mapping[str, Any]) -> None:
        for name in GROUPS.values():
            setattr(self, name, np.array(told[name]))


def result_of(folder: Path, answer: Json) -> CalibrationResult:
    """Read the newest result of a run."""
    found = (folder / answer["run"]).glob("calibration*.json")
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


def say(words: str) -> None:
    sys.stdout.write(words + "\n")
    sys.stdout.flush()


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
        say(f"load {os.getloadavg()[0]:.1f}; differences in sigma of one run with the usual noise")
        for name, groups in (
            (
                "the undisturbed run from the truth, noise as usual",
                self._from_truth(result_of(self.folder, first), first),
            ),
            ("the same with a tenth of the noise", self._from_truth(one, quiet[0])),
            ("two undisturbed runs with a tenth of the noise", largest(one, other, self.sigma)),
        ):
            say(f"{name:52} {in_groups(groups)}")

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
        say(f"{self.done:2}/{self.rows} {head} {seen}  {'FAIL: ' + '; '.join(complaints) if complaints else 'pass'}")

    def fault(self, fault: Fault) -> tuple[str, Sequence[str]]:
        """Judge what a fault did."""
        limit_s = fault.detect_s + (0.0 if fault.at == "sample" or fault.ends_its_move else BRAKING_S)
        seen = disturb(self.folder, self.plan, fault)
        reacted_ns = seen.told_ns if fault.ends_its_move else seen.stands_ns
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
        how = "told" if fault.ends_its_move else "held" if fault.at == "sample" else "stopped"
        hazards = f", guard {seen.hazards[0]}" if seen.hazards else ""
        reaction = "none" if took_s is None else f"{how} after {took_s:.2f} s{hazards}"
        if complaints and seen.words:
            complaints.append(f"told: {seen.words[:160]}")
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


def _wrong_reaction(fault: Fault, seen: Observed, took_s: float | None, limit_s: float) -> Iterator[str]:
    if not seen.injected_ns or (fault.at in {"move", "approach"} and not seen.was_moving):
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
    parser.add_argument("--only", nargs="*", help="rows of the hazard table")
    parser.add_argument("--repeat", type=int, default=1)
    options = parser.parse_args()

    def wanted(row: str) -> bool:
        return not options.only or not {*row.split(", ")}.isdisjoint(options.only)

    faults = [fault for fault in FAULTS if wanted(fault.row)] * options.repeat
    beforehand = [row for row in BEFOREHAND if wanted(row.row)]
    folder = Path(tempfile.mkdtemp(prefix="ftdrive-hazards-"))
    table = Table(folder, len(faults) + len(beforehand))
    try:
        table.begin()
        say(f"\n{'':5} row   {'fault':32} {'reaction':30} {'limit':>7} kept  difference from undisturbed, sigma")
        for fault in faults:
            table.row(f"{fault.row:5} {fault.name:32}", partial(table.fault, fault))
        say(f"\nlargest difference of a resumed run, by group: {in_groups(table.worst)}")
        say("\nbefore anything moves")
        for row in beforehand:
            table.row(f"{row.row:5} {row.name:32}", partial(table.beforehand, row))
        say("\nnot injected here")
        for name, why in UNSEEN.items():
            say(f"{name:32} {why}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    say(f"\n{table.failed} rows failed")
    return table.failed


if __name__ == "__main__":
    raise SystemExit(main())
