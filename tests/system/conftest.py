"""What the tests of the command line share."""

import fcntl
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.solved_once import solved_once
from tests.system.command_line import CommandLine


@pytest.fixture(autouse=True, scope="session")
def _solved_once() -> Iterator[None]:
    with solved_once():
        yield


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> dict[str, Any]:
    """Answer of one `demo`, made by the first worker that needs it. Its folder, `run`, is shared and only read."""
    base = tmp_path_factory.getbasetemp()
    folder = (base if worker_id == "master" else base.parent) / "demo"
    folder.mkdir(exist_ok=True)
    made = folder / "answer.json"
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            answer = CommandLine(folder).json("demo", "--simulate")
            made.write_text(json.dumps(answer | {"run": str(folder / answer["run"])}), encoding="utf-8")
    shared: dict[str, Any] = json.loads(made.read_text(encoding="utf-8"))
    return shared


@pytest.fixture
def ftdrive(tmp_path: Path) -> Iterator[CommandLine]:
    command_line = CommandLine(tmp_path)
    yield command_line
    command_line.end()
