"""`fleet serve` as a process, and a fleet of 200 cells under a real Prometheus."""

import json
import re
import shutil
import signal
import subprocess
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
import yaml
from sqlalchemy import create_engine

from ftdrive.commands.fleet.serve import MONITORING
from ftdrive.fleet.metrics import MetricsServer
from ftdrive.fleet.serve import Reading
from ftdrive.fleet.state import Fleet
from ftdrive.fleet.status import fleet_state
from ftdrive.store import tables
from ftdrive.store.store import Store
from tests.mosquitto import Mosquitto, free_port
from tests.system.command_line import CommandLine, end_of, listen_for
from tests.unit.ftdrive.fleet import fleet_records
from tests.unit.ftdrive.fleet.fleet_records import SIGMA, cell, check, result, time
from tests.wire.waiting import wait_until

ALERTS = MONITORING / "alerts.yml"
CELLS = [f"cell-{n:03d}" for n in range(200)]
DRIFTING = {"cell-007", "cell-042", "cell-099", "cell-150", "cell-199"}
DAYS, DRIFT_DAYS = 365, 21
AXES = ("fx", "fy", "fz", "tx", "ty", "tz")


def simulate(url: str) -> Store:
    """Fill a store with a year of daily verifications; five sensors drift by one sigma a week in one component."""
    rng = np.random.default_rng(18)
    made, checks = list[dict[str, Any]](), list[dict[str, Any]]()
    usual = tables.to_row(check(result("", DAYS), 0))
    columns, times = [f"bias_change_{axis}" for axis in AXES], [time(DAYS - 1 - day) for day in range(DAYS)]
    for n, name in enumerate(CELLS):
        calibration = result(name, DAYS)
        made.append(tables.to_row(calibration))
        change = rng.normal(size=(DAYS, 6)) + rng.normal(size=6) / 2  # and the error of the calibration
        if name in DRIFTING:
            change[-DRIFT_DAYS:, n % 6] += np.arange(1, DRIFT_DAYS + 1) / 7
        for day, values in enumerate((SIGMA * change).tolist()):
            about = {"id": f"{n}-{day}", "path": f"{n}-{day}", "calibration_id": calibration.id}
            checks.append({**usual, **about, "created_utc": times[day], **dict(zip(columns, values, strict=True))})
    store = Store(url)
    store.put_cells(cell(name) for name in CELLS)
    with create_engine(url).begin() as connection:
        connection.execute(tables.results.insert(), made)
        connection.execute(tables.verifications.insert(), checks)
    return store


class Prometheus:
    """Prometheus with the rules of ftdrive, which scrapes and judges every second."""

    def __init__(self, url: str) -> None:
        self._url = url

    def asked(self, path: str) -> Any:
        with urllib.request.urlopen(f"{self._url}{path}", timeout=30) as answer:
            return json.loads(answer.read())["data"]

    def is_ready(self) -> bool:
        try:
            return bool(self.asked("/api/v1/status/runtimeinfo"))
        except OSError:
            return False

    def value(self, expression: str) -> float | None:
        found = self.asked(f"/api/v1/query?query={quote(expression)}")["result"]
        return float(found[0]["value"][1]) if found else None

    def alerts(self, cells: int) -> set[tuple[str, str]]:
        """Return name and cell of all that fire, judged after a scrape of so many cells."""
        wait_until(lambda: self.value("count(ftdrive_bias_drift_found)") == cells)
        scraped = self.value("vector(time())")
        assert scraped is not None
        wait_until(lambda: self._judged() > scraped)
        return {
            (one["labels"]["alertname"], one["labels"].get("cell", ""))
            for one in self.asked("/api/v1/alerts")["alerts"]
            if one["state"] == "firing"
        }

    def _judged(self) -> float:
        (group,) = self.asked("/api/v1/rules")["groups"]
        return datetime.fromisoformat(group["lastEvaluation"]).timestamp()


@contextmanager
def prometheus(folder: Path, port: int) -> Iterator[Prometheus]:
    program = shutil.which("prometheus")
    if program is None:
        pytest.skip("prometheus is not installed")
    configuration = {
        "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
        "rule_files": [str(ALERTS)],
        "scrape_configs": [{"job_name": "ftdrive", "static_configs": [{"targets": [f"127.0.0.1:{port}"]}]}],
    }
    (folder / "prometheus.yml").write_text(yaml.safe_dump(configuration))
    own = free_port()
    command = [program, f"--config.file={folder / 'prometheus.yml'}", f"--storage.tsdb.path={folder / 'data'}"]
    with (folder / "prometheus.log").open("w") as log:
        process = subprocess.Popen([*command, f"--web.listen-address=127.0.0.1:{own}"], stdout=log, stderr=log)
        try:
            found = Prometheus(f"http://127.0.0.1:{own}")
            wait_until(found.is_ready)
            yield found
        finally:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_the_alert_of_a_drift_fires_for_the_cells_that_drift_and_no_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = datetime.now(UTC)  # rules compare with the time of Prometheus
    monkeypatch.setattr(fleet_records, "NOW", now)
    state = fleet_state(simulate(f"sqlite:///{tmp_path / 'store.sqlite'}"), now)
    assert {one.cell for one in state.cells if one.drift and one.drift.found} == DRIFTING
    with closing(MetricsServer("127.0.0.1", 0)) as server:
        server.update(Reading(state, now, now))
        with prometheus(tmp_path, server.port) as found:
            assert found.alerts(200) == {("FtdriveBiasDrift", cell) for cell in DRIFTING}
            server.update(Reading(Fleet(state.cells[:100], ()), now, now))
            gone = {("FtdriveBiasDrift", cell) for cell in DRIFTING if cell < "cell-100"}
            assert found.alerts(100) == gone


@pytest.mark.slow
@pytest.mark.parametrize(("by", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_the_end_of_the_server_reaches_the_shop_floor(
    by: signal.Signals, code: int, tmp_path: Path, ftdrive: CommandLine
) -> None:
    with Mosquitto(tmp_path, user="cell", password="top-secret") as mosquitto:

        def is_online() -> bool:
            found = mosquitto.retained()
            return bool(found) and json.loads(found["ftdrive/server"])["online"]

        url = f"mqtt://cell:top-secret@127.0.0.1:{mosquitto.port}"
        process = ftdrive.start("fleet", "serve", "--metrics", "127.0.0.1:0", "--mqtt", url)
        said = listen_for(process, "Ctrl-C ends.")
        wait_until(is_online)
        process.send_signal(by)
        ended, more = end_of(process)
        wait_until(lambda: not is_online())
    assert ended == code, more
    assert "secret" not in said + more
    folder = Path(re.findall(r"dashboard are in (.+)", said)[0])
    assert {one.name for one in folder.iterdir()} >= {"alerts.yml", "dashboard.json"}
