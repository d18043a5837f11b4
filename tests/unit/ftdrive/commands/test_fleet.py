"""`fleet add`, `remove`, `index` and `status` as commands, on run folders and an SQLite file."""

import json
import re
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rich.cells import cell_len

from ftcalib import CalibrationResult
from ftdrive.runs.run import RUN_FORMAT
from tests.unit.ftdrive.fleet.fleet_records import SIGMA
from tests.unit.ftdrive.store.run_folders import FIRST, new_run, result, verified

Ran = tuple[int, str, str]
NOW = datetime.now(UTC)
DAY = (NOW - FIRST).total_seconds() / 86400
"""Today, as `run_folders` counts days."""


@pytest.fixture
def run(run: Callable[..., Ran]) -> Callable[..., Ran]:
    return partial(run, "fleet")


@pytest.fixture
def cells(tmp_path: Path) -> Path:
    text = 'format = "ftdrive.cells/1"\n'
    for n, name in enumerate(("press", "lathe"), 1):
        config = f'format = "ftdrive.config/1"\n[robot]\nhost = "10.0.0.{n}"\n[tool]\nname = "gripper"\n'
        (tmp_path / f"{name}.toml").write_text(config)
        text += f'[cells.{name}]\nconfig = "{name}.toml"\nverify_every_days = 7\n'
    (path := tmp_path / "cells.toml").write_text(text)
    return path


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A calibration of the press 40 days ago, and 35 daily verifications, in which the force bias drifts."""
    folder = new_run(tmp_path / "runs", "calibrate", result(DAY - 40))
    header = {"format": RUN_FORMAT, "created_utc": FIRST.isoformat(), "config": {"robot": {"host": "10.0.0.1"}}}
    (folder / "run.json").write_text(json.dumps(header))
    made = CalibrationResult.load(folder / "calibration.json")
    rng = np.random.default_rng(0)
    for n in range(35):
        value = rng.normal(size=6) + np.eye(6)[1] * 3 * max(0, n - 15) / 7
        change = {"value": (SIGMA * value).tolist(), "sigma": SIGMA.tolist(), "calibration_sigma": SIGMA.tolist()}
        verified(new_run(tmp_path / "runs", f"verify-{n:02d}"), made.id, DAY - 35 + n, bias_change=change)
    return tmp_path / "runs"


def test_from_an_empty_store_to_a_status(run: Callable[..., Ran], cells: Path, runs: Path, tmp_path: Path) -> None:
    assert "No cells. `ftdrive fleet add cells.toml`" in run("status")[2]
    assert run("add", cells)[:2] == (0, f" 2 added, 0 replaced in {tmp_path}/data/ftdrive/store.sqlite\n")
    assert "0 added, 2 replaced" in run("add", cells)[1]
    assert run("index", runs)[1] == f" 1 result and 35 verifications added to {tmp_path}/data/ftdrive/store.sqlite\n"
    code, out, err = run("status")
    table, _, words = out.partition("\n2 cells: ")
    head, lathe, press = (re.split(r"\s{2,}", line.strip()) for line in table.splitlines())
    assert (code, head) == (0, ["cell", "tool", "verdict", "age", "verified", "drift, σ", "due"])
    assert lathe == ["lathe", "gripper", "none", "-", "-", "-", "now"]
    assert press[:5] == ["press", "gripper", "good", "40 d", "24 h"]
    assert re.fullmatch(r"\d\.\d DRIFTS", press[5])
    assert press[6] == "in 6 d"
    assert words.startswith("1 never calibrated, 1 drifting\n")
    assert "! lathe, gripper: never calibrated" in words
    assert "! press, gripper: force bias y drifts by 0.0" in words
    assert max(cell_len(line.rstrip()) for line in table.splitlines()) <= 80
    assert err == ""


def test_the_page_is_one_file_with_escaped_names(
    run: Callable[..., Ran], cells: Path, runs: Path, tmp_path: Path
) -> None:
    run("add", cells)
    run("index", runs)
    made = result(DAY - 1, tool="<b>drill")
    (folder := new_run(runs, "calibrate-2", made)).joinpath("run.json").write_text(
        json.dumps({"format": RUN_FORMAT, "config": {"robot": {"host": "10.0.0.2"}}})
    )
    run("index", folder)
    code, out, err = run("status", "--html", tmp_path / "fleet.html")
    page = (tmp_path / "fleet.html").read_text()
    assert (code, out, err) == (0, f" Saved {tmp_path}/fleet.html\n", "")
    assert page.count("<svg") == 1
    assert page.count("<polyline") == 6
    assert "press, gripper: force bias y drifts by" in page
    assert "&lt;b&gt;drill" in page
    assert "<b>drill" not in page
    assert not re.search(r"https?:|<script|<link|src=", page)
    assert run("status", "--html", tmp_path / "fleet.html")[0] == 2  # never overwritten


def test_cells_are_removed_by_name_all_or_none(run: Callable[..., Ran], cells: Path) -> None:
    run("add", cells)
    code, _, err = run("remove", "press", "drill")
    assert (code, "has no cell drill: the cells are lathe and press" in err) == (2, True)
    assert "1 removed" in run("remove", "press")[1]
    assert [one["cell"] for one in json.loads(run("status", "--json")[1])["cells"]] == ["lathe"]
    assert "has no cell press: the cells are lathe" in run("remove", "press")[2]


def test_a_cell_that_is_like_a_stored_one_is_refused(run: Callable[..., Ran], cells: Path, tmp_path: Path) -> None:
    run("add", cells)
    other = tmp_path / "more.toml"
    other.write_text(
        'format = "ftdrive.cells/1"\n[cells.twin]\nconfig = "press.toml"\nverify_every_days = 1\n'
        '[cells.mill]\nconfig = "press.toml"\nverify_every_days = 1\narm_serial = "5"\n'
    )
    code, _, err = run("add", other)
    assert (code, "the cells twin and press have the same [robot] host 10.0.0.1" in err) == (2, True)
    assert len(json.loads(run("status", "--json")[1])["cells"]) == 2
