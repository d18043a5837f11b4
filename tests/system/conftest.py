"""What the tests of the command line share."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.system.command_line import CommandLine


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Answer of one `demo`. Its folder, `run`, is shared by all tests and only read."""
    folder = tmp_path_factory.mktemp("demo")
    answer = CommandLine(folder).json("demo", "--simulate")
    return answer | {"run": str(folder / answer["run"])}


@pytest.fixture
def ftdrive(tmp_path: Path) -> Iterator[CommandLine]:
    command_line = CommandLine(tmp_path)
    yield command_line
    command_line.end()
