"""Every row of the hazard table that software can see, injected into a tour on the emulated cell, at real speed.

uv run python tests/benchmarks/hazards.py                # every row; about 25 minutes
uv run python tests/benchmarks/hazards.py --only 14 15   # some rows
uv run python tests/benchmarks/hazards.py --repeat 3     # each fault so often
"""

import argparse
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib import CalibrationResult
from ftdrive.config import FORMAT, CellConfig, ToolConfig
from ftdrive.simulation import Station

Array = NDArray[np.float64]
Json = dict[str, Any]

SEED: Final = "11"
REAL_TIME: Final = ("--time-scale", "1", "--seed", SEED)
STOPS: Final = 7
"""Six poses and the return to the first."""
DEEP_S: Final = 0.6
"""A fault comes so long after the arm has set off: it is at full speed then."""
BRAKING_S: Final = 0.35
"""From 60 deg/s with 4 rad/s2: 0.26 s; two looks of the guards, and the way of the command."""
PATIENCE_S: Final = 120.0
UNSEEN: Final[Mapping[str, str]] = {
    "1 cable, gently": "nothing stops the arm below the contact limit; the report names poses (test_disturbances.py)",
    "2 joints off their line": "the emulated arm cannot leave its path while a program plays: unit tests only",
    "4 what is not described": "only the question and the contact guard (14)",
    "6 singularities": "by construction: joint moves only",
    "7 payload changed meanwhile": "the emulator has no such request: unit tests only",
    "13 load before": "the emulated ATI sensor on CAN does not tell its range: unit tests only",
    "19 freedrive": "never entered; an arm moved by hand while our program plays is not modelled: unit tests only",
    "20 people": "only the questions, and 14",
    "23 the tool moves": "named in the report, and refused where it changed the tool (test_disturbances.py)",
    "24 base not bolted": "only the question; the tilt is estimated",
}


@dataclass(frozen=True)
class Fault:
    """Something that happens in mid-tour.

    `at` is the state in which it happens, on the way to `stop`; `hazards` are the rows that may name it; `resumed` says
    that the process is gone, and --resume goes on.
    """

    row: str
    name: str
    inject: Callable[["Scene"], None]
    mend: Callable[["Scene"], None]
    hazards: frozenset[int]
    detect_s: float = 0.05
    at: str = "move"
    stop: int = 4
    resumed: bool = False
    restart: bool = False
    """Its mending needs the cell to be switched off and on."""


class Child:
    """`ftdrive calibrate --json` in a process group of its own: events as they come."""

    def __init__(self, folder: Path, *arguments: str | Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "ftdrive", "calibrate", *map(str, arguments), "--json"],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=(folder / "stderr.txt").open("w"),
            text=True,
            start_new_session=True,
            env=os.environ | {"XDG_STATE_HOME": str(folder / "state"), "XDG_CONFIG_HOME": str(folder / "none")},
        )
        self.lines: queue.Queue[tuple[int, Json] | None] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stdout or ():
            self.lines.put((time.monotonic_ns(), json.loads(line)))
        self.lines.put(None)

    def say(self, words: str) -> None:
        with suppress(BrokenPipeError):
            if self.process.stdin is not None:
                self.process.stdin.write(words + "\n")
                self.process.stdin.flush()

    def end(self) -> int:
        with suppress(ProcessLookupError):
            if self.process.poll() is None:
                os.killpg(self.process.pid, signal.SIGKILL)
        return self.process.wait()


@dataclass
class Scene:
    """One cell and one session in it."""

    station: Station
    folder: Path
    child: Child
    run: Path | None = None

    def poses(self) -> list[Path]:
        return [] if self.run is None else sorted((self.run / "poses").glob("*.npz"))

    def do(self, **request: Any) -> None:
        answer = self.station.control(**request)
        if "error" in answer:
            raise RuntimeError(f"{request}: {answer['error']}")


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
    resumed: Json | None = None
    words: str = ""


def standing(scene: Scene, since_ns: int, before_ns: int) -> int | None:
    """When the arm came to rest for good before a person let it go on; host time."""
    diary = scene.station.control(do="state", since=0)["events"]
    stands = [e["t_host_ns"] for e in diary if e["by"] == "arm" and e["what"] == "stands" and e["t_host_ns"] > since_ns]
    return max((t for t in stands if t < before_ns), default=None)


