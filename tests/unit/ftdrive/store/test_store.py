"""The store on SQLite and on PostgreSQL: what the files say comes back, and it is rebuilt from them."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import text

from ftdrive.errors import ConfigError
from ftdrive.store.records import StoredCell
from ftdrive.store.store import Store
from tests.postgres import Server
from tests.unit.ftdrive.store.contents import connected, dump, wipe
from tests.unit.ftdrive.store.run_folders import FIRST, new_run, result, verified

CELL = StoredCell(
    name="a",
    config="/cells/a.toml",
    verify_every_days=0.1 + 0.2,
    arm_serial=None,
    robot_host="10.0.0.7",
    sensor_url="ati-can://can0",
    tool="gripper",
)


def test_what_the_files_say_comes_back(runs: Path, store_url: str) -> None:
    store = Store(store_url)
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


@pytest.mark.slow
def test_rebuilt_twice_it_is_identical_and_the_same_as_one_that_grew(runs: Path, store_url: str) -> None:
    """Runs arrive in any order, one of them as a copy of another, and are indexed again and again."""
    shutil.copytree(runs / "2026-03-03-calibrate", runs / "2026-01-01-copy")
    for run in sorted(runs.iterdir(), reverse=True):
        Store(store_url).index(run)
        Store(store_url).index(run)
    grown = dump(store_url)
    wipe(store_url)
    Store(store_url).rebuild(runs)
    rebuilt = dump(store_url)
    Store(store_url).rebuild()
    assert dump(store_url) == rebuilt == grown
    assert len(grown) == 4 + 2 + 1  # one row has the version


@pytest.mark.slow
def test_it_is_the_same_in_every_database_whatever_its_order_of_texts(
    runs: Path, tmp_path: Path, postgres: Server
) -> None:
    """In English "a" comes before "B", in bytes after it: the first by path is the same everywhere."""
    for name in ("a", "B"):
        shutil.copytree(runs / "2026-03-01-calibrate", runs / name)
    (runs / "2026-03-01-calibrate" / "calibration.json").unlink()
    english = postgres.new_database("TEMPLATE template0 LOCALE_PROVIDER icu ICU_LOCALE 'en'")
    urls = [postgres.url(english), f"sqlite:///{tmp_path / 'store.sqlite'}"]
    for url in urls:
        for run in ("a", "B", "."):
            Store(url).index(runs / run)
        assert Store(url).results()[0].run == "B"
    assert dump(urls[0]) == dump(urls[1])


def test_runs_that_cannot_be_reached_are_kept(runs: Path, store_url: str, tmp_path: Path) -> None:
    store = Store(store_url)
    store.index(runs)
    runs.rename(tmp_path / "unmounted")
    store.rebuild()
    assert len(store.results()) == 4


def test_a_damaged_file_is_named_and_costs_only_itself(runs: Path, store_url: str) -> None:
    (runs / "2026-03-01-calibrate" / "calibration.json").write_text("{")
    (runs / "2026-03-02-calibrate" / "run.json").write_text("{")
    verified(runs / "2026-03-02-calibrate", "abc", 3, reason="a \0 and half a \ud800 pair")
    (runs / "2026-04-02-verify" / "verification.json").write_text('{"format": "ftdrive.verification/9"}')
    verified(runs / "2026-03-03-calibrate", "", 3)
    store = Store(store_url)
    indexed = store.index(runs)
    assert (indexed.results, indexed.verifications) == (3, 2)
    assert store.verifications("abc")[0].reason == "a \ufffd and half a ? pair"
    assert ["calibration.json" in indexed.unreadable[0], len(indexed.unreadable)] == [True, 3]
    assert "version '9'" in indexed.unreadable[2]
    (runs / "2026-03-01-calibrate" / "calibration.json").unlink()
    result(0).save(runs / "2026-03-01-calibrate" / "calibration.json")
    assert store.index(runs).results == 1


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("store.sqlite", "is not a database address"),
        ("sqlite+none:////data/store", "is not a database address"),
        ("postgresql+psycopg://lab:secret@host:port/db", "is not a database address"),
        ("mysql://lab:secret@host/db", "begins with mysql: give sqlite"),
        ("postgresql+psycopg://lab:secret@host/db", "needs psycopg"),
    ],
)
def test_an_address_that_cannot_be_used_is_named_without_its_password(
    url: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)  # as if it were not installed
    with pytest.raises(ConfigError, match=words) as error:
        Store(url)
    assert "secret" not in str(error.value)


def test_a_run_that_names_nothing_still_counts(store_url: str, tmp_path: Path) -> None:
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
    store = Store(store_url)
    store.index(folder)
    (one,) = store.results("drill")
    assert (one.arm_serial, one.sensor_serial, one.mount) == ("arm-9", "ft-9", "left")
    assert (one.arm_model, one.robot_host, one.payload_kg, one.payload_com_m) == (None, None, None, None)
    assert one.created_utc == "2026-05-01T08:00:00.000000+00:00"
    assert (one.parent, one.update, one.temperature_C, one.dataset_sha256) == (None, None, None, None)


def test_the_newest_are_selected_by_time_in_any_zone(store_url: str, tmp_path: Path) -> None:
    """A record without a time is the oldest."""
    for day in range(4):
        verified(new_run(tmp_path, f"{day}", result(day)), "abc", day)
    verified(new_run(tmp_path, "no-time"), "abc", 9, created_utc=None)
    store = Store(store_url)
    store.index(tmp_path)
    since = (FIRST + timedelta(days=2)).astimezone(timezone(timedelta(hours=-9)))
    assert store.fleet(1, since)[2] == store.verifications()[3:]
    assert [one.run for one in store.verifications()] == ["no-time", "0", "1", "2", "3"]


def test_cells_are_replaced_by_name_and_survive_a_rebuild(store_url: str, runs: Path) -> None:
    store = Store(store_url)
    assert store.cells() == []
    cells = [replace(CELL, name=name, config=f"/cells/{name}.toml") for name in ("b", "Ä", "a", "B")]
    store.put_cells(cells)
    other = replace(cells[2], config="/elsewhere.toml", arm_serial="7", tool=None)
    store.put_cells([other])
    store.put_cells([])
    store.rebuild(runs)
    assert store.cells() == [cells[3], other, cells[0], cells[1]]
    store.remove_cells(["a", "c", "Ä"])
    assert store.cells() == [cells[3], cells[0]]


def test_an_older_index_is_built_again_from_its_runs_and_cells_are_kept(store_url: str, runs: Path) -> None:
    Store(store_url).index(runs)
    Store(store_url).put_cells([CELL])
    before = dump(store_url)
    with connected(store_url) as connection:
        connection.execute(text("UPDATE ftdrive_schema SET version = 1"))
        connection.execute(text("ALTER TABLE ftdrive_results DROP COLUMN arm_model"))
    assert len(Store(store_url).results()) == 4
    assert dump(store_url) == before


@pytest.mark.slow
def test_a_csv_is_solved_without_the_database(tmp_path: Path) -> None:
    """And so is everything else imported that does not look up or index a result."""
    rows = "".join(f"0.{k},0.{k}{7 * k % 10},-0.{9 - k},{k},{-k},9.8,0.1,0.{k},0\n" for k in range(1, 10))
    (tmp_path / "poses.csv").write_text("rx,ry,rz,fx,fy,fz,tx,ty,tz\n" + rows)
    code = (
        "import sys, ftdrive.stream.stream, ftdrive.commands.live, ftdrive.commands.history\n"
        "from ftdrive.cli import run\n"
        "code = run(['solve', 'poses.csv'])\n"
        "sys.exit('sqlalchemy is imported' if 'sqlalchemy' in sys.modules else code not in (0, 7))\n"
    )
    outcome = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stderr
