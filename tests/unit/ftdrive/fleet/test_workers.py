"""Calls on workers that may die; here the workers are threads, or futures that are done at once."""

from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from ftcalib.errors import BadDataset
from ftdrive.errors import ConfigError
from ftdrive.fleet import workers
from ftdrive.fleet.workers import SAME, Answer, WorkerDied, Workers, _require_same_versions, answers, cluster_workers
from ftdrivers.errors import StreamBroken

ITEMS = [Path(f"run-{number}") for number in range(40)]


def name_of(item: Path) -> bytes:
    return item.name.encode()


def own(item: Path) -> tuple[Path]:
    return (item,)


def test_few_arguments_are_in_memory_at_a_time() -> None:
    made = received = most = 0

    def counted(item: Path) -> tuple[Path]:
        nonlocal made, most
        made += 1
        most = max(most, made - received)
        return (item,)

    found = {}
    with ThreadPoolExecutor(2) as threads:
        for item, answer in answers(name_of, counted, ITEMS, Workers(2, threads.submit, BrokenExecutor)):
            received += 1
            found[item] = answer
    assert found == {item: name_of(item) for item in ITEMS}
    assert most == 4


class FragileWorkers:
    """Its workers die of some items always, and of others on the first calls."""

    def __init__(self, deaths: dict[Path, int]) -> None:
        self.deaths = deaths
        self.calls = Counter[Path]()

    def submit(self, each: Any, function: Any, calls: Sequence[tuple[Path]]) -> "Future[list[Answer]]":
        self.calls.update(item for (item,) in calls)
        future = Future[list[Answer]]()
        if any(self.calls[item] <= self.deaths.get(item, 0) for (item,) in calls):
            future.set_exception(BrokenExecutor())
        else:
            future.set_result(each(function, calls))
        return future


@pytest.mark.parametrize("group", [1, 4])
def test_a_lost_call_is_repeated_and_one_that_kills_three_workers_is_given_up(group: int) -> None:
    killer, late, companion, fourth, *rest = ITEMS
    fragile = FragileWorkers({killer: 99, late: 2, companion: 1})
    found = dict(answers(name_of, own, ITEMS, Workers(2, fragile.submit, BrokenExecutor, group)))
    assert isinstance(found.pop(killer), WorkerDied)
    assert found == {item: name_of(item) for item in ITEMS if item != killer}
    repeated = {killer: 3, late: 3, companion: 2, fourth: 1 if group == 1 else 2}
    assert fragile.calls == repeated | dict.fromkeys(rest, 1)


def test_workers_that_break_while_a_call_is_submitted_lose_only_time() -> None:
    broken = iter([True, False, True])

    def submit(each: Any, function: Any, calls: Any) -> "Future[list[Answer]]":
        if next(broken, False):
            raise BrokenExecutor
        future = Future[list[Answer]]()
        future.set_result(each(function, calls))
        return future

    assert dict(answers(name_of, own, ITEMS, Workers(1, submit, BrokenExecutor))) == {i: name_of(i) for i in ITEMS}


def test_a_call_that_no_worker_is_left_for_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "CHECK_S", 0.0)
    left = iter([True, True])

    def require_one() -> None:
        if not next(left, False):
            raise StreamBroken("the cluster has no worker any more", "start one")

    endless = Workers(1, lambda *_: Future[list[Answer]](), BrokenExecutor, require_one=require_one)
    with pytest.raises(StreamBroken, match="no worker any more"):
        list(answers(name_of, own, ITEMS, endless))


@pytest.mark.parametrize("group", [1, 4])
def test_an_error_concerns_one_item(group: int) -> None:
    damaged, impossible, *_ = ITEMS

    def arguments(item: Path) -> Iterable[Path]:
        if item == damaged:
            raise BadDataset("damaged")
        return (item,)

    def called(item: Path) -> bytes:
        if item == impossible:
            raise ZeroDivisionError
        return name_of(item)

    with ThreadPoolExecutor(1) as threads:
        found = dict(answers(called, arguments, ITEMS, Workers(1, threads.submit, BrokenExecutor, group)))
    assert isinstance(found.pop(damaged), BadDataset)
    assert isinstance(found.pop(impossible), ZeroDivisionError)
    assert found == {item: name_of(item) for item in ITEMS[2:]}


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
