"""Stores of older and newer versions: what is upgraded, when, and that nothing is lost."""

import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import Connection, NullPool, create_engine, select, text

from ftdrive.errors import BadStore
from ftdrive.store import tables
from ftdrive.store.store import Store
from tests.unit.ftdrive.store.contents import columns, dump, wipe

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


@contextmanager
def connected(url: str) -> Iterator[Connection]:
    with create_engine(url, poolclass=NullPool).begin() as connection:
        yield connection


def become_version_1(url: str) -> None:
    """Replace the tables by those of version 1, with the same rows."""
    kept = {"ftdrive_results": tables.results, "ftdrive_verifications": tables.verifications}
    with connected(url) as connection:
        rows = {name: connection.execute(select(table)).mappings().all() for name, table in kept.items()}
    wipe(url)
    with connected(url) as connection:
        for statement in VERSION_1.split(";"):
            connection.execute(text(statement))
    known = columns(url)
    for name, table in kept.items():
        names = {one.split()[0] for one in known[name]}
        old = [{key: value for key, value in row.items() if key in names} for row in rows[name]]
        with connected(url) as connection:
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
        with pytest.raises(BadStore, match=r"has version 1, this ftdrive uses version 2: upgrade it with `ftdrive h"):
            act()
    assert (dump(store_url), columns(store_url)) == (before, built)


@pytest.mark.parametrize("version", [3, 99])
def test_a_newer_store_is_neither_read_nor_changed(version: int, store_url: str, runs: Path) -> None:
    store = Store(store_url)
    store.index(runs)
    with connected(store_url) as connection:
        connection.execute(tables.schema.update().values(version=version))
    before = dump(store_url)
    for act in (store.results, store.upgrade, lambda: store.index(runs), lambda: store.remove_cells(["a"])):
        with pytest.raises(BadStore, match=f"has version {version}, this ftdrive uses version 2: install a newer"):
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
