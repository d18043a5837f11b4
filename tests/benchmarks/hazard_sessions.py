"""Sessions on an emulated cell at real speed, with faults: answered, disturbed, repaired, resumed."""

import json
import queue
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftdrive.cell.config import FORMAT, CellConfig
from ftdrive.cell.emulated import Station
from tests.benchmarks.hazard_rows import PAYLOAD_KG, Beforehand, Child, Fault, Json, Scene

Array = NDArray[np.float64]

REAL_TIME: Final = ("--time-scale", "1", "--seed", "11", "--payload", str(PAYLOAD_KG))
QUIET: Final = ("--noise", "0.005,0.0002")
"""A tenth of the usual. Without any, the sensor would be taken for a stuck one."""
DEEP_S: Final = 0.6
"""A fault comes so long after the arm has set off: it is at full speed then."""
PATIENCE_S: Final = 120.0
TRIES: Final = 15


@dataclass
class Observed:
    """What a fault did."""

    injected_ns: int = 0
    stands_ns: int | None = None
    reported_ns: int | None = None
    hazards: tuple[int, ...] = ()
    kept: int = 0
    was_moving: bool = False
    moved_while_held: bool = False
    ended_at_deg: Array = field(default_factory=lambda: np.zeros(6))
    resumed: Json | None = None
    words: str = ""
    diary: Sequence[Json] = ()
    before: int = 0
    """Holds before it was injected: of something else."""
    last_words: str = ""
    """Of the session, on stderr."""


# -- conducting a session ----------------------------------------------------------------------------------------------


def conduct(scene: Scene, fault: Fault | None = None, seen: Observed | None = None) -> Json | None:
    """Answer every question, let the fault happen, repair it; returns the result, or None when the process ended."""
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
        if name == "guard-tripped" and injected:
            hazards.append(event["hazard"])
            seen.reported_ns, seen.words = seen.reported_ns or at_ns, seen.words or event["words"]
        if _here(event, fault) and not injected:
            injected = True
            inject(scene, fault, seen)
            if fault.resumed:
                break
        if name == "question":
            if "resume" not in event["answers"]:
                scene.child.say(_agree(event))
                continue
            if not injected:  # something else has stopped it, such as a machine that is too busy
                seen.before += 1
                time.sleep(1.0)
                scene.child.say("resume" if seen.before < TRIES else "quit")
                continue
            if not tries:
                _held(scene, fault, seen, hazards)
                if fault.restart:
                    scene.child.say("quit")
                    continue
                fault.repair(scene)
            tries += 1
            time.sleep(0.0 if tries == 1 else 1.0)
            scene.child.say("resume" if tries < TRIES else "quit")
    return None


def _here(event: Json, fault: Fault) -> bool:
    if fault.at == "approach":  # the session says it after the answer
        return event["event"] == "asked" and str(event["question"]).startswith("Approach ")
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
    seen.stands_ns = seen.reported_ns if fault.at == "sample" else max(times, default=None)
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
    """Run a session, let the fault happen, repair it, go on to the end."""
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
                fault.repair(scene)
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
    seen.last_words = last_words(folder)
    return seen


def last_words(folder: Path) -> str:
    """Read the last text of the newest session in the folder: its error, if it reported one."""
    words = (folder / "stderr.txt").read_text().strip().splitlines()
    return next((line for line in words if line.startswith("error")), words[-1] if words else "")


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
    return answer, code, moved, last_words(folder)
