"""`fleet serve`: what it prints, how it ends, and what it refuses at the start."""

import urllib.request
from collections.abc import Callable
from datetime import datetime
from importlib import import_module
from pathlib import Path

import pytest

from ftdrive.fleet.state import Fleet
from ftdrive.store.store import Store
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.fleet.fleets import cell, fleet

pytestmark = pytest.mark.usefixtures("quick_shutdown")

Ran = tuple[int, str]
STATUS = import_module("ftdrive.commands.fleet.status")  # the package has a command of this name


@pytest.fixture
def run(run: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ran]:
    monkeypatch.setattr(STATUS, "REAL", FakeClock())

    def call(*arguments: str | Path) -> Ran:
        code, out, err = run("fleet", "serve", *arguments)
        assert out == ""
        return code, err

    return call


def test_the_page_has_the_cells_as_long_as_it_serves(run: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch) -> None:
    pages = list[str]()

    def look(_store: Store, _now: datetime) -> Fleet:
        if not ports:
            ports.append(opened[0].port)
            return fleet(cell("press-4"))
        with urllib.request.urlopen(f"http://127.0.0.1:{ports[0]}/metrics", timeout=30) as answer:
            pages.append(answer.read().decode())
        raise KeyboardInterrupt

    from ftdrive.fleet import metrics

    opened, ports = list[metrics.MetricsServer](), list[int]()

    class Server(metrics.MetricsServer):
        def __init__(self, host: str, port: int, page: Callable[[], str]) -> None:
            super().__init__(host, port, page)
            opened.append(self)

    monkeypatch.setattr(STATUS, "MetricsServer", Server)
    monkeypatch.setattr(STATUS, "fleet_state", look)
    assert run("--metrics", "127.0.0.1:0")[0] == 130
    assert 'ftdrive_bias_drift_found{cell="press-4",tool="gripper"} 0.0' in pages[0]
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(f"http://127.0.0.1:{ports[0]}/metrics", timeout=30)


@pytest.mark.parametrize("address", ["10018", "localhost:x", "localhost:65536"])
def test_a_wrong_address_is_refused(address: str, run: Callable[..., Ran]) -> None:
    code, said = run("--metrics", address)
    assert (code, f"--metrics is '{address}': give HOST:PORT, such as 127.0.0.1:10018" in said) == (2, True)
