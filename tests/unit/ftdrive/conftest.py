"""What the unit tests share."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.ftdrive.fake_cell import Lab


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    yield Lab(tmp_path, monkeypatch)
    assert not [thread for thread in threading.enumerate() if thread.name == "guards"]
