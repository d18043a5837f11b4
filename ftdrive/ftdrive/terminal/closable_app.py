"""An app of Textual that survives a closed terminal.

Only a screen that is shown imports this module: no other command waits for the import of Textual.
"""

import signal
import threading
from contextlib import suppress
from typing import Any, cast

from textual.app import App
from textual.driver import Driver

REFRESH_S = 0.1


class ClosableApp(App[None]):
    """An app whose terminal may be closed: that ends it as its key to quit does, and then the command."""

    def __init__(self, **options: Any) -> None:
        super().__init__(_closable_driver(), **options)

    def run_on_terminal(self) -> None:
        """Run; after a closed terminal the signal is repeated, for its handler before."""
        before = signal.getsignal(signal.SIGHUP)
        closed = threading.Event()

        def close(*_: object) -> None:
            # In the loop of the app: an exception that a signal raises there can leave it waiting for ever.
            closed.set()
            if (loop := self._loop) is None:  # it is just starting
                threading.Timer(REFRESH_S, close).start()
            elif not loop.is_closed():
                loop.call_soon_threadsafe(self.exit)

        if before not in {signal.SIG_IGN, None}:
            signal.signal(signal.SIGHUP, close)
        try:
            self.run()
        finally:
            signal.signal(signal.SIGHUP, before)
            if closed.is_set():
                signal.raise_signal(signal.SIGHUP)


def _closable_driver() -> type[Driver]:
    """Return a driver for a terminal that may be closed: the thread that writes would end, and its queue then block."""
    # needs termios, which Windows has not
    from textual.drivers.linux_driver import LinuxDriver

    class ClosableDriver(LinuxDriver):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            self._file = cast("Any", _UntilClosed(self._file))

    return ClosableDriver


class _UntilClosed:
    """A file that ignores errors of writing."""

    def __init__(self, file: Any) -> None:
        self.file, self.fileno = file, file.fileno

    def write(self, text: str) -> None:
        with suppress(OSError):
            self.file.write(text)

    def flush(self) -> None:
        with suppress(OSError):
            self.file.flush()
