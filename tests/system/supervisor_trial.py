"""One trial of row 27: the supervisor of a session leaves, the emulated arm is watched, and the run is resumed."""

import json
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from ftdrive.cell.emulated import Station
from tests.system.command_line import CommandLine, say, wait_until

Kind = Literal["reader killed", "stdin closed"]
GONE: Final = 9
ANSWERS: Final = "yes\nyes\nyes\nMOVE\nyes\n"
_SLOW: Final = 0.05
"""Of the speed slider: the arm of the station is 20 times faster than a real one."""
_SAMPLE_S: Final = 3.0


@dataclass(frozen=True)
class Seen:
    """What a trial has shown."""

    exit_code: int
    said: str
    """On standard error."""
    moved: bool
    """Whether the arm moved when the supervisor left."""
    rest_s: float | None
    """Emulated time until the arm stood; None if it stood before and did not move again."""
    events: tuple[str, ...]
    """Words of the trips of row 27 in the run."""
    resumed: int
    """Exit code of --resume."""


class Supervised:
    """A session whose supervisor leaves as `kind` says."""

    def __init__(self, kind: Kind, ftdrive: CommandLine, *arguments: str | Path) -> None:
        self._reader: subprocess.Popen[bytes] | None = None
        if kind == "reader killed":
            self._reader = subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
            pipe = self._reader.stdin
            assert pipe is not None
            self.process = ftdrive.start(*arguments, "--json", stdout=pipe)
            pipe.close()
        else:
            self.process = ftdrive.start(*arguments, "--json")
            threading.Thread(target=self.process.stdout.read, daemon=True).start()  # type: ignore[union-attr]
        say(self.process, ANSWERS)

    def leave(self) -> None:
        if self._reader is not None:
            self._reader.kill()
            self._reader.wait()
        else:
            assert self.process.stdin is not None
            self.process.stdin.close()
            self.process.stdin = None

    def end(self) -> tuple[int, str]:
        """Return exit code and standard error once the session has ended."""
        assert self.process.stderr is not None
        said = self.process.stderr.read()
        return self.process.wait(timeout=60), said


def trial(kind: Kind, station: Station, ftdrive: CommandLine, *, moving: bool) -> Seen:
    """Let the supervisor of `calibrate` leave while the arm moves to pose 3, or is at it; then resume the run."""
    config = ftdrive.connect(station)
    text = config.read_text(encoding="utf-8")
    if not moving:
        config.write_text(text.replace("average_s = 0.1", f"average_s = {_SAMPLE_S}"), encoding="utf-8")
    supervised = Supervised(kind, ftdrive, "calibrate", "--config", config, "--minimal")
    process = supervised.process
    ftdrive.wait_for_poses(process, 1)
    if moving:
        station.control(do="slider", fraction=_SLOW)
    ftdrive.wait_for_poses(process, 2)
    (run,) = (ftdrive.folder / "runs").iterdir()
    if moving:
        wait_until(lambda: bool(station.control(do="state")["moving"]), process)
    else:
        wait_until(lambda: any(e.get("state") == "sample" and e.get("stop") == 3 for e in events(run)), process)
    moved, rest_s, (code, said) = _watched(station, supervised.leave, supervised.end)
    trips = tuple(e["words"] for e in events(run) if e["event"] == "guard-tripped" and e["hazard"] == 27)
    station.control(do="slider", fraction=1.0)
    config.write_text(text, encoding="utf-8")
    resumed = ftdrive.run("calibrate", "--config", config, "--resume", run, typed=ANSWERS)
    return Seen(code, said, moved, rest_s, trips, resumed.returncode)


def verify_trial(station: Station, ftdrive: CommandLine, run: Path) -> Seen:
    """Kill the reader of `verify --json` while the arm moves; then resume."""
    config = ftdrive.connect(station)
    supervised = Supervised("reader killed", ftdrive, "verify", "--config", config, "--calibration", run)
    process, before = supervised.process, set((ftdrive.folder / "runs").iterdir())
    wait_until(lambda: len(set((ftdrive.folder / "runs").iterdir()) - before) == 1, process)
    (folder,) = set((ftdrive.folder / "runs").iterdir()) - before
    wait_until(lambda: any(e["event"] == "pose-taken" for e in events(folder)), process)
    station.control(do="slider", fraction=_SLOW)
    wait_until(lambda: bool(station.control(do="state")["moving"]), process)
    moved, rest_s, (code, said) = _watched(station, supervised.leave, supervised.end)
    trips = tuple(e["words"] for e in events(folder) if e["event"] == "guard-tripped" and e["hazard"] == 27)
    station.control(do="slider", fraction=1.0)
    resumed = ftdrive.run("verify", "--config", config, "--resume", folder, "--update", "no", typed=ANSWERS)
    return Seen(code, said, moved, rest_s, trips, resumed.returncode)


def push_trial(station: Station, ftdrive: CommandLine, run: Path) -> tuple[int, str, bool]:
    """Close the answers of `push` at its question; return exit code, standard error, and whether something was sent."""
    config = ftdrive.connect(station)
    text = config.read_text(encoding="utf-8")
    config.write_text(text.replace("[sensor]\n", "[sensor]\nmass_kg = 0.25\nheight_mm = 40.0\n"), encoding="utf-8")
    before = station.control(do="state")["payload_kg"]
    process = ftdrive.start("push", run, "--config", config, "--json")
    assert process.stdout is not None
    assert process.stdin is not None
    for line in process.stdout:
        if '"question"' in line:
            break
    process.stdin.close()
    process.stdin = None
    _, said = process.communicate(timeout=60)
    sent = station.control(do="state")["payload_kg"] != before or any(run.glob("push*"))
    return process.returncode, said, sent


def events(run: Path) -> Iterator[dict[str, Any]]:
    """Yield the events on disk so far."""
    path = run / "events.ndjson"
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        with suppress(json.JSONDecodeError):  # the last one is being written
            yield json.loads(line)


def _watched(
    station: Station, leave: Callable[[], None], end: Callable[[], tuple[int, str]]
) -> tuple[bool, float | None, tuple[int, str]]:
    """Return whether the arm moved at the cause, the emulated time until it stood, and how the session ended."""
    with _standing_still(station) as cause_ns:
        moved = bool(station.control(do="state")["moving"])
        leave()
    ended = end()
    state = station.control(do="state")
    assert not state["moving"]
    times = [e for e in state["events"] if e["by"] == "arm" and e["t_host_ns"] > cause_ns]
    stood = [e["t_host_ns"] for e in times if e["what"] == "stands"]
    assert [e["what"] for e in times] == (["stands"] if moved else [])
    return moved, (stood[0] - cause_ns) / 1e9 if moved else None, ended


@contextmanager
def _standing_still(station: Station) -> Iterator[int]:
    """Hold the cell's time; yields it."""
    with station.clock.keeping_up():
        now_ns = station.clock.now_ns()
        with station.clock.held():
            yield now_ns
