"""Calls on workers that may die; here the workers are threads, or futures that are done at once."""

from collections import Counter
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from typing import Any

import pytest

from ftdrive.errors import ConfigError
from ftdrive.fleet import workers
from ftdrive.fleet.workers import (
    SAME,
    WorkerDied,
    Workers,
    _require_same_versions,
    answers,
    cluster_workers,
)
from ftdrivers.errors import StreamBroken

ITEMS = [Path(f"run-{number}") for number in range(40)]


def name_of(item: Path) -> bytes:
    return item.name.encode()


def test_a_lost_call_is_repeated_and_one_that_kills_two_workers_is_given_up() -> None:
    killer, companion, *rest = ITEMS
    deaths, calls = {killer: 99, companion: 1}, Counter[Path]()

    def submit(function: Any, item: Path) -> "Future[bytes]":
        calls[item] += 1
        future = Future[bytes]()
        if calls[item] <= deaths.get(item, 0):
            future.set_exception(BrokenExecutor())
        else:
            future.set_result(function(item))
        return future

    found = dict(answers(lambda item: (name_of, item), ITEMS, Workers(2, submit, BrokenExecutor)))
    assert isinstance(found.pop(killer), WorkerDied)
    assert found == {item: name_of(item) for item in ITEMS if item != killer}
    assert calls == {killer: 2, companion: 2} | dict.fromkeys(rest, 1)


def test_a_call_that_no_worker_is_left_for_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "CHECK_S", 0.0)
    left = iter([True, True])

    def require_one() -> None:
        if not next(left, False):
            raise StreamBroken("the cluster has no worker left", "start one")

    endless = Workers(1, lambda *_: Future[bytes](), BrokenExecutor, require_one=require_one)
    with pytest.raises(StreamBroken, match="no worker left"):
        list(answers(lambda item: (name_of, item), ITEMS, endless))


@pytest.mark.parametrize("address", ["tcp://host:8786", "dask://host", "dask://:8786", "dask://a@b:1", "host:8786"])
def test_an_address_of_another_form_is_refused_without_connecting(address: str) -> None:
    with pytest.raises(ConfigError, match=r"dask://host:8786"), cluster_workers(address):
        pass


@pytest.mark.parametrize(("name", "other", "words"), [("ftdrive", None, r"\(none\)"), ("numpy", "1.0", r"1\.0")])
def test_a_worker_of_another_version_is_refused(name: str, other: str | None, words: str) -> None:
    ours = dict.fromkeys(SAME, "9.9")
    found: dict[str, Any] = {
        "client": {"packages": ours},
        "workers": {"tcp://a:1": {"packages": ours}, "tcp://b:2": {"packages": {**ours, name: other}}},
    }
    with pytest.raises(ConfigError, match=rf"tcp://b:2 .* has {name} {words}, .* 9\.9: install {name} 9\.9"):
        _require_same_versions(found, "dask://c:3")
    del found["workers"]["tcp://b:2"]
    _require_same_versions(found, "dask://c:3")
