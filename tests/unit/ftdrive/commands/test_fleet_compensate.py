"""`fleet compensate` as a command; the work is done in this process."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from ftdrive.recording import Recorder
from ftdrive.recording.files import read_recording
from tests.unit.ftdrive.recorded import block, calibration, info

Ran = tuple[int, str, str]


@pytest.fixture
def run(fleet_here: Callable[..., Ran]) -> Callable[..., Ran]:
    return partial(fleet_here, "compensate")


def record(path: Path, *, push_N: float = 0.0, lost: int = 0) -> Path:
    """Three seconds of turning in place, in the last of which something pushes along x, and a gap."""
    samples = replace(block(3000), p_base_flange_m=np.zeros((3000, 3)))
    raw, seq = samples.raw + np.outer(np.arange(3000) >= 2000, push_N * np.eye(6)[0]), samples.seq.copy()
    seq[1500:] += lost
    path.parent.mkdir(exist_ok=True)
    recorder = Recorder([path], info(), {})
    recorder.write(replace(samples, raw=raw, seq=seq))
    recorder.close()
    return path


def test_a_repeated_command_continues(run: Callable[..., Ran], tmp_path: Path) -> None:
    quiet, pushed = record(tmp_path / "in" / "a.mcap"), record(tmp_path / "in" / "b.mcap", push_N=6.0, lost=2)
    other = tmp_path / "in" / "c.csv"
    other.write_text("t,fx\n")
    other.with_name("d.csv.partial").touch()
    (tmp_path / "new" / "out").mkdir(parents=True)
    (tmp_path / "new" / "out" / "a.mcap").write_bytes(b"of the first try")

    code, out, err = run("in", "-o", "new/out", "--axes", "base")
    assert code == 7
    assert "incomplete: 1 recordings; `ftdrive convert` saves one" in err
    assert "1 of 3 recordings could not be compensated" in err
    assert out.splitlines() == [
        "3 recordings: 1 compensated now, 1 before, 1 failed; 3000 samples.",
        out.splitlines()[1],
        f"failed: {other}: the first line is not '# ftdrive.recording/1'",
    ]
    assert out.splitlines()[1].startswith(f"{pushed}: contacts: 1, largest 6.")
    assert out.splitlines()[1].endswith(" N; gaps: 1")
    assert (tmp_path / "new" / "out" / "a.mcap").read_bytes() == b"of the first try"
    assert read_recording(tmp_path / "new" / "out" / "b.mcap").header.frame.axes == "base"

    (tmp_path / "new" / "out" / "a.mcap").unlink()
    code, out, _ = run(quiet, pushed, "-o", "new/out", "--json")
    found = json.loads(out)
    assert code == 0
    assert (found["schema_version"], found["recordings"], found["compensated_before"]) == (1, 2, 1)
    assert (found["samples"], found["failed"]) == (3000, [])
    (one,) = found["compensated"]
    assert (one["recording"], one["contacts"], one["gaps"], one["cut"]) == (str(quiet), [], 0, "")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["in/a.csv", "-o", "in"], "would have the path of the recording: choose another folder"),
        (["in", "other/a.csv", "-o", "out"], "have the same name: compensate them into two folders"),
        (["c.json", "-o", "out"], "fleet compensate --calibration c.json"),
        (["in", "-o", "c.json"], "'c.json' is a file"),
        (["in"], "Missing option '-o'"),
        (["in", "-o", "out", "--about", "here"], "--about is 'here'"),
        (["in", "-o", "out", "--workers", "2", "--cluster", "dask://host:1"], "exclude one another"),
        (["in", "-o", "out", "--calibration", "in"], "in is a folder without a run, which --calibration does not take"),
    ],
)
def test_a_mistake_is_refused_before_any_work(
    run: Callable[..., Ran], arguments: list[str], words: str, tmp_path: Path
) -> None:
    for name in ("in", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.csv").touch()
    calibration().save(tmp_path / "c.json")
    code, out, err = run(*arguments)
    assert (code, out) == (6 if "--calibration" in arguments else 2, "")
    assert words in err
    assert not (tmp_path / "out").exists()
