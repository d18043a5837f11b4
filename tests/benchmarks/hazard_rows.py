"""The rows of the hazard table: what happens to a cell in mid-tour, and what is wrong with one before."""

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from ftdrive.cell.config import CellConfig, ToolConfig
from ftdrive.cell.emulated import Station

Json = dict[str, Any]

PAYLOAD_KG = 1.5
"""The settings of the controller in all rows that set nothing else."""

UNSEEN: Final[Mapping[str, str]] = {
    "1 cable, gently": "nothing stops the arm below the contact limit; the report names poses (test_live_fit.py)",
    "4 what is not described": "only the question and the contact guard (14)",
    "6 singularities": "by construction: joint moves only",
    "13 overload of a known range": "the contact guard comes first (14); guard and samples of a pose: unit tests",
    "20 people": "only the questions, and 14",
    "23 the tool moves": "named in the report, and refused where it changed the tool (test_live_fit.py)",
    "24 base not bolted": "only the question; the tilt is estimated",
}


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
        """Those on disk, in whatever folder they are."""
        return [] if self.run is None else sorted(self.run.glob("*/*.npz"))

    def state(self) -> Mapping[str, Any]:
        return self.station.control(do="state", since=0)

    def do(self, **request: Any) -> None:
        answer = self.station.control(**request)
        if "error" in answer:
            raise RuntimeError(f"{request}: {answer['error']}")


Deed = Callable[[Scene], None]


@dataclass(frozen=True)
class Fault:
    """Something that happens in mid-tour."""

    row: str
    name: str
    inject: Deed
    repair: Deed
    hazards: Set[int]
    """The rows that may name it."""
    detect_s: float = 0.05
    at: str = "move"
    """The state in which it happens, on the way to `stop`; or "approach"."""
    stop: int = 4
    resumed: bool = False
    """The process is gone, and --resume goes on."""
    restart: bool = False
    """Its repair needs the cell to be switched off and on."""
    ends_its_move: bool = False
    """The arm cannot be reached: it ends the commanded move, and the session reports that."""
    words: str = ""
    """Part of the text that is shown."""


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


def by_hand(scene: Scene) -> None:
    """Begin to turn the last joint by hand; that takes seconds."""
    *others, last = scene.state()["q_rad"]
    scene.do(do="hand-move", q_rad=[*others, last - 1.0], speed_rad_s=0.2)


def switch(do: str, **details: Any) -> tuple[Deed, Deed]:
    """Switch something in the emulated cell on, and off again as the repair."""
    return ask(do=do, **details), ask(do=do, on=False)


def push(force_y_N: float) -> tuple[Deed, Deed]:
    """Push the tool sideways, and let go as the repair."""
    return ask(do="push", wrench=[0.0, force_y_N, 0.0, 0.0, 0.0, 0.0]), ask(do="push", wrench=[0.0] * 6)


def displace(joint: int, off_deg: float) -> tuple[Deed, Deed]:
    """Take a joint off its line, and back as the repair."""
    return ask(do="push-joint", joint=joint, off_deg=off_deg), ask(do="push-joint", joint=joint, off_deg=0)


STALL: Final = ask(do="sensor-faults", stall=True), ask(do="sensor-faults", stall=False)
EMERGENCY_STOP: Final = ask(do="emergency-stop", on=True), power_up
PAYLOAD: Final = ask(do="set-payload", payload_kg=3.0), ask(do="set-payload", payload_kg=PAYLOAD_KG)
TCP: Final = ask(do="set-tcp", tcp=[0, 0, 0.1, 0, 0, 0]), ask(do="set-tcp", tcp=[0.0] * 6)
PROTECTIVE_STOP: Final = ask(do="protective-stop"), unlock
RTDE_SILENT: Final = ask(do="silent", what="rtde"), ask(do="silent", what="rtde", on=False)
SLIDER: Final = ask(do="slider", fraction=0.0), ask(do="slider", fraction=1.0)
ONE_MOVE: Final = "it completes the current move it was given"

