"""The store: it is rebuilt from run folders, two writers lose nothing, and its failures are one sentence each."""

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from ftdrive.errors import BadStore, ConfigError
from ftdrive.store.database import default_file
from ftdrive.store.store import Store
from ftdrive.store.tables import SCHEMA
from tests.unit.ftdrive.store.run_folders import new_run, result, verified


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Three runs, one with an update of the second, and a verification."""
    runs = tmp_path / "runs"
    found = [result(day) for day in (0, 30, 60)]
    for day, one in enumerate(found):
        new_run(runs, f"2026-03-0{day + 1}-calibrate", one)
    update = result(31, parent={"id": found[1].id, "path": "p"}, update="bias", temperature_C=25)
    verified(new_run(runs, "2026-04-01-verify", update), found[1].id, 31, passed=False)
    verified(new_run(runs, "2026-04-02-verify"), found[1].id, 32)
    (runs / "notes").mkdir()
    return runs


def store_in(folder: Path) -> Store:
    return Store(f"sqlite:///{folder / 'store.sqlite'}", wait_s=0.05)


def dump(folder: Path) -> list[str]:
    """Everything in the database, as text."""
    with sqlite3.connect(folder / "store.sqlite") as connection:
        lines = sorted(connection.iterdump())
    connection.close()
    return lines


def test_what_the_files_say_comes_back(runs: Path, tmp_path: Path) -> None:
    store = store_in(tmp_path)
    indexed = store.index(runs)
    assert (indexed.results, indexed.verifications, indexed.unreadable) == (4, 2, ())
    found = store.results()
    assert [one.run for one in found] == [
        "2026-03-01-calibrate",
        "2026-03-02-calibrate",
        "2026-04-01-verify",
        "2026-03-03-calibrate",
    ]
    truth, one = result(31), found[2]
    assert (one.id, one.tool, one.arm_serial, one.sensor_serial, one.mount) == (
        truth.id,
        "gripper",
        "arm-1",
        "ft-1",
        None,
    )
    assert (one.parent, one.update, one.temperature_C) == (found[1].id, "bias", 25.0)
    assert one.dataset_sha256 == truth.provenance["dataset_sha256"]
    assert one.created_utc == "2026-04-01T00:00:00.000000+00:00"
    np.testing.assert_array_equal(one.covariance, truth.covariance)
    assert not one.parameters.difference(truth.parameters).any()
    assert one.mass_kg == truth.mass_kg
    assert [check.passed for check in store.verifications(found[1].id)] == [False, True]
    last = store.last_verification(found[1].id)
    assert last is not None
    assert (last.passed, last.run) == (True, "2026-04-02-verify")
    assert store.last_verification(found[0].id) is None
    assert store.find(one.id[:6]) == [one]
    assert (store.results("other"), store.find("%")) == ([], [])


def test_rebuilt_twice_it_is_identical_and_the_same_as_one_that_grew(runs: Path, tmp_path: Path) -> None:
    """Runs arrive in any order, one of them as a copy of another, and are indexed again and again."""
    shutil.copytree(runs / "2026-03-03-calibrate", runs / "2026-01-01-copy")
    grown, rebuilt = tmp_path / "grown", tmp_path / "rebuilt"
    for folder in (grown, rebuilt):
        folder.mkdir()
    for run in sorted(runs.iterdir(), reverse=True):
        store_in(grown).index(run)
        store_in(grown).index(run)
    store_in(rebuilt).rebuild(runs)
    first = dump(rebuilt)
    store_in(rebuilt).rebuild()
    assert dump(rebuilt) == first == dump(grown)
    assert sum("INSERT" in line for line in first) == 1 + 1 + 4 + 2  # with two of the version


def test_a_deleted_run_is_forgotten_and_a_moved_one_is_followed(runs: Path, tmp_path: Path) -> None:
    store = store_in(tmp_path)
    store.index(runs)
    shutil.rmtree(runs / "2026-03-01-calibrate")
    (runs / "2026-03-02-calibrate").rename(runs / "renamed")
    store.index(runs)
    assert [one.run for one in store.results()][:2] == ["2026-03-01-calibrate", "renamed"]
    store.rebuild()
    assert [one.run for one in store.results()] == ["renamed", "2026-04-01-verify", "2026-03-03-calibrate"]


def test_runs_that_cannot_be_reached_are_kept(runs: Path, tmp_path: Path) -> None:
    store = store_in(tmp_path)
    store.index(runs)
    runs.rename(tmp_path / "unmounted")
    store.rebuild()
    assert len(store.results()) == 4


def test_a_damaged_file_is_named_and_costs_only_itself(runs: Path, tmp_path: Path) -> None:
    (runs / "2026-03-01-calibrate" / "calibration.json").write_text("{")
    (runs / "2026-03-02-calibrate" / "run.json").write_text("{")
    (runs / "2026-04-02-verify" / "verification.json").write_text('{"format": "ftdrive.verification/9"}')
    verified(runs / "2026-03-03-calibrate", "", 3)
    store = store_in(tmp_path)
    indexed = store.index(runs)
    assert (indexed.results, indexed.verifications) == (3, 1)
    assert ["calibration.json" in indexed.unreadable[0], len(indexed.unreadable)] == [True, 3]
    assert "version '9'" in indexed.unreadable[2]
    (runs / "2026-03-01-calibrate" / "calibration.json").unlink()
    result(0).save(runs / "2026-03-01-calibrate" / "calibration.json")
    assert store.index(runs).results == 1


_WRITER = """
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from ftdrive.store.store import Store
store = Store(sys.argv[1], wait_s=30)
for run in sorted(Path(sys.argv[2]).iterdir()):
    store.index(run)
