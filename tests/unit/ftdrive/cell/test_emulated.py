"""An emulated cell that cannot be started."""

import pytest

from ftdrive.cell.emulated import Station
from ftdrive.errors import ConfigError


def test_another_system_than_linux_has_no_emulated_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "darwin")
    with pytest.raises(ConfigError, match=r"needs Linux.* use recorded data"), Station():
        pass
