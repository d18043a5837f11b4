"""Runs command lines in one process that lacks what Windows lacks: ``python without_posix.py '[["solve", …], …]'``."""

import importlib
import json
import os
import signal
import sys
import warnings
from importlib.abc import MetaPathFinder

MODULES = {"fcntl", "grp", "pty", "pwd", "readline", "resource", "termios", "tty"}
OF_OS = ("O_CLOEXEC", "O_NOCTTY", "O_NONBLOCK", "fork", "getpgrp", "openpty", "tcgetpgrp", "ttyname")
OF_SIGNAL = ("SIGALRM", "SIGHUP", "SIGKILL", "setitimer")


class _Windows(MetaPathFinder):
    def find_spec(self, fullname: str, *_: object) -> None:
        if fullname in MODULES:
            raise ModuleNotFoundError(f"No module named '{fullname}'", name=fullname)


def lack() -> None:
    """Take away modules and functions, and make an error of our text files whose encoding depends on the system."""
    for name in MODULES & sys.modules.keys():
        del sys.modules[name]
    sys.meta_path.insert(0, _Windows())
    for module, names in ((os, OF_OS), (signal, OF_SIGNAL)):
        for name in names:
            delattr(module, name)
    warnings.filterwarnings("error", category=EncodingWarning, module=r"ft(calib|drivers|drive)\.")


if __name__ == "__main__":
    lack()
    import ftdrive
    from ftdrive import cli

    for arguments in json.loads(sys.argv[1]):
        if code := cli.run(arguments):
            sys.exit(f"ftdrive {' '.join(arguments)}: exit code {code}")
    for name in ftdrive.__all__:
        getattr(ftdrive, name)
    importlib.import_module("ftdrive.terminal.live_screen")  # needs a terminal to run
    sys.exit(0 if cli.run(["transcript", "play", "--simulate"]) == 2 else "the player found a pseudo-terminal")
