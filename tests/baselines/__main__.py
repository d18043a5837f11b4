"""Compare this tree with what is kept here, or keep what it gives now: see README.md.

    uv run python -m tests.baselines results blocks texts [--write]

Each baseline is a text by name. All that is compared is made from the files in `old_files.tar.xz`, which an earlier
version has written, so that it depends on no other part of the project.
"""

import argparse
import difflib
import hashlib
import json
import lzma
import math
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import ftdrive
import tests.conftest  # the configuration and the terminal of the user do not matter  # noqa: F401
from ftcalib.published.methods import PUBLISHED
from ftdrive.recording.replay import open_replay
from ftdrive.stream.samples import Block, Stages, WrenchFrame
from tests.baselines.pack import unpack
from tests.system.command_line import CommandLine
from tests.unit.ftdrive.recorded import dataset
from tests.unit.ftdrive.tables.test_layouts import CASES, read

HERE = Path(__file__).parent
KEPT_LINES, LONGEST_ROW = 40, 250
PASSING = ("age", "argv", "created", "path", "run", "utc", "versions")
"""Parts of the names of values that depend on the day, the folder or the computer."""


# ---------------------------------------------------------------------------------------------------------------- kinds


def results(old: CommandLine) -> Iterator[tuple[str, str]]:
    """The JSON of results: of the old runs, by every method, and of the layouts of tables."""
    solved = [f"solve {run}" for run in ("quick", "minimal", "new-tool --from quick", "loaded", "sweep")]
    solved += [f"solve minimal --{known}" for known in ("level-deg .5", "drift none", "drift linear", "mass-kg 1")]
    solved += [
        "solve sweep --point-mass",
        "solve quick minimal --together",
        "solve moving.csv",
        "loads solve quick loaded",
    ]
    for command in solved:
        yield command, text_of(json.loads(ended(old, f"{command} --json")[1] or "null"))
    for method in PUBLISHED:
        yield method, text_or_error(partial(solution, dataset(), method))
    for recording in ("rest.mcap", "pushed.mcap", "held.mcap"):
        stream = open_replay(
            old.folder / recording, old.folder / "quick", WrenchFrame("sensor"), speed=math.inf, force=True
        )
        yield f"weigh {recording}", text_or_error(partial(weighed, stream))
    for name in CASES:
        case, table, poses = read(name, old.folder)
        if table is poses:
            path = old.folder / "wrench.csv"
            yield name, text_or_error(partial(solution, path, table=case.options))
        else:
            rows = [*table.wrenches(), *poses.poses()]
            yield name, "\n".join(digest_of(str(k), one.values) for k, one in enumerate(rows))


def blocks(old: CommandLine) -> Iterator[tuple[str, str]]:
    """What the stream makes of recordings, a line for each column: its hash and the mean of each number."""
    settings: Mapping[str, tuple[str, WrenchFrame, Stages, str]] = {
        "at rest": ("rest.mcap", WrenchFrame("sensor"), Stages(), "off"),
        "from CSV, a TCP": ("rest.csv", WrenchFrame("tcp", "tcp"), Stages(notch_Hz=30.0), "off"),
        "from Parquet, no gravity": ("rest.parquet", WrenchFrame("flange", "flange"), Stages(gravity=False), "off"),
        "pushed, filtered": ("pushed.mcap", WrenchFrame("base"), Stages(lowpass_Hz=20.0, deadband_N=0.2), "off"),
        "tracked": ("held.mcap", WrenchFrame("sensor"), Stages(), "apply"),
        "with inertia": ("moving.csv", WrenchFrame("base", "flange"), Stages(inertia=True), "show"),
    }
    for name, (file, frame, stages, track) in settings.items():
        calibration = old.folder / "sweep" if stages.inertia else None
        stream = open_replay(old.folder / file, calibration, frame, speed=math.inf, force=True)
        stream.stages, stream.track = stages, track  # type: ignore[assignment]
        read = list[Block]()
        while not stream.has_ended:
            read.append(stream.read())
        columns = [name for name in Block.__slots__ if isinstance(getattr(read[0], name), np.ndarray)]
        whole = ((column, np.concatenate([getattr(block, column) for block in read])) for column in columns)
        yield name, "\n".join(digest_of(*one) for one in whole)


def solution(source: Any, method: Any = "ml", **options: Any) -> dict[str, Any]:
    return dict(ftdrive.solve(source, method, **options).to_dict())


def weighed(stream: Any) -> dict[str, Any]:
    return asdict(ftdrive.weigh(stream, timeout_s=1.0))


def text_or_error(call: Callable[[], Any]) -> str:
    try:
        return text_of(call())
    except ftdrive.FtdriveError as error:
        return str(error)


def digest_of(name: str, values: np.ndarray[Any, Any]) -> str:
    """A line with the hash of an array (n, …) and the mean of each of its columns."""
    rows = np.ascontiguousarray(values)
    means = np.nanmean(rows.reshape(len(rows), -1).astype(float), axis=0)
    return (
        f"{name} {rows.shape} {hashlib.sha256(rows.tobytes()).hexdigest()[:12]} {' '.join(map(repr, means.tolist()))}"
    )


