"""`fleet serve` as a process: Ctrl-C ends it, and its rules are where it says."""

import re
import signal
from pathlib import Path

import pytest

from tests.system.command_line import CommandLine, end_of, listen_for


@pytest.mark.slow
def test_ctrl_c_ends_the_server(ftdrive: CommandLine) -> None:
    process = ftdrive.start("fleet", "serve", "--metrics", "127.0.0.1:0")
    said = listen_for(process, "Press Ctrl-C to stop.")
    process.send_signal(signal.SIGINT)
    ended, more = end_of(process)
    assert ended == 130, more
    folder = Path(re.findall(r"dashboard are in (.+)", said)[0])
    assert {one.name for one in folder.iterdir()} >= {"alerts.yml", "dashboard.json"}