def inject(scene: Scene, fault: Fault, seen: Observed) -> None:
    if fault.at in {"move", "approach"}:
        deadline = time.monotonic() + PATIENCE_S / 4
        while not scene.station.control(do="state")["moving"]:
            if time.monotonic() > deadline:
                return
            time.sleep(0.005)
        time.sleep(DEEP_S)
        seen.was_moving = bool(scene.station.control(do="state")["moving"])
    seen.injected_ns = time.monotonic_ns()
    fault.inject(scene)


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
        if fault.at == "approach":
            here = name == "asked" and event["question"].startswith(
                "The arm goes"
            )  # the session says it after the answer
        else:
            here = name == "state-changed" and event["state"] == fault.at and event["stop"] == fault.stop
        if here and not injected:
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


def _held(scene: Scene, fault: Fault, seen: Observed, hazards: Sequence[int]) -> None:
    time.sleep(0.5)
    now_ns = time.monotonic_ns()
    seen.hazards, seen.kept = tuple(hazards), len(scene.poses())
    seen.stands_ns = standing(scene, seen.injected_ns, now_ns)
    state = scene.station.control(do="state")
    seen.moved_while_held = bool(state["moving"])
    if fault.at == "sample":
        seen.stands_ns = seen.told_ns


def _agree(question: Json) -> str:
    return "yes" if "yes" in question["answers"] else str(question["answers"][0])


def write_config(folder: Path, cell: CellConfig, measured: bool = True) -> Path:
    path = folder / f"cell-{len(list(folder.glob('cell-*')))}.toml"
    path.write_text(
        f'format = "{FORMAT}"\n'
        f'[robot]\nhost = "{cell.robot.host}"\nmodel = "{cell.robot.model}"\n'
        f"speed_deg_s = {cell.robot.speed_deg_s}\nacceleration_deg_s2 = {cell.robot.acceleration_deg_s2}\n"
        f'[sensor]\nurl = "{cell.sensor.url}"\n'
        f"[tool]\ncylinders_mm = {[list(row) for row in cell.tool.cylinders_mm]}\n"
        f'[workcell]\nmounting = "{cell.workcell.mounting}"\nmeasured = {str(measured).lower()}\n'
        f"[sampling]\naverage_s = {cell.sampling.average_s}\n"
    )
    return path


@contextmanager
def cell(folder: Path, *options: str) -> Iterator[tuple[Station, Path]]:
    with Station("can", [*REAL_TIME, *options]) as station:
        yield station, write_config(folder, station.cell)


def posture(q_deg: Array) -> str:
    return "--start-q-deg=" + ",".join(str(float(angle)) for angle in q_deg)


def undisturbed(folder: Path, *arguments: str) -> Json:
    with cell(folder) as (station, config):
        scene = Scene(station, folder, Child(folder, "--config", config, *arguments))
        answer = conduct(scene)
        scene.child.end()
        if answer is None:
            raise RuntimeError((folder / "stderr.txt").read_text())
        return answer


def disturb(folder: Path, plan: Path, fault: Fault) -> Observed:
    seen, options = Observed(), list[str]()
    if fault.at == "approach":
        q_deg = np.degrees(json.loads(plan.read_text())["steps"][0]["q_rad"])
        options = [posture(q_deg + np.array([0, 0, 0, 0, 0, 40]))]
    with cell(folder, *options) as (station, config):
        scene = Scene(station, folder, Child(folder, "--config", config, "--plan", plan, "--fast"))
        try:
            seen.resumed = conduct(scene, fault, seen)
            if fault.resumed and seen.injected_ns:
                time.sleep(2.0)
                scene.child.process.poll()
                seen.stands_ns = standing(scene, seen.injected_ns, time.monotonic_ns())
                seen.kept = len(scene.poses())
                fault.mend(scene)
            scene.child.end()
            if fault.restart and seen.injected_ns and scene.run is not None:
                q_deg = np.degrees(station.control(do="state")["q_rad"])
                station.__exit__()
                with cell(folder, posture(q_deg)) as (again, other):
                    scene = Scene(again, folder, Child(folder, "--config", other, "--resume", scene.run, "--fast"))
                    seen.resumed = conduct(scene)
            elif seen.resumed is None and scene.run is not None:
                scene.child = Child(folder, "--config", config, "--resume", scene.run, "--fast")
                seen.resumed = conduct(scene)
        finally:
            scene.child.end()
    return seen


