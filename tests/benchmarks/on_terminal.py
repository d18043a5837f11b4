"""Run a script on a pseudo-terminal of a size, whose output is read and counted."""

import fcntl
import json
import os
import pty
import struct
import subprocess
import sys
import termios
from collections.abc import Sequence
from typing import Any


def on_terminal(script: str, width: int, height: int, arguments: Sequence[str]) -> tuple[Any, float]:
    """Run a script that writes its figures as JSON to the file `--report`; return them and the kilobytes it printed."""
    main, side = pty.openpty()
    fcntl.ioctl(side, termios.TIOCSWINSZ, struct.pack("HHHH", height, width, 0, 0))
    report, written = os.pipe()
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": str(width), "LINES": str(height)}
    command = [sys.executable, script, "--report", str(written), *arguments]
    with subprocess.Popen(command, stdin=side, stdout=side, stderr=side, pass_fds=[written], env=environment) as child:
        os.close(side)
        os.close(written)
        size = 0
        while True:
            try:
                size += len(os.read(main, 1 << 16))
            except OSError:  # the child has ended
                break
        child.wait()
    with os.fdopen(report) as file:
        return json.loads(file.read()), size / 1e3