"""


def runs_of_two_writers(folder: Path, n: int) -> str:
    """Each has its own runs, and one that both have; returns the address of the store."""
    for writer in "ab":
        for k in range(n):
            new_run(folder / writer, f"{k:02d}", result(1000 * (writer == "b") + k))
        new_run(folder / writer, "shared", result(5000))
    return f"sqlite:///{folder / 'store.sqlite'}"


def require_whole(folder: Path, n: int) -> None:
    store = store_in(folder)
    assert len(store.results()) == 2 * n + 1
    before = dump(folder)
    store.rebuild()
    assert dump(folder) == before


def test_two_connections_at_once_lose_nothing(tmp_path: Path) -> None:
    url = runs_of_two_writers(tmp_path, 6)

    def write(writer: str) -> None:
        for run in sorted((tmp_path / writer).iterdir()):
            Store(url, wait_s=30).index(run)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(write, "ab"))
    require_whole(tmp_path, 6)


@pytest.mark.slow
def test_two_processes_at_once_lose_nothing(tmp_path: Path) -> None:
    url = runs_of_two_writers(tmp_path, 25)
    command = [sys.executable, "-c", _WRITER, url]
    processes = [subprocess.Popen([*command, tmp_path / writer]) for writer in "ab"]
    assert [process.wait() for process in processes] == [0, 0]
    require_whole(tmp_path, 25)


def test_a_locked_store_is_one_sentence_and_is_caught_up_later(runs: Path, tmp_path: Path) -> None:
    store = store_in(tmp_path)
    store.index(runs / "2026-03-01-calibrate")
    other = sqlite3.connect(tmp_path / "store.sqlite")
    other.execute("BEGIN EXCLUSIVE")
    for act in (lambda: store.index(runs), store.results):
        with pytest.raises(BadStore, match=r"store\.sqlite cannot be .*\(database is locked\): check"):
            act()
    other.close()
    store.index(runs)
    assert len(store.results()) == 4


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is read-only for root")
def test_a_read_only_store_can_be_read(runs: Path, tmp_path: Path) -> None:
    store = store_in(tmp_path)
    store.index(runs / "2026-03-01-calibrate")
    (tmp_path / "store.sqlite").chmod(0o444)
    assert len(store.results()) == 1
    with pytest.raises(BadStore, match="readonly"):
        store.index(runs)


def test_a_store_opened_read_only_is_one_sentence(runs: Path, tmp_path: Path) -> None:
    store_in(tmp_path).index(runs / "2026-03-01-calibrate")
    read_only = Store(f"sqlite:///file:{tmp_path / 'store.sqlite'}?mode=ro&uri=true")
    assert len(read_only.results()) == 1
    with pytest.raises(BadStore, match=r"cannot be written \(attempt to write a readonly database\)"):
        read_only.index(runs)


def test_a_missing_store_is_empty_and_reading_does_not_create_it(tmp_path: Path) -> None:
    store = Store(f"sqlite:///{tmp_path / 'new' / 'store.sqlite'}")
    assert (store.results(), store.verifications(), store.find("ab")) == ([], [], [])
    assert not (tmp_path / "new").exists()
    store.index(new_run(tmp_path / "runs", "a", result()))
    assert len(store.results()) == 1


@pytest.mark.parametrize(("version", "fix"), [(SCHEMA + 1, "newer ftdrive"), (SCHEMA - 1, "history --index")])
def test_another_version_is_neither_read_nor_changed(version: int, fix: str, runs: Path, tmp_path: Path) -> None:
    store = store_in(tmp_path)
    store.index(runs)
    with sqlite3.connect(tmp_path / "store.sqlite") as connection:
        connection.execute("UPDATE ftdrive_schema SET version = ?", [version])
    connection.close()
    before = dump(tmp_path)
    for act in (lambda: store.rebuild(runs), store.results):
        with pytest.raises(BadStore, match=rf"has version {version}.*{fix}"):
            act()
    assert dump(tmp_path) == before


def test_another_file_is_no_store_and_stays_as_it_is(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "store.sqlite").write_text("my notes " * 1000)
    for act in (lambda: store_in(tmp_path).index(runs), store_in(tmp_path).results):
        with pytest.raises(BadStore, match="not a database"):
            act()
    assert (tmp_path / "store.sqlite").read_text() == "my notes " * 1000


def test_a_folder_that_cannot_be_made_is_one_sentence(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BadStore, match="cannot be written"):
        Store(f"sqlite:///{tmp_path / 'file' / 'store.sqlite'}").index(runs)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("store.sqlite", "no address of a database"),
        ("sqlite+none:////data/store", "no address of a database"),
        ("mysql://lab:secret@host/db", "begins with mysql: give sqlite"),
        ("postgresql+psycopg://lab:secret@host/db", "needs the package psycopg"),
    ],
)
def test_an_address_that_cannot_be_used_is_named_without_its_password(
    url: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)  # as if it were not installed
    with pytest.raises(ConfigError, match=words) as error:
        Store(url)
    assert "secret" not in str(error.value)


def test_the_default_is_a_file_of_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    Store().index(new_run(tmp_path / "runs", "a", result()))
    assert default_file() == tmp_path / "data" / "ftdrive" / "store.sqlite"
    assert default_file().is_file()
    monkeypatch.setenv("XDG_DATA_HOME", "relative")
    assert default_file().is_relative_to(Path.home())


def test_a_run_that_names_nothing_still_counts(tmp_path: Path) -> None:
    """A result solved elsewhere and put into a run: its tool comes from the run's configuration."""
    folder = new_run(tmp_path, "a")
    (folder / "run.json").write_text(
        json.dumps(
            {
                "format": "ftdrive.run/1",
                "created_utc": "2026-05-01T10:00:00+02:00",
                "config": {"tool": {"name": "drill"}, "sensor": {"mount": "left"}},
                "devices": {"arm": {"serial": "arm-9"}, "sensor": {"serial": "ft-9"}},
            }
        )
    )
    document = result().to_dict() | {"provenance": {"update": 5, "parent": [], "temperature_C": "warm", "setup": None}}
    (folder / "calibration.json").write_text(json.dumps(document))
    store = store_in(tmp_path)
    store.index(folder)
    (one,) = store.results("drill")
    assert (one.arm_serial, one.sensor_serial, one.mount) == ("arm-9", "ft-9", "left")
    assert one.created_utc == "2026-05-01T08:00:00.000000+00:00"
    assert (one.parent, one.update, one.temperature_C, one.dataset_sha256) == (None, None, None, None)


@pytest.mark.slow
def test_a_csv_is_solved_without_the_database(tmp_path: Path) -> None:
    """And so is everything else imported that does not look up or index a result."""
    rows = "".join(f"0.{k},0.{k}{7 * k % 10},-0.{9 - k},{k},{-k},9.8,0.1,0.{k},0\n" for k in range(1, 10))
    (tmp_path / "poses.csv").write_text("rx,ry,rz,fx,fy,fz,tx,ty,tz\n" + rows)
    code = (
        "import sys, ftdrive.live.stream, ftdrive.commands.live, ftdrive.commands.history\n"
        "from ftdrive.cli import run\n"
        "code = run(['solve', 'poses.csv'])\n"
        "sys.exit('sqlalchemy is imported' if 'sqlalchemy' in sys.modules else code not in (0, 7))\n"
    )
    outcome = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stderr
