"""Solving imports nothing slow: every command pays for it."""

import subprocess
import sys

import pytest


@pytest.mark.slow
def test_nothing_slow_is_imported() -> None:
    slow = ("scipy.stats", "scipy.optimize", "scipy.interpolate", "scipy.signal")
    script = f"import sys, ftcalib.compare; print([name for name in {slow} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"