def texts(old: CommandLine) -> Iterator[tuple[str, str]]:
    """Exit code, stdout (|) and stderr (!) of each line of `commands.txt`."""
    for number, command in enumerate((HERE / "commands.txt").read_text("utf-8").splitlines(), 1):
        code, out, err = ended(old, command)
        rows = [f"{mark} {row.rstrip()}" for mark, text in (("|", out), ("!", err)) for row in text.splitlines()]
        lasting = [masked(row, old.folder) for row in rows if not row.endswith(" …")]  # progress of a slow computer
        yield f"{number} {command}", "\n".join([f"exit code {code}", *lasting])


def ended(old: CommandLine, command: str) -> tuple[int, str, str]:
    outcome = old.run(*shlex.split(command))
    return outcome.returncode, outcome.stdout, outcome.stderr


MASKED: Mapping[str, str] = {
    r"\d{4}-\d\d-\d\d[T ]\d\d:?\d\d:?\d\d(\.\d+)?(Z|\+00:00)?|\d{4}-\d\d-\d\d \d\d:\d\d": "TIME",
    r'(?<="age_days": )[\d.e-]+': "AGE",
    r"\b\d+ (s|min|h|d) (ago|old)\b|(?<=passed )\d+ d": "AGE",
}


def masked(row: str, folder: Path) -> str:
    """Replace what depends on the hour and the folder; a long row is its begin and its hash."""
    row = row.replace(str(folder), "FOLDER")
    for pattern, word in MASKED.items():
        row = re.sub(pattern, word, row)
    if len(row) <= LONGEST_ROW:
        return row
    return f"{row[:LONGEST_ROW]} … {len(row)} {hashlib.sha256(row.encode()).hexdigest()[:12]}"


def text_of(answer: Any) -> str:
    """A JSON value as text, all digits of its numbers, without what depends on day, folder or computer."""

    def lasting(value: Any) -> Any:
        value = value.tolist() if isinstance(value, np.ndarray) else value
        if isinstance(value, dict):
            return {key: lasting(one) for key, one in value.items() if not any(part in key for part in PASSING)}
        return [lasting(one) for one in value] if isinstance(value, list) else value

    return json.dumps(lasting(answer), indent=0, default=str)


# -------------------------------------------------------------------------------------------------------------- compare


def kept_file(name: str) -> Path:
    return HERE / ("results.txt.xz" if name == "results" else f"{name}.txt")


def read_kept(name: str) -> dict[str, str]:
    content = kept_file(name).read_bytes()
    text = (lzma.decompress(content) if kept_file(name).suffix == ".xz" else content).decode()
    return dict(entry.split("\n", 1) for entry in text.split("\n=== ")[1:])


def keep(name: str, entries: Mapping[str, str]) -> None:
    text = "".join(f"\n=== {key}\n{value}" for key, value in entries.items())
    kept_file(name).write_bytes(lzma.compress(text.encode(), preset=9) if name == "results" else text.encode())


def numbers(text: str) -> np.ndarray[Any, Any]:
    return np.array(re.findall(r"(?<![\w.])-?\d+\.?\d*(?:e[-+]?\d+)?", text), float)


def differences(kept: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    """A paragraph for each entry that differs, with the largest relative difference of its numbers."""
    for name in [*kept, *(name for name in now if name not in kept)]:
        was, is_ = kept.get(name, ""), now.get(name, "")
        if was == is_:
            continue
        one, other = numbers(was), numbers(is_)
        largest = ""
        if len(one) == len(other):
            scale = np.maximum(np.maximum(np.abs(one), np.abs(other)), 1e-300)
            largest = f" (numbers differ by {np.max(np.abs(one - other) / scale, initial=0.0):.1e} at most)"
        lines = list(difflib.unified_diff(was.splitlines(), is_.splitlines(), "kept", "now", "", "", 1, ""))
        rest = [f"… and {len(lines) - KEPT_LINES} lines"] * (len(lines) > KEPT_LINES)
        yield "\n".join([f"=== {name}{largest}", *lines[:KEPT_LINES], *rest])


KINDS: Mapping[str, Callable[[CommandLine], Iterator[tuple[str, str]]]] = {
    "results": results,
    "blocks": blocks,
    "texts": texts,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", choices=KINDS)
    parser.add_argument("--write", action="store_true", help="keep what this tree gives")
    options = parser.parse_args()
    changed = 0
    for name in options.names:
        with TemporaryDirectory() as folder:
            now = dict(KINDS[name](unpack(Path(folder))))
        if options.write:
            keep(name, now)
            continue
        paragraphs = list(differences(read_kept(name), now))
        sys.stdout.writelines(f"{paragraph}\n" for paragraph in paragraphs)
        sys.stdout.write(f"{name}: {len(now)} compared, {len(paragraphs)} differ\n")
        changed += len(paragraphs)
    sys.exit(bool(changed))


if __name__ == "__main__":
    main()
