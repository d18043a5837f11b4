"""Commands whose caller has closed a standard stream, as some supervisors do."""

import subprocess
import sys

import pytest


@pytest.mark.slow
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_closed_stream_is_no_traceback_and_no_file_gets_its_number(closed: str) -> None:
    """`devices` asks whether stdout is a terminal; `convert` of nothing prints on stderr."""
    for arguments, code in ((["devices"], 0), (["convert", "nothing.csv", "b.csv"], 2)):
        command = [sys.executable, "-m", "ftdrive", *arguments]
        ended = subprocess.run(
            ["sh", "-c", f'exec "$@" {closed}', "sh", *command], capture_output=True, text=True, check=False, timeout=60
        )
        assert ended.returncode == code
        assert "Traceback" not in ended.stderr
