"""One flipped bit in each format, read by the commands: no wrong number is used, no traceback, no hang.

    uv run python -m tests.benchmarks.bit_flips [--flips 200] [--only mcap] [--seed 0]

The files are those of a run of six poses in an emulated cell, and a recording of 2 s. Each command reads the damaged
file in a process that is ended after a minute. Its answer is compared with that of the intact file. Prints how often
each command gave equal numbers, refused, read an incomplete recording and said so, gave other numbers, a traceback, did
not end, or crashed; and pass or FAIL. `live` plays in real time, so that only its calibration is compared.
"""

import argparse
import contextlib
import io
import json
import logging
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from ftdrive import cli
from ftdrive.commands.emulated_run import rehearsed_run
from ftdrive.recording import Recorder, read_recording
from ftdrive.runs.bundle import write_bundle
from tests.unit.ftdrive.recorded import block, calibration, info

LONGEST_S = 60.0
REFUSED = (2, 6, 7)
"""Exit codes of a sentence; 7 is that of a plan that was changed."""
FAILURES = ("wrong", "traceback", "hang", "crash")
OUTCOMES = ("equal", "refused", "incomplete", *FAILURES)
_LEFT_OUT = ("created_utc", "argv", "age_days", "trust", "plan", "plan_error")
_OF_LIVE = ("rate_Hz", "t_s", "raw", "compensated", "sigma", "delay_s")
"""Of a mean over samples whose number differs from call to call; the other commands compare each."""

Use = Callable[[Path], list[str]]


@dataclass(frozen=True)
class Format:
    """Files in which bits are flipped, and the commands that read them, each given the path of the whole."""

    path: str
    files: str
    """Of the path, as a pattern; empty for the file itself."""
    uses: Mapping[str, Use]


def json_of(*words: str) -> Use:
    return lambda path: [*words, str(path), "--json"]


def live(path: Path) -> list[str]:
    return ["live", "--replay", str(path), "--once", "--json", "--speed", "50"]


RECORDING: Mapping[str, Use] = {
    "compensate": json_of("compensate"),
    "convert": lambda path: ["convert", str(path), "converted.csv", "--json"],
    "live --replay": live,
}
RUN: Mapping[str, Use] = {
    "solve": json_of("solve"),
    "replay": json_of("replay"),
    "report": lambda path: ["report", str(path), "--format", "json"],
}
FORMATS: Mapping[str, Format] = {
    "run": Format(
        "run",
        "**/*.*",
        {**RUN, "live --replay": lambda path: [*live(path), "--calibration", "intact.json"]},
    ),
    "calibration": Format(
        "calibration.json",
        "",
        {
            "report": RUN["report"],
            "export": lambda path: ["export", "calibration", str(path), "--format", "json"],
            "live --replay": lambda path: [*live(Path("run")), "--calibration", str(path)],
            "compensate": lambda path: ["compensate", "intact.csv", "--json", "--calibration", str(path)],
        },
    ),
    "csv": Format("peg.csv", "", RECORDING),
    "mcap": Format("peg.mcap", "", RECORDING),
    "parquet": Format("peg.parquet", "", RECORDING),
    "plan": Format("plan.json", "", {"export": lambda path: ["export", "plan", str(path), "--format", "csv"]}),
    "bundle": Format("run.zip", "", RUN),
}


def make(folder: Path) -> None:
    """Write an intact file of each format."""
    with rehearsed_run(None) as run, contextlib.chdir(folder):
        shutil.copytree(run, folder / "run")
        write_bundle(run, folder / "run.zip")
        shutil.copy(run / "plan.json", folder)
        calibration().save(folder / "calibration.json")
        shutil.copy(run / "calibration.json", folder / "intact.json")
    recorder = Recorder([folder / f"peg{ending}" for ending in (".csv", ".mcap", ".parquet")], info(), {})
    for start in range(0, 2000, 100):
        recorder.write(block(100, start))
    recorder.close()
    shutil.copy(folder / "peg.csv", folder / "intact.csv")


def answer(words: list[str]) -> tuple[int, Any]:
    """Run a command; return its exit code and what it has answered, without what differs from call to call."""
    Path("converted.csv").unlink(missing_ok=True)
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        code = cli.run(words)
    text = out.getvalue()
    if code:
        return code, None
    if words[0] == "convert":
        found = read_recording(Path("converted.csv"))
        return 0, (json.loads(text)["complete"], found.rows.tobytes(), list(found.events), found.header.to_dict())
    try:
        said = [plain(json.loads(line)) for line in text.splitlines()]
        return 0, [{name: one[name] for name in one if words[0] != "live" or name not in _OF_LIVE} for one in said]
    except ValueError:
        return 0, text