def group_sigmas(one: CalibrationResult, other: CalibrationResult) -> dict[str, Array]:
    """Differences of two results in units of their combined standard deviation, by group: 1 rms is expected."""
    turn = Rotation.from_matrix(one.R_flange_sensor @ other.R_flange_sensor.T).as_rotvec()
    sigma = np.hypot(one.sigma["R_flange_sensor"], other.sigma["R_flange_sensor"])
    groups = {"R": turn / sigma}
    for short, name in (
        ("F_b", "gravity_force_base_N"),
        ("F0", "force_bias_N"),
        ("P", "p_sensor_com_m"),
        ("T0", "torque_bias_Nm"),
    ):
        difference = getattr(one, name) - getattr(other, name)
        groups[short] = difference / np.hypot(one.sigma[name], other.sigma[name])
    return groups


def rms(values: Sequence[Array] | Array) -> float:
    return float(np.sqrt(np.mean(np.square(np.concatenate([np.ravel(v) for v in values])))))


def result_of(folder: Path, answer: Json) -> CalibrationResult:
    return CalibrationResult.load(
        max((folder / answer["run"]).glob("calibration*.json"), key=lambda p: p.stat().st_mtime)
    )


# -- what happens ------------------------------------------------------------------------------------------------------


def nothing(_: Scene) -> None:
    pass


def ask(**request: Any) -> Callable[[Scene], None]:
    return lambda scene: scene.do(**request)


def unlock(scene: Scene) -> None:
    """As the operator at the pendant: after 5 s; the dashboard refuses before."""
    while scene.station.control(do="state")["safety_mode"] != "NORMAL":
        scene.station.control(do="unlock")
        time.sleep(0.5)


def power_up(scene: Scene) -> None:
    """Release the emergency stop, power on, release the brakes, by the dashboard as by the pendant."""
    import socket

    scene.do(do="emergency-stop", on=False)
    host = scene.station.endpoints["arm"]["host"]
    with socket.create_connection((host, 29999), timeout=5) as dashboard:
        dashboard.recv(200)
        for words in ("close safety popup", "power on", "brake release"):
            dashboard.sendall(f"{words}\n".encode())
            dashboard.recv(200)
            time.sleep(2.0)
    deadline = time.monotonic() + 60
    while scene.station.control(do="state")["robot_mode"] != "RUNNING" and time.monotonic() < deadline:
        time.sleep(0.2)


def send(number: int, group: bool = False) -> Callable[[Scene], None]:
    def deliver(scene: Scene) -> None:
        (os.killpg if group else os.kill)(scene.child.process.pid, number)

    return deliver


def hide_poses(scene: Scene) -> None:
    assert scene.run is not None
    (scene.run / "poses").rename(scene.run / "hidden")


def show_poses(scene: Scene) -> None:
    assert scene.run is not None
    (scene.run / "hidden").rename(scene.run / "poses")


PUSH: Final = [0.0, 25.0, 0.0, 0.0, 0.0, 0.0]
HARD: Final = [0.0, 140.0, 0.0, 0.0, 0.0, 0.0]
RELEASE: Final = ask(do="push", wrench=[0.0] * 6)

