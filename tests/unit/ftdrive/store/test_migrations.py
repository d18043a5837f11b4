"""Stores of older and newer versions: what is upgraded, when, and that nothing is lost."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import select, text

from ftdrive import cli
from ftdrive.commands.common import index_run
from ftdrive.errors import BadStore
from ftdrive.store import tables
from ftdrive.store.store import Store
from tests.unit.ftdrive.store.contents import columns, connected, dump, wipe

VERSION_1 = """
CREATE TABLE ftdrive_schema (version INTEGER NOT NULL, PRIMARY KEY (version));
CREATE TABLE ftdrive_results (
  id VARCHAR NOT NULL, path VARCHAR NOT NULL, run VARCHAR NOT NULL, created_utc VARCHAR, tool VARCHAR,
  arm_serial VARCHAR, sensor_serial VARCHAR, mount VARCHAR, verdict VARCHAR NOT NULL, n_poses INTEGER NOT NULL,
  mass_kg FLOAT NOT NULL, g_m_s2 FLOAT NOT NULL, numbers JSON NOT NULL, dataset_sha256 VARCHAR, parent VARCHAR,
  "update" VARCHAR, "temperature_C" FLOAT, PRIMARY KEY (id));
CREATE INDEX ix_ftdrive_results_created_utc ON ftdrive_results (created_utc);
CREATE TABLE ftdrive_verifications (
  id VARCHAR NOT NULL, path VARCHAR NOT NULL, run VARCHAR NOT NULL, calibration_id VARCHAR NOT NULL,
  created_utc VARCHAR, passed BOOLEAN NOT NULL, change VARCHAR, reason VARCHAR, "temperature_C" FLOAT,
  PRIMARY KEY (id));
CREATE INDEX ix_ftdrive_verifications_calibration_id ON ftdrive_verifications (calibration_id);
INSERT INTO ftdrive_schema VALUES (1)
"""
"""As the first version of ftdrive with a store created it."""


def become_version_1(url: str) -> None:
    """Replace the tables by those of version 1, with the same rows."""
    kept = (tables.results, tables.verifications)
    with connected(url) as connection:
        rows = [connection.execute(select(table)).mappings().all() for table in kept]
    wipe(url)
    with connected(url) as connection:
        for statement in VERSION_1.split(";"):
            connection.execute(text(statement))
    known = columns(url)
    with connected(url) as connection:
        for table, found in zip(kept, rows, strict=True):
            names = {one[1] for one in known if one[0] == table.name}
            old = [{key: value for key, value in row.items() if key in names} for row in found]
            if old:
                connection.execute(table.insert(), old)


def require_same_tables(url: str) -> None:
    """Compare the tables with those that this version reads and writes."""
    with connected(url) as connection:
        context = MigrationContext.configure(connection, opts={"version_table": "ftdrive_alembic"})
        assert compare_metadata(context, tables.metadata) == []


def test_an_upgraded_store_is_one_that_was_built_by_this_version(store_url: str, runs: Path) -> None:
    store = Store(store_url)
    store.index(runs)
    before, built = dump(store_url), columns(store_url)
    require_same_tables(store_url)
    become_version_1(store_url)
    assert len(dump(store_url)) == len(before) - 1  # without the row of Alembic
    assert store.upgrade() == 1
    assert (dump(store_url), columns(store_url)) == (before, built)
    assert store.upgrade() is None


@pytest.mark.slow
def test_results_whose_files_are_gone_are_kept(store_url: str, runs: Path) -> None:
    store = Store(store_url)
    store.index(runs)
    become_version_1(store_url)
    shutil.rmtree(runs)
    store.upgrade()
    assert len(store.verifications()) == 2
    assert [one.arm_model for one in store.results()] == 4 * [None]
    assert [one.bias_change for one in store.verifications()] == 2 * [None]


def test_an_older_store_is_neither_read_nor_changed_before(store_url: str, runs: Path) -> None:
    store = Store(store_url)
    store.index(runs)
    become_version_1(store_url)
    before, built = dump(store_url), columns(store_url)
    for act in (store.results, store.cells, lambda: store.index(runs), lambda: store.rebuild(runs)):
        with pytest.raises(BadStore, match=r"has version 1, this ftdrive uses version 3: upgrade it with `ftdrive h"):
            act()
    assert (dump(store_url), columns(store_url)) == (before, built)


def test_a_newer_store_is_neither_read_nor_changed(store_url: str, runs: Path) -> None:
    store = Store(store_url)
    store.index(runs)
    with connected(store_url) as connection:
        connection.execute(tables.schema.update().values(version=4))
    before = dump(store_url)
    for act in (store.results, store.upgrade, lambda: store.index(runs), lambda: store.remove_cells(["a"])):
        with pytest.raises(BadStore, match="has version 4, this ftdrive uses version 3: install a newer"):
            act()
    assert dump(store_url) == before


def test_an_upgrade_that_fails_changes_nothing(store_url: str, runs: Path) -> None:
    """A table of another program has the name that the last step needs."""
    store = Store(store_url)
    store.index(runs)
    become_version_1(store_url)
    with connected(store_url) as connection:
        connection.execute(text("CREATE TABLE ftdrive_cells (name VARCHAR)"))
    before, built = dump(store_url), columns(store_url)
    with pytest.raises(BadStore, match=r"cannot be written .*ftdrive_cells"):
        store.upgrade()
    assert (dump(store_url), columns(store_url)) == (before, built)


@pytest.mark.slow
def test_upgrades_at_once_wait_for_each_other(store_url: str, runs: Path) -> None:
    store = Store(store_url)
    store.index(runs)
    before = dump(store_url)
    become_version_1(store_url)
    with ThreadPoolExecutor(3) as pool:
        versions = list(pool.map(lambda _: Store(store_url, wait_s=60).upgrade(), range(3)))
    assert set(versions) <= {1, None}
    assert dump(store_url) == before


def test_a_missing_or_empty_store_needs_no_upgrade(store_url: str, tmp_path: Path) -> None:
    assert Store(store_url).upgrade() is None
    assert not (tmp_path / "store.sqlite").exists()


def test_only_index_and_rebuild_upgrade_a_store(
    store_url: str, runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A calibration at its end prints the sentence and goes on; its run is caught up by the command in it."""
    Store(store_url).index(runs / "2026-03-01-calibrate")
    become_version_1(store_url)
    monkeypatch.setenv("FTDRIVE_STORE_URL", store_url)
    fix = "has version 1, this ftdrive uses version 3: upgrade it with `ftdrive history --index .`"
    assert cli.run(["history"]) == 6
    assert fix in " ".join(capsys.readouterr().err.split())
    index_run(runs / "2026-03-02-calibrate")
    assert fix in " ".join(capsys.readouterr().err.split())
    monkeypatch.chdir(runs)
    assert cli.run(["history", "--index", "."]) == 0
    out, err = capsys.readouterr()
    assert len(out.splitlines()) >= 1 + 4
    assert "is upgraded from version 1." in " ".join(err.split())
    become_version_1(store_url)
    assert cli.run(["history", "--rebuild", "--json", "--store", store_url]) == 0
    assert len(json.loads(capsys.readouterr().out)["results"]) == 4
