"""Where the unmodified ur_rtde can be installed."""

import pytest


def require_ur_rtde() -> None:
    """Skip a test, or from the top of a module all its tests, that runs ur_rtde itself."""
    pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this Python")