# fmt: off
FAULTS: Final[Sequence[Fault]] = (
    Fault("1", "cable pulls hard", *switch("cable", force_N=[0, 20, 0]), {14}, stop=7),
    Fault("2", "a joint off its line", *displace(2, 1.5), {2}),
    Fault("5", "protective stop on the approach", *PROTECTIVE_STOP, {10}, at="approach"),
    Fault("7", "payload changed", *PAYLOAD, {7}, words="payload"),
    Fault("8", "TCP changed", *TCP, {8}),
    Fault("7, 10", "protective stop", *PROTECTIVE_STOP, {10}, words="wrong payload"),
    Fault("11", "emergency stop", *EMERGENCY_STOP, {11}),
    Fault("11", "safeguard stop", ask(do="safeguard", on=True), ask(do="safeguard", on=False), {11, 21}),
    Fault("12", "reduced mode", ask(do="reduced", on=True), ask(do="reduced", on=False), {12}),
    Fault("13", "an axis saturates", *switch("saturate", axis=2), {13, 14, 15}),
    Fault("14", "push, tool not yet known", *push(140.0), {14}),
    Fault("14", "push, tool known", *push(25.0), {14}, stop=7),
    Fault("14", "push while a pose is averaged", *push(140.0), {14}, 0.1, at="sample"),
    Fault("15", "sensor silent", *STALL, {15}, 0.15),
    Fault("15", "sensor stuck", *switch("freeze-sensor"), {15}, 0.25),
    Fault("15", "sensor unplugged", ask(do="unplug"), nothing, {15}, 0.15, restart=True),
    Fault("16", "controller silent", *switch("silence-arm"), {16}, 0.5, ends_its_move=True, words=ONE_MOVE),
    Fault("16", "state stream silent", *RTDE_SILENT, {16}, 0.3),
    Fault("16", "state stream hangs up", ask(do="drop", what="rtde", reset=True), nothing, {16, 21}, 0.3),
    Fault("17", "Ctrl-C", send(signal.SIGINT), nothing, set(), resumed=True),
    Fault("18", "killed", send(signal.SIGKILL), nothing, set(), 0.5, resumed=True),
    Fault("18", "killed with all its processes", send(signal.SIGKILL, group=True), nothing, set(), 0.5, resumed=True),
    Fault("18", "suspended", send(signal.SIGSTOP), send(signal.SIGCONT), set(), 0.5, resumed=True),
    Fault("19", "moved by hand, resume meanwhile", ask(do="dashboard-stop"), by_hand, {21}),
    Fault("19", "pushed while a pose is averaged", *displace(6, 1.0), {21}, 0.1, at="sample"),
    Fault("21", "program of another client", ask(do="foreign-program", seconds=1), nothing, {21}),
    Fault("21", "another client's stop", ask(do="dashboard-stop"), nothing, {21}),
    Fault("21", "program ends by itself", ask(do="crash-script"), nothing, {21}),
    Fault("22", "slider at 0", *SLIDER, {22}, 11.0),
    Fault("26", "poses cannot be written", hide_poses, show_poses, {26}, 2.0, at="sample"),
)
# fmt: on


# -- before anything moves ---------------------------------------------------------------------------------------------


MINIMAL: Final = ("--minimal",)


@dataclass(frozen=True)
class Beforehand:
    """Something that is odd before the tour: refused with an exit code and words, or rightly not (code 0)."""

    row: str
    name: str
    code: int
    words: str = ""
    options: tuple[str, ...] = ()
    do: Json | None = None
    change: Callable[[CellConfig], CellConfig] = lambda cell: cell
    arguments: tuple[str, ...] = MINIMAL
    sensor: str = "can"


def _of_model(model: str) -> Callable[[CellConfig], CellConfig]:
    return lambda cell: replace(cell, robot=replace(cell.robot, model=model))


def _of_tool(*cylinder: float, mass_kg: float | None = None) -> Callable[[CellConfig], CellConfig]:
    return lambda cell: replace(cell, tool=ToolConfig("tool", (cylinder,), mass_kg))


def _of_workcell(**different: Any) -> Callable[[CellConfig], CellConfig]:
    return lambda cell: replace(cell, workcell=replace(cell.workcell, **different))


def _caged(cell: CellConfig) -> CellConfig:
    """Four walls and a ceiling around an arm with a tool that is longer than its cage."""
    walls = ((-1, 0, 0, -600), (1, 0, 0, -600), (0, 1, 0, -600), (0, -1, 0, -600), (0, 0, -1, -1000))
    return _of_workcell(planes_mm=walls, measured=True)(_of_tool(0.0, 1200.0, 100.0)(cell))


BOX_MM: Final = (-400.0, -600.0, 300.0, 100.0, 0.0, 600.0)
HEAVY_SET: Final = ("--payload", "14")
HEAVY: Final = _of_tool(0.0, 300.0, 100.0, mass_kg=14.0)
SHORT: Final = _of_tool(0.0, 150.0, 90.0)

# fmt: off
BEFOREHAND: Final[Sequence[Beforehand]] = (
    Beforehand("2, 3", "a tool longer than its cage", 7, "proven clear", change=_caged),
    Beforehand("3", "not measured", 7, "measured", change=_of_workcell(measured=False)),
    Beforehand("3", "a safety plane in the way", 7, "safety limits", ("--plane", "0,0,1,1.0")),
    Beforehand("5", "the arm stands in a box", 7, "the clearance is 0 mm", change=_of_workcell(boxes_mm=(BOX_MM,))),
    Beforehand("7", "payload 0 in the controller", 7, "payload", ("--payload", "0")),
    Beforehand("8", "a turned TCP, not reported", 0, options=("--tcp", "0,0,0.2,0.3,0,0", "--no-tcp-offset")),
    Beforehand("9", "another model", 3, "UR10e", change=_of_model("UR10e")),
    Beforehand("10", "protective stop", 7, "protective", do={"do": "protective-stop"}),
    Beforehand("11", "emergency stop", 5, "emergency", do={"do": "emergency-stop"}),
    Beforehand("13", "a tool of 14 kg, 300 mm", 7, "of the sensor's range", HEAVY_SET, None, HEAVY, MINIMAL, "serial"),
    Beforehand("15", "sensor silent", 3, "no reply", do={"do": "sensor-faults", "stall": True}),
    Beforehand("15", "sensor stuck", 5, "frozen", do={"do": "freeze-sensor"}),
    Beforehand("16", "controller silent", 3, "did not answer", do={"do": "silence-arm"}),
    Beforehand("21", "program of another client", 7, "stop it at the", do={"do": "foreign-program", "seconds": 60}),
    Beforehand("21", "local control", 7, "remote", do={"do": "remote-control", "on": False}),
    Beforehand("25", "a plan for another tool", 7, "another tool", (), None, SHORT, ("--plan", "PLAN")),
    Beforehand("26", "a folder that cannot be written", 7, "written", arguments=("--minimal", "--runs", "/proc/none")),
)
# fmt: on
