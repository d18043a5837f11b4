"""What the unit tests share."""

from pathlib import Path

import pytest

from tests.unit.ftdrive.fake_cell import Lab


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return Lab(tmp_path, monkeypatch)
