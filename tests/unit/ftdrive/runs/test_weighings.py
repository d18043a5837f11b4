"""The file of a day: several writers, a power failure, damage, and what its summary counts."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from ftcalib import files
from ftcalib.errors import BadDataset
from ftdrive.runs.weighings import FORMAT, REFUSALS, WeighingsFile
from ftdrive.stream.weighing import WORDS

ORIGIN = {"tool": "gripper", "arm_serial": "arm-1", "emulated": False}
DAY = "2026-11-26"


def part(mass_kg: float, **more: Any) -> dict[str, Any]:
    t_utc = f"{DAY}T10:00:00.000+00:00"
    return {"t_utc": t_utc, "mass_kg": mass_kg, "mass_sigma_kg": 1e-3, "is_something": True, "poses": 1, **more}


def test_every_reason_has_a_count() -> None:
    assert {*REFUSALS} == {*WORDS, "other"}


def test_several_writers_share_one_file(tmp_path: Path) -> None:
    first, second = (WeighingsFile.of(tmp_path / "weighings", ORIGIN, DAY) for _ in range(2))
    assert (
        first.path == second.path == tmp_path / "weighings" / "weighings-2026-11-26-4c9c470a.ndjson"
    )  # of any version
    reordered = dict(reversed(ORIGIN.items()))
    assert WeighingsFile.of(tmp_path / "weighings", reordered, DAY).path == first.path
    assert WeighingsFile.of(tmp_path, {**ORIGIN, "tool": "drill"}, DAY).path.name != first.path.name
    first.append([part(0.1)])
    first.read()
    second.append([part(0.2), {"refused": "cable"}])
    second.append([{"refused": "cable"}, {"refused": "lifted"}, {"refused": "glued"}])
    first.read()
    second.read()
    for one in (first, second):
        assert (one.weighings, one.last["mass_kg"], one.size) == (2, 0.2, one.path.stat().st_size)
        assert {code: n for code, n in one.refusals.items() if n} == {"cable": 2, "lifted": 1, "other": 1}
    lines = [json.loads(line) for line in first.path.read_text().splitlines()]
    assert [line.get("format") for line in lines] == [FORMAT, *[None] * 6]


def test_an_empty_gripper_and_more_poses_of_a_part_do_not_count(tmp_path: Path) -> None:
    file = WeighingsFile.of(tmp_path, ORIGIN, DAY)
    file.append([part(0.3), part(0.31, poses=2), part(0.0, is_something=False)])
    file.read()
    assert (file.weighings, file.last["mass_kg"]) == (1, 0.31)


@pytest.mark.parametrize("kept", [5, 300], ids=["half a header", "half a line"])
def test_what_a_power_failure_cut_off_is_removed(tmp_path: Path, kept: int) -> None:
    file = WeighingsFile.of(tmp_path, ORIGIN, DAY)
    file.append([part(0.1), part(0.2)])
    os.truncate(file.path, kept)
    file.append([part(0.3)])
    file.read()
    assert file.last["mass_kg"] == 0.3
    assert file.weighings == (1 if kept == 5 else 2)


def test_damage_is_refused(tmp_path: Path) -> None:
    file = WeighingsFile.of(tmp_path, ORIGIN, DAY)
    file.append([part(0.1), part(0.2)])
    text = file.path.read_text()
    for damaged, words in (
        (text.replace("0.1", "0.7"), "line 2 of the weighings is damaged"),
        ("", "no weighings"),
        (text.split("\n", 1)[1], "'format' is missing"),
    ):
        file.path.write_text(damaged)
        with pytest.raises(BadDataset, match=words):
            WeighingsFile(file.path).read()


def test_a_line_without_an_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = WeighingsFile.of(tmp_path, ORIGIN, DAY)
    file.append([part(0.1)])
    file.read()
    with file.path.open("ab") as end:
        end.write(bytes(5000))
    monkeypatch.setattr(files, "_LONGEST_LINE", 4000)
    with pytest.raises(BadDataset, match="line 3 is longer than"):
        file.read()


def test_a_failed_write_leaves_the_file_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = WeighingsFile.of(tmp_path, ORIGIN, DAY)
    file.append([part(0.1)])
    before = file.path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        file.append([part(0.2)])
    assert file.path.read_bytes() == before