FAULTS: Final[Sequence[Fault]] = (
    Fault(
        "1", "cable pulls hard", ask(do="cable", force_N=[0, 20, 0]), ask(do="cable", on=False), frozenset({14}), stop=7
    ),
    Fault("5", "protective stop on the approach", ask(do="protective-stop"), unlock, frozenset({10}), at="approach"),
    Fault(
        "8",
        "TCP changed",
        ask(do="set-tcp", tcp=[0, 0, 0.1, 0, 0, 0]),
        ask(do="set-tcp", tcp=[0.0] * 6),
        frozenset({8}),
    ),
    Fault("10", "protective stop", ask(do="protective-stop"), unlock, frozenset({10})),
    Fault("11", "emergency stop", ask(do="emergency-stop", on=True), power_up, frozenset({11})),
    Fault("11", "safeguard stop", ask(do="safeguard", on=True), ask(do="safeguard", on=False), frozenset({11, 21})),
    Fault("12", "reduced mode", ask(do="reduced", on=True), ask(do="reduced", on=False), frozenset({12})),
    Fault("13", "an axis saturates", ask(do="saturate", axis=2), ask(do="saturate", on=False), frozenset({13, 14, 15})),
    Fault("14", "push, tool not yet known", ask(do="push", wrench=HARD), RELEASE, frozenset({14})),
    Fault("14", "push, tool known", ask(do="push", wrench=PUSH), RELEASE, frozenset({14}), stop=7),
    Fault(
        "14", "push while a pose is averaged", ask(do="push", wrench=HARD), RELEASE, frozenset({14}), 0.1, at="sample"
    ),
    Fault(
        "15",
        "sensor silent",
        ask(do="sensor-faults", stall=True),
        ask(do="sensor-faults", stall=False),
        frozenset({15}),
        0.15,
    ),
    Fault("15", "sensor stuck", ask(do="freeze-sensor"), ask(do="freeze-sensor", on=False), frozenset({15}), 0.25),
    Fault("15", "sensor unplugged", ask(do="unplug"), nothing, frozenset({15}), 0.15, restart=True),
    Fault("16", "controller silent", ask(do="silence-arm"), ask(do="silence-arm", on=False), frozenset({16}), 0.3),
    Fault(
        "16",
        "state stream silent",
        ask(do="silent", what="rtde"),
        ask(do="silent", what="rtde", on=False),
        frozenset({16}),
        0.3,
    ),
    Fault("16", "state stream hangs up", ask(do="drop", what="rtde", reset=True), nothing, frozenset({16, 21}), 0.3),
    Fault("17", "Ctrl-C", send(signal.SIGINT), nothing, frozenset(), resumed=True),
    Fault("18", "killed", send(signal.SIGKILL), nothing, frozenset(), 0.5, resumed=True),
    Fault(
        "18", "killed with all its processes", send(signal.SIGKILL, group=True), nothing, frozenset(), 0.5, resumed=True
    ),
    Fault("18", "suspended", send(signal.SIGSTOP), send(signal.SIGCONT), frozenset(), 0.5, resumed=True),
    Fault("21", "program of another client", ask(do="foreign-program", seconds=1), nothing, frozenset({21})),
    Fault("21", "another client's stop", ask(do="dashboard-stop"), nothing, frozenset({21})),
    Fault("21", "program ends by itself", ask(do="crash-script"), nothing, frozenset({21})),
    Fault("22", "slider at 0", ask(do="slider", fraction=0.0), ask(do="slider", fraction=1.0), frozenset({22}), 11.0),
    Fault("26", "poses cannot be written", hide_poses, show_poses, frozenset({26}), 2.0, at="sample"),
)


# -- refused before anything moves -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Refusal:
    """Something that is wrong before the tour."""

    row: str
    name: str
    options: tuple[str, ...] = ()
    do: Json | None = None
    change: Callable[[CellConfig], CellConfig] = lambda cell: cell
    arguments: tuple[str, ...] = ()
    measured: bool = True
    words: str = ""


def _of_model(model: str) -> Callable[[CellConfig], CellConfig]:
    return lambda cell: replace(cell, robot=replace(cell.robot, model=model))


def _of_tool(*cylinder: float) -> Callable[[CellConfig], CellConfig]:
    return lambda cell: replace(cell, tool=ToolConfig("tool", (cylinder,)))


REFUSALS: Final[Sequence[Refusal]] = (
    Refusal("2, 3", "a tool of 1.2 m", change=_of_tool(0.0, 1200.0, 100.0)),
    Refusal("3", "nobody has measured", measured=False, words="measured"),
    Refusal("3", "a safety plane in the way", ("--plane", "0,0,1,1.0"), words="safety limits"),
    Refusal("7", "payload 0 in the controller", ("--payload", "0"), words="payload"),
    Refusal("8", "a TCP the controller does not tell", ("--tcp", "0,0,0.2,0,0,0", "--no-tcp-offset"), words="TCP"),
    Refusal("9", "another model", change=_of_model("UR10e"), words="UR10e"),
    Refusal("10", "protective stop", do={"do": "protective-stop"}, words="protective"),
    Refusal("11", "emergency stop", do={"do": "emergency-stop"}, words="emergency"),
    Refusal("15", "sensor silent", do={"do": "sensor-faults", "stall": True}),
    Refusal("15", "sensor stuck", do={"do": "freeze-sensor"}, words="stuck"),
    Refusal("16", "controller silent", do={"do": "silence-arm"}),
    Refusal("21", "local control", do={"do": "remote-control", "on": False}, words="remote"),
    Refusal(
        "25", "a plan for another tool", change=_of_tool(0.0, 150.0, 90.0), arguments=("--plan", "PLAN"), words="tool"
    ),
    Refusal("26", "a folder that cannot be written", arguments=("--runs", "/proc/none"), words="written"),
)


