"""Trace four real commands, and write the modules that they pass: `uv run python -m tests.house.rooms`.

A module counts if a function of it ran, of ftcalib, ftdrivers or ftdrive. Functions that run only because a module is
imported are not counted. The counts are those of one run, in all threads but that of the guards. The page is
docs/contributing/walks.md.
"""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

PAGE = Path(__file__).parents[2] / "docs/contributing/walks.md"
PACKAGES = ("ftcalib", "ftdrivers", "ftdrive")
WALKS = {
    "a": "`calibrate --simulate --minimal`, until the arm's first move",
    "b": "`live --replay` of a recording",
    "c": "`solve` of a CSV file of poses",
    "d": "`solve` of a recording in motion",
}
FIRST_MOVE = "move_to"
"""The method of the arm driver at which walk (a) ends."""


def traced(arguments: Sequence[str], *, to_the_first_move: bool) -> None:
    """Run a command in this process, and print the modules, functions and calls between modules as JSON."""
    functions, edges = set[tuple[str, str]](), set[tuple[str, str]]()
    rooms = dict[str, tuple[str | None, str]]()  # each with the module that called it first, and the function
    ended = False

    def profile(frame: FrameType, event: str, _: object) -> None:
        nonlocal ended
        code = frame.f_code
        # Comprehensions and the bodies of classes are no functions.
        if event != "call" or ended or not code.co_flags & 1:
            return
        module = frame.f_globals.get("__name__", "")
        if module.split(".")[0] not in PACKAGES:
            return
        if module not in rooms and threading.current_thread().name == "guards":
            return  # how often the guards look before the first move depends on the computer
        caller, back = None, frame.f_back
        while back is not None:
            name = back.f_globals.get("__name__", "")
            if name.split(".")[0] in PACKAGES:
                if back.f_code.co_name == "<module>":
                    return
                caller = caller or name
            back = back.f_back
        function = code.co_qualname.split(".<locals>")[0]
        functions.add((module, function))
        if function == "__create_fn__":  # a method that `dataclass` has written
            function = type(next(iter(frame.f_locals.values()))).__name__
        rooms.setdefault(module, (caller, function))
        if caller and caller != module:
            edges.add((caller, module))
        if to_the_first_move and module.startswith("ftdrivers.ur") and code.co_name == FIRST_MOVE:
            ended = True
            signal.raise_signal(signal.SIGINT)

    from ftdrive.cli import run
    from ftdrive.terminal import console

    vars(console)["_PATIENCE_S"] = 3600.0  # a traced command is slow: it would print that it works
    threading.setprofile(profile)
    sys.setprofile(profile)
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
        code = run([*arguments])
    sys.setprofile(None)
    counts = {"rooms": rooms, "functions": len(functions), "edges": len(edges), "exit_code": code}
    print(json.dumps(counts), flush=True)  # noqa: T201
    os._exit(0)  # the threads of a command that was interrupted do not matter


def prepare(folder: Path) -> dict[str, list[str]]:
    """Write poses and a recording in motion, and return the commands."""
    rng = np.random.default_rng(5)

    def wrench(R: NDArray[np.float64]) -> NDArray[np.float64]:
        force = np.einsum("nji,j->ni", R, [0.1, -0.05, -1.5 * 9.80665])
        free = np.hstack([force, np.cross([0.005, -0.008, 0.07], force)]) + np.array([5, -3, 2, 0.1, 0.2, -0.05])
        return np.asarray(free + rng.standard_normal(free.shape) * np.repeat([0.02, 5e-4], 3))

    def save(name: str, rows: NDArray[np.float64], header: str) -> str:
        np.savetxt(folder / name, rows, delimiter=",", header=header, comments="")
        return str(folder / name)

    header = "qx,qy,qz,qw,fx,fy,fz,tx,ty,tz"
    R = Rotation.random(24, random_state=3)
    poses = save("poses.csv", np.hstack([R.as_quat(), wrench(R.as_matrix())]), header)
    t = np.arange(0, 90, 0.01)
    angles = [1.5 * np.sin(0.25 * t), 1.2 * np.sin(0.19 * t + 1), 1.3 * np.sin(0.31 * t + 2)]
    R = Rotation.from_euler("zyx", np.column_stack(angles))
    rows = np.hstack([t[:, None], -R.apply([0.005, -0.008, 0.1]), R.as_quat(), wrench(R.as_matrix())])
    moving, calibration = save("moving.csv", rows, f"t,x,y,z,{header}"), str(folder / "calibration.json")
    short = save("short.csv", rows[:1500], f"t,x,y,z,{header}")  # played back in real time
    solve = [sys.executable, "-m", "ftdrive", "solve", poses, "-o", calibration]
    subprocess.run(solve, check=True, capture_output=True)
    return {
        "a": ["calibrate", "--simulate", "--minimal", "--yes", "--json", "--runs", str(folder / "runs")],
        "b": ["live", "--replay", short, "--calibration", calibration, "--json"],
        "c": ["solve", poses, "--json"],
        "d": ["solve", moving, "--json"],
    }


def walks() -> dict[str, dict[str, Any]]:
    """Run each command in a process of its own, and return what it passed."""
    passed = {}
    with TemporaryDirectory() as folder:
        environment = {**os.environ, "XDG_DATA_HOME": folder, "XDG_STATE_HOME": folder, "XDG_CONFIG_HOME": folder}
        for name, command in prepare(Path(folder)).items():
            walk = [sys.executable, __file__, "--traced", name, *command]
            nothing = subprocess.DEVNULL
            done = subprocess.run(walk, env=environment, stdin=nothing, capture_output=True, check=True)
            passed[name] = json.loads(done.stdout)
            assert passed[name]["exit_code"] == (130 if name == "a" else 0), done.stderr
    return passed


def tree(rooms: dict[str, tuple[str | None, str]]) -> str:
    """Write each module below the one that called it first, with the function that was called."""
    depths = dict[str, int]()

    def below(caller: str | None) -> Iterator[str]:
        for module, (by, function) in rooms.items():
            if by == caller:
                depths[module] = depths[caller] + 1 if caller else 0
                yield f"{'  ' * depths[module] + module:<56} {function}"
                yield from below(module)

    return "\n".join(below(None))


def page(passed: dict[str, dict[str, Any]]) -> str:
    """Write the page of contributors."""
    parts = [HEAD]
    for name, walk in passed.items():
        counts = f"{len(walk['rooms'])} modules, {walk['functions']} functions, {walk['edges']} calling pairs"
        parts.append(f"## {WALKS[name]}\n\n{counts}.\n\n```text\n{tree(walk['rooms'])}\n```\n")
    return "\n".join(parts)


HEAD = """# Four walks through the code

Each list is the trace of one real command: every module of which a function ran, below the module that called it first,
with the first function called. Modules at the left edge were entered by the command line or by a thread.
`uv run python -m tests.house.rooms` traces them again; `tests/house/test_counts.py` limits their numbers of modules.

[Architecture](../explanation/architecture.md) lists the packages and what each may import.
"""

if __name__ == "__main__":
    if sys.argv[1:2] == ["--traced"]:
        traced(sys.argv[3:], to_the_first_move=sys.argv[2] == "a")
    PAGE.write_text(page(walks()), encoding="utf-8")
