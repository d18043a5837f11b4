"""Weighings reach the file and the store; outages of either are reported once, and nothing is lost."""

import shutil
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from ftdrive.runs.weighings import append_weighings
from ftdrive.store.store import Store
from ftdrive.store.weighing_log import WeighingLog
from tests.unit.ftdrive.store.contents import connected

ORIGIN = {
    "tool": "gripper",
    "calibration_id": "7c1e9a03f5d2",
    "arm_serial": "arm-1",
    "sensor_serial": "ft-1",
    "robot_host": "10.0.0.7",
    "emulated": False,
}
NOON = datetime(2026, 11, 26, 12, tzinfo=UTC)


def part(mass_kg: float) -> dict[str, Any]:
    return {"mass_kg": mass_kg, "mass_sigma_kg": 1e-3, "is_something": True, "poses": 1}


class Logs:
    """Opens logs of one folder at times that a test sets."""

    def __init__(self, folder: Path, url: str) -> None:
        self.folder, self.url = folder, url
        self.said: list[str] = []

    def write(self, *entries: float | str, times: Iterator[datetime] | None = None, **origin: Any) -> None:
        """Keep masses in kg and codes of refusals, then close."""
        clock = times or (NOON + timedelta(seconds=5 * n) for n in range(100))
        log = WeighingLog({**ORIGIN, **origin}, self.url, self.said.append, folder=self.folder, now=lambda: next(clock))
        for one in entries:
            log.keep({"refused": one} if isinstance(one, str) else part(one))
        log.close()


@pytest.fixture
def logs(tmp_path: Path, store_url: str) -> Logs:
    return Logs(tmp_path / "weighings", store_url)


def test_the_last_weighing_and_the_counts_of_its_day_come_back(logs: Logs) -> None:
    logs.write(0.1, times=iter([NOON - timedelta(days=1)]))
    logs.write(0.25, "cable", 0.3, "cable", "lifted")
    logs.write(0.7, tool="drill")
    logs.write(0.31, times=iter([NOON + timedelta(hours=1)]), calibration_id="b7431b000000")
    logs.write(9.9, emulated=True)
    store = Store(logs.url)
    gripper, emulated = sorted(store.last_weighings("2026-11-01", "gripper"), key=lambda one: one.emulated)
    assert (gripper.day, gripper.weighings, gripper.mass_kg, gripper.mass_sigma_kg) == ("2026-11-26", 3, 0.31, 1e-3)
    assert gripper.last_utc == "2026-11-26T13:00:00.000000+00:00"
    assert {code: n for code, n in gripper.refusals.items() if n} == {"cable": 2, "lifted": 1}
    assert (emulated.mass_kg, emulated.weighings) == (9.9, 1)
    assert {one.tool for one in store.last_weighings("2026-11-01")} == {"gripper", "drill"}
    assert store.last_weighings("2026-11-27") == []
    days = store.weighings(3, "gripper")
    assert [(one.day, one.mass_kg) for one in days][-1] == ("2026-11-26", 0.31)
    assert len(days) == 3
    assert logs.said == []


def test_a_day_ends_at_midnight(logs: Logs) -> None:
    logs.write(0.1, 0.2, 0.3, times=iter(NOON + timedelta(hours=6 * n) for n in range(3)))
    assert [(one.day, one.weighings) for one in Store(logs.url).weighings(9)] == [("2026-11-26", 2), ("2026-11-27", 1)]


def test_an_index_without_weighings_is_replaced(logs: Logs) -> None:
    logs.write(0.1)
    with connected(logs.url) as connection:
        connection.exec_driver_sql("UPDATE ftdrive_schema SET version = 3")
        connection.exec_driver_sql("DROP TABLE ftdrive_weighings")
    assert Store(logs.url).weighings(9) == []
    logs.write(0.2)
    assert Store(logs.url).weighings(9)[0].weighings == 2


def test_a_store_that_cannot_be_written_is_reported_once_and_caught_up(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    down = Logs(tmp_path / "weighings", f"sqlite:///{tmp_path}/file/store.sqlite")
    log = WeighingLog(ORIGIN, down.url, down.said.append, folder=down.folder, every_s=0, now=lambda: NOON)
    for mass in range(5):
        log.keep(part(mass))
    log.close()
    assert len(down.said) == 1
    assert down.said[0].startswith(" Weighings are saved, but not yet in the history, because the store")
    up = Logs(down.folder, f"sqlite:///{tmp_path}/store.sqlite")
    up.write("cable", times=iter([NOON + timedelta(days=1)]))
    assert [one.weighings for one in Store(up.url).weighings(9)] == [5, 0]
    assert up.said == []


def test_lines_wait_for_a_disk_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    logs = Logs(tmp_path / "weighings", f"sqlite:///{tmp_path}/store.sqlite")
    failures = iter([True, True, False])

    def failing(*of: Any) -> Path:
        if next(failures, False):
            raise OSError(28, "No space left on device")
        return append_weighings(*of)

    monkeypatch.setattr("ftdrive.store.weighing_log.append_weighings", failing)
    for mass in (0.1, 0.2, 0.3):  # closed each time, so that the lines come one by one
        logs.write(mass)
    assert [one.weighings for one in Store(logs.url).weighings(9)] == [1]
    assert logs.said == [" Weighings are not saved, because [Errno 28] No space left on device."] * 2

    failures = iter([True, False])
    shutil.rmtree(logs.folder)
    reported = Event()
    log = WeighingLog(ORIGIN, logs.url, lambda _: reported.set(), folder=logs.folder, now=lambda: NOON)
    log.keep(part(0.4))
    assert reported.wait(30)
    log.keep(part(0.5))
    log.close()
    assert [one.weighings for one in Store(logs.url).weighings(9)] == [2]
