"""What all levels of tests share."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("ftdrive", deadline=None, derandomize=True)
settings.load_profile("ftdrive")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings; they are not part of the project."""
    folder = os.environ.get("FTDRIVE_REAL_DATA")
    if not folder:
        pytest.skip("FTDRIVE_REAL_DATA is not set: the real recordings are not here")
    return Path(folder)