def plain(value: Any) -> Any:
    """Leave out what differs from call to call, and the plan in a report, which says if it leaves it out."""
    if isinstance(value, dict):
        return {name: plain(one) for name, one in value.items() if name not in _LEFT_OUT}
    return [plain(one) for one in value] if isinstance(value, list) else value


def outcome(words: list[str], intact: Any) -> str:
    """Read a damaged file."""
    try:
        code, found = answer(words)
    except Exception:
        return "traceback"
    if code:
        return "refused" if code in REFUSED else "traceback"
    if found == intact:
        return "equal"
    if words[0] == "convert" and not found[0] and intact[1].startswith(found[1]):
        return "incomplete"
    return "wrong"


def flip(data: bytes, rng: random.Random) -> bytes:
    damaged = bytearray(data)
    damaged[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def worker(pipe: Connection, folder: Path) -> None:
    """Answer each command line with its outcome, beside the answer of the intact file."""
    logging.disable()
    known: dict[str, Any] = {}
    with contextlib.chdir(folder):
        while (words := pipe.recv()) is not None:
            key = " ".join(words[1])
            if words[0] == "intact":
                code, known[key] = answer(words[1])
                if code:
                    raise RuntimeError(f"the intact file is refused: {key}")
                pipe.send("equal")
            else:
                pipe.send(outcome(words[1], known[key]))


class Reader:
    """A process that reads files; a new one after a hang or a crash."""

    def __init__(self, folder: Path, uses: list[list[str]]) -> None:
        self._folder, self._uses = folder, uses
        self._start()

    def _start(self) -> None:
        self._pipe, theirs = get_context("spawn").Pipe()
        self._process = get_context("spawn").Process(target=worker, args=(theirs, self._folder), daemon=True)
        self._process.start()
        theirs.close()
        self._intact = True

    def learn(self) -> None:
        """Read the intact files."""
        for words in self._uses:
            self._pipe.send(("intact", words))
            self._pipe.recv()
        self._intact = False

    @property
    def must_learn(self) -> bool:
        return self._intact

    def read(self, words: list[str]) -> str:
        """Return the outcome of one command."""
        self._pipe.send(("damaged", words))
        try:
            if self._pipe.poll(LONGEST_S):
                found: str = self._pipe.recv()
                return found
            self._end()
            found = "hang"
        except EOFError:
            found = "crash"
        self._start()
        return found

    def _end(self) -> None:
        self._process.kill()
        self._process.join()

    def close(self) -> None:
        self._pipe.send(None)
        self._process.join(5)
        self._end()


def trial(folder: Path, name: str, flips: int, seed: int) -> dict[str, Counter[str]]:
    """Flip bits in one format, one after the other; count the outcomes of each command."""
    chosen, rng = FORMATS[name], random.Random(f"{seed} {name}")
    path = Path(chosen.path)
    whole = folder / path
    files = sorted(one for one in whole.glob(chosen.files) if one.is_file()) if chosen.files else [whole]
    uses = {use: words(path) for use, words in chosen.uses.items()}
    reader = Reader(folder, list(uses.values()))
    counts = {use: Counter[str]() for use in uses}
    for _ in range(flips):
        if reader.must_learn:
            reader.learn()
        file = rng.choice(files)
        content = file.read_bytes()
        file.write_bytes(flip(content, rng))
        for use, words in uses.items():
            counts[use][reader.read(words)] += 1
            if reader.must_learn:  # after a hang or a crash
                damaged = file.read_bytes()
                file.write_bytes(content)
                reader.learn()
                file.write_bytes(damaged)
        file.write_bytes(content)
    reader.close()
    return counts


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flips", type=int, default=200)
    parser.add_argument("--only", choices=FORMATS)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory(prefix="ftdrive-") as name:
        folder = Path(name)
        make(folder)
        sys.stdout.write(f"{'':28}" + "".join(f"{one:>11}" for one in OUTCOMES) + "\n")
        for one in [given.only] if given.only else FORMATS:
            for use, found in trial(folder, one, given.flips, given.seed).items():
                passed = not any(found[name] for name in FAILURES)
                failed += not passed
                counted = "".join(f"{found[name]:11}" for name in OUTCOMES)
                sys.stdout.write(f"{one + ' ' + use:28}{counted}  {'pass' if passed else 'FAIL'}\n")
                sys.stdout.flush()
    return failed


if __name__ == "__main__":
    sys.exit(main())
