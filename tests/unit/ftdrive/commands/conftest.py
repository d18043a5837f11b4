"""What the tests of commands share."""

from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from ftdrive import cli
from ftdrive.fleet import workers
from ftdrive.fleet.workers import Workers


@pytest.fixture
def fleet_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Run a command of `fleet` in an empty folder, its workers in this process; return exit code, stdout and stderr."""

    @contextmanager
    def here(_: int | None) -> Iterator[Workers]:
        with ThreadPoolExecutor(1) as thread:
            yield Workers(1, thread.submit, BrokenExecutor)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr(workers, "local_workers", here)

    def call(*arguments: str | Path) -> tuple[int, str, str]:
        code = cli.run(["fleet", *map(str, arguments)])
        out, err = capsys.readouterr()
        return code, out, " ".join(err.split())

    return call
