"""A store in an SQLite file: locked, read-only, missing, or no store at all. Each failure is one sentence."""

import os
import sqlite3
from pathlib import Path

import pytest

from ftdrive.errors import BadStore
from ftdrive.store.store import Store


def store_in(folder: Path) -> Store:
    return Store(f"sqlite:///{folder / 'store.sqlite'}", wait_s=0.05)


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


def test_another_file_is_no_store_and_stays_as_it_is(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "store.sqlite").write_text("my notes " * 1000)
    for act in (lambda: store_in(tmp_path).index(runs), store_in(tmp_path).results):
        with pytest.raises(BadStore, match="not a database"):
            act()
    assert (tmp_path / "store.sqlite").read_text() == "my notes " * 1000
