"""The file of a day: several writers, a power failure, damage, and what its summary counts."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from ftcalib.errors import BadDataset
from ftdrive.runs.weighings import FORMAT, REFUSALS, WeighingDay, append_weighings
from ftdrive.stream.weighing import WORDS

ORIGIN = {"tool": "gripper", "arm_serial": "arm-1", "emulated": False}
DAY = "2026-11-26"


def part(mass_kg: float, **more: Any) -> dict[str, Any]:
    t_utc = f"{DAY}T10:00:00.000+00:00"
    return {"t_utc": t_utc, "mass_kg": mass_kg, "mass_sigma_kg": 1e-3, "is_something": True, "poses": 1, **more}


def test_every_reason_has_a_count() -> None:
    assert {*REFUSALS} == {*WORDS, "other"}


def append(folder: Path, *lines: dict[str, Any], origin: dict[str, Any] = ORIGIN) -> Path:
    return append_weighings(folder, origin, DAY, lines)


def test_several_writers_share_one_file(tmp_path: Path) -> None:
    folder = tmp_path / "weighings"
    path = append(folder, part(0.1))
    assert path == folder / "weighings-2026-11-26-4c9c470a.ndjson"  # of any version
    first = WeighingDay.load(path)
    assert append(folder, part(0.2), {"refused": "cable"}, origin=dict(reversed(ORIGIN.items()))) == path
    append(folder, {"refused": "cable"}, {"refused": "lifted"}, {"refused": "glued"})
    assert append(folder, part(0.3), origin={**ORIGIN, "tool": "drill"}) != path
    whole = WeighingDay.load(path)
    assert WeighingDay.load(path, first) == WeighingDay.load(path, whole) == whole
    assert (whole.weighings, whole.mass_kg, whole.size) == (2, 0.2, path.stat().st_size)
    assert (whole.day, whole.tool, whole.arm_serial, whole.emulated) == (DAY, "gripper", "arm-1", False)
    assert {code: n for code, n in whole.refusals.items() if n} == {"cable": 2, "lifted": 1, "other": 1}
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line.get("format") for line in lines] == [FORMAT, *[None] * 6]


def test_an_empty_gripper_and_more_poses_of_a_part_do_not_count(tmp_path: Path) -> None:
    found = WeighingDay.load(append(tmp_path, part(0.3), part(0.31, poses=2), part(0.0, is_something=False)))
    assert (found.weighings, found.mass_kg) == (1, 0.31)


@pytest.mark.parametrize("kept", [5, 300], ids=["half a header", "half a line"])
def test_what_a_power_failure_cut_off_is_removed(tmp_path: Path, kept: int) -> None:
    os.truncate(append(tmp_path, part(0.1), part(0.2)), kept)
    found = WeighingDay.load(append(tmp_path, part(0.3)))
    assert found.mass_kg == 0.3
    assert found.weighings == (1 if kept == 5 else 2)


def test_damage_is_refused(tmp_path: Path) -> None:
    path = append(tmp_path, part(0.1), part(0.2))
    text = path.read_text()
    for damaged, words in (
        (text.replace("0.1", "0.7"), "line 2 of the weighings is damaged"),
        ("", "no weighings"),
        (text.split("\n", 1)[1], "'format' is missing"),
    ):
        path.write_text(damaged)
        with pytest.raises(BadDataset, match=words):
            WeighingDay.load(path)


def test_a_failed_write_leaves_the_file_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = append(tmp_path, part(0.1))
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        append(tmp_path, part(0.2))
    assert path.read_bytes() == before
