"""uv as a tool of tests: from its cache first, because an index is slow and may be out of reach."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

_UNREACHABLE = "error sending request"


def run_uv(*arguments: str | Path, cwd: Path) -> str:
    """Return what uv prints; skips the test without uv or where the cache lacks a package and no index is reached."""
    uv = os.environ.get("UV") or shutil.which("uv")
    if uv is None:
        pytest.skip("uv is not installed")
    outside = {name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "VIRTUAL_ENV"}}
    for more in (["--offline"], []):
        command = [uv, *map(str, arguments), *more]
        outcome = subprocess.run(command, cwd=cwd, env=outside, capture_output=True, text=True, check=False)
        if outcome.returncode == 0:
            return outcome.stdout
    if "No solution found" not in outcome.stderr and _UNREACHABLE in outcome.stderr:
        pytest.skip(f"the package index cannot be reached: {outcome.stderr.strip()}")
    pytest.fail(f"{' '.join(command)}: {outcome.stderr}")
