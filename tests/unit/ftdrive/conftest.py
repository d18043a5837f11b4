"""What the unit tests share."""

from collections.abc import Callable, Iterator
from pathlib import Path
from socketserver import BaseServer

import pytest

from ftdrive import cli
from tests.solved_once import solved_once
from tests.unit.ftdrive.fake_cell import Lab


@pytest.fixture(autouse=True, scope="session")
def _solved_once() -> Iterator[None]:
    with solved_once():
        yield


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return Lab(tmp_path, monkeypatch)


@pytest.fixture
def quick_shutdown(monkeypatch: pytest.MonkeyPatch) -> None:
    """Servers of the standard library look for the end every 10 ms instead of twice a second."""
    monkeypatch.setattr(BaseServer.serve_forever, "__defaults__", (0.01,))


@pytest.fixture
def run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Run a command in an empty folder; return its exit code, stdout, and stderr as one line."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))

    def call(*arguments: str | Path) -> tuple[int, str, str]:
        code = cli.run([*map(str, arguments)])
        out, err = capsys.readouterr()
        return code, out, " ".join(err.split())

    return call
