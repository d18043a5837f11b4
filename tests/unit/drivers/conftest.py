"""What the unit tests of the drivers share."""

import pytest

from tests.unit.drivers.dialogue import Table


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> Table:
    return Table(monkeypatch)
