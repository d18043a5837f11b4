"""Several writers at once lose nothing."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import pytest

from ftdrive.store.store import Store
from tests.unit.ftdrive.store.contents import dump
from tests.unit.ftdrive.store.run_folders import new_run, result
from tests.unit.ftdrive.store.writers import write


def new_runs(folder: Path, writers: int, each: int) -> list[Path]:
    """Each writer has its own runs, and one that all have; returns their folders."""
    folders = [folder / str(writer) for writer in range(writers)]
    for writer, runs in enumerate(folders):
        for k in range(each):
            new_run(runs, f"{k:02d}", result(1000 * writer + k))
        new_run(runs, "shared", result(9000))
    return folders


def require_whole(url: str, n: int) -> None:
    store = Store(url)
    assert len(store.results()) == n
    assert store.results()[-1].path.endswith("/0/shared/calibration.json")
    before = dump(url)
    store.rebuild()
    assert dump(url) == before


@pytest.mark.slow
def test_two_connections_at_once_lose_nothing(store_url: str, tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(write, 2 * [store_url], new_runs(tmp_path, 2, 4)))
    require_whole(store_url, 2 * 4 + 1)


@pytest.mark.slow
def test_eight_processes_at_once_lose_nothing(store_url: str, tmp_path: Path) -> None:
    """They begin with a database that has no tables."""
    folders = new_runs(tmp_path, 8, 4)
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload([write.__module__])
    with ProcessPoolExecutor(8, mp_context=processes) as pool:
        list(pool.map(write, 8 * [store_url], folders))
    require_whole(store_url, 8 * 4 + 1)