def refuse(folder: Path, plan: Path, refusal: Refusal) -> tuple[bool, str]:
    with Station("can", [*REAL_TIME, *refusal.options]) as station:
        config = write_config(folder, refusal.change(station.cell), refusal.measured)
        if refusal.do is not None:
            station.control(**refusal.do)
        arguments = [str(plan) if word == "PLAN" else word for word in refusal.arguments]
        child = Child(folder, "--config", config, "--minimal", *arguments)
        scene = Scene(station, folder, child)
        answer = conduct(scene)
        code = child.end()
        if refusal.name == "controller silent":
            station.control(do="silence-arm", on=False)
        moved = any(e["what"] == "moves" for e in station.control(do="state", since=0)["events"])
    words = (folder / "stderr.txt").read_text().strip().splitlines()
    said = next((line for line in words if line.startswith("error")), words[-1] if words else "")
    passed = answer is None and code not in {0, 1} and not moved and refusal.words.lower() in said.lower()
    return passed, f"exit code {code}{', MOVED' if moved else ''}: {said[:150]}"


# -- the table ---------------------------------------------------------------------------------------------------------


def say(words: str) -> None:
    sys.stdout.write(words + "\n")
    sys.stdout.flush()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", help="rows of the hazard table")
    parser.add_argument("--repeat", type=int, default=1)
    options = parser.parse_args()
    wanted = [f for f in FAULTS if not options.only or f.row in options.only] * options.repeat
    folder = Path(tempfile.mkdtemp(prefix="ftdrive-hazards-"))
    failed = 0
    try:
        first = undisturbed(folder, "--minimal")  # slow, as every first run; from now on the plan may run fast
        plan = folder / first["run"] / "plan.json"
        reference = [result_of(folder, undisturbed(folder, "--plan", str(plan), "--fast")) for _ in range(2)]
        say(f"load {os.getloadavg()[0]:.1f}; two undisturbed runs differ by {in_groups(group_sigmas(*reference))}")
        say(f"\n{'row':4} {'fault':34} {'reaction':34} {'limit':>7} kept  difference from undisturbed, sigma")
        pooled: list[dict[str, Array]] = []
        for fault in wanted:
            failed += not report(folder, plan, fault, reference[0], pooled)
        if pooled:
            together = {name: rms([one[name] for one in pooled]) for name in pooled[0]}
            say(
                f"\nrms over {len(pooled)} resumed runs, by group: "
                + ", ".join(f"{k} {v:.2f}" for k, v in together.items())
            )
        say("\nrefused before anything moves")
        for refusal in REFUSALS:
            if not options.only or refusal.row in options.only:
                passed, words = refuse(folder, plan, refusal)
                failed += not passed
                say(f"{refusal.row:4} {refusal.name:34} {'pass' if passed else 'FAIL'}  {words}")
        say("\nnot injected here")
        for name, why in UNSEEN.items():
            say(f"{name:32} {why}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    say(f"\n{failed} rows failed")
    return failed


def report(
    folder: Path, plan: Path, fault: Fault, reference: CalibrationResult, pooled: list[dict[str, Array]]
) -> bool:
    limit_s = fault.detect_s + (0.0 if fault.at == "sample" else BRAKING_S)
    seen = disturb(folder, plan, fault)
    complaints = []
    took_s = None if seen.stands_ns is None else (seen.stands_ns - seen.injected_ns) / 1e9
    if not seen.injected_ns or (fault.at in {"move", "approach"} and not seen.was_moving):
        complaints.append("not injected in a move")
    if took_s is None:
        complaints.append("never seen to stand")
    elif took_s > limit_s:
        complaints.append("late")
    if fault.hazards and not (seen.hazards and seen.hazards[0] in fault.hazards):
        complaints.append(f"named as {list(seen.hazards)}")
    if seen.moved_while_held:
        complaints.append("moved while held")
    expected = 0 if fault.at == "approach" else fault.stop - 1
    if seen.kept != expected:
        complaints.append(f"{seen.kept} poses kept, not {expected}")
    differs = "not resumed"
    if seen.resumed is None:
        complaints.append("not resumed")
    else:
        groups = group_sigmas(result_of(folder, seen.resumed), reference)
        pooled.append(groups)
        differs = in_groups(groups)
        if max(rms([values]) for values in groups.values()) > 2.5:
            complaints.append("another calibration")
    how = "held" if fault.at == "sample" else "stopped"
    hazards = f", guard {seen.hazards[0]}" if seen.hazards else ""
    reaction = "none" if took_s is None else f"{how} after {took_s:.2f} s{hazards}"
    verdict = f"FAIL: {'; '.join(complaints)} ({seen.words[:100]})" if complaints else "pass"
    say(f"{fault.row:4} {fault.name:34} {reaction:34} {limit_s:5.2f} s {seen.kept:4}  {differs}  {verdict}")
    return not complaints


def in_groups(groups: Mapping[str, Array]) -> str:
    return ", ".join(f"{name} {rms([values]):.1f}" for name, values in groups.items())


if __name__ == "__main__":
    raise SystemExit(main())
