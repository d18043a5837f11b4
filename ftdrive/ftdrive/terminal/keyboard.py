"""Single keys from a terminal, without Enter. Ctrl-C still interrupts; other keys have no effect on the process."""

import atexit
import codecs
import os
import re
import select
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Thread
from typing import Self

from ftdrive.session.events import Key

# Arrow and function keys arrive as escape sequences, whose letters must not be read as keys.
_ESCAPE = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|O.|.)?")
_STROKE = re.compile(f"{_ESCAPE.pattern}|[^\x1b]")
_NAMES = {"\x1b": "escape", "\n": "enter", "\r": "enter", "\x7f": "backspace", "\b": "backspace"}
_NAMES |= {f"\x1b{mode}{letter}": name for mode in "[O" for letter, name in (("C", "right"), ("D", "left"))}
_KEYS = {key.value: key for key in Key}
# Letters typed within this time of each other, s, are a word, such as a late answer, and no single keys.
_WORD_S = 0.3
# Keys that count even within a word, because an unneeded stop is harmless; other letters become `Key.OTHER`.
_ALWAYS = {Key.PAUSE, Key.STOP}


class Keyboard:
    """Keys of a terminal, read by a thread. Every exit from the context restores the settings of the terminal.

    A session reads requests by `pressed`, which leaves out letters within words. Other screens read each keystroke by
    `stroke`. `fd` is the descriptor of a terminal for which `usable` is true.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._keys: deque[Key] = deque()
        self._strokes: deque[str] = deque(maxlen=1000)  # limited, because a session does not read strokes
        self._before: list[int | list[bytes | int]] | None = None
        self._thread: Thread | None = None
        self._wake = -1

    @staticmethod
    def usable(fd: int) -> bool:
        """Whether keys can be read from a descriptor: that of a terminal, with the program in its foreground.

        False on Windows, which lacks the module `termios`.
        """
        if not hasattr(os, "tcgetpgrp"):
            return False
        try:
            return os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp()
        except OSError:
            return False

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def pressed(self) -> Key | None:
        """Return the oldest key of a session that was not returned yet; None if there is none."""
        return self._keys.popleft() if self._keys else None

    def stroke(self) -> str | None:
        """Return the oldest keystroke not returned yet, as a character or a name such as "left"; None for no key."""
        return self._strokes.popleft() if self._strokes else None

    @property
    def waiting(self) -> tuple[Key, ...]:
        """Keys of a session that `pressed` has not returned yet."""
        return tuple(self._keys)

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Stop reading keys while the block runs, so that it can read a typed answer; discard earlier keys."""
        self._stop()
        try:
            yield
        finally:
            self._start()

    def _start(self) -> None:
        import termios
        import tty

        try:
            self._before = termios.tcgetattr(self._fd)
        except termios.error:  # a closed terminal has no keys
            return
        atexit.register(self._restore)
        tty.setcbreak(self._fd, termios.TCSANOW)
        mode = termios.tcgetattr(self._fd)
        # disable Ctrl-S, which would freeze the screen while the arm moves
        mode[0] &= ~termios.IXON
        # disable Ctrl-Z and Ctrl-\, which would suspend or end the guards of a moving arm
        for name in (termios.VSUSP, termios.VQUIT):
            mode[6][name] = b"\0"
        termios.tcsetattr(self._fd, termios.TCSANOW, mode)
        wake, self._wake = os.pipe()
        self._thread = Thread(target=self._read, args=(wake,), name="keyboard", daemon=True)
        self._thread.start()

    def _stop(self) -> None:
        thread, self._thread = self._thread, None
        if thread is not None:
            # end the thread before typed input is discarded, because its read of a discarded key would never return
            os.close(self._wake)
            thread.join()
        self._restore()
        self._keys.clear()
        self._strokes.clear()

    def _restore(self) -> None:
        if self._before is None:
            return
        import termios

        # a closed terminal need not be restored
        with suppress(termios.error):
            # TCSANOW, because TCSADRAIN would wait for Ctrl-Q if Ctrl-S was pressed
            termios.tcsetattr(self._fd, termios.TCSANOW, self._before)
            termios.tcflush(self._fd, termios.TCIFLUSH)
        self._before = None
        atexit.unregister(self._restore)

    def _read(self, wake: int) -> None:
        word, typed_s = "", 0.0
        # incremental, because two reads may split the bytes of a character
        decoder = codecs.getincrementaldecoder("utf-8")("replace")
        try:
            while True:
                ready, _, _ = select.select([self._fd, wake], [], [])
                if wake in ready:
                    return
                typed = os.read(self._fd, 64)
                if not typed:
                    return
                text = decoder.decode(typed)
                names = [_NAMES.get(stroke, stroke) for stroke in _STROKE.findall(text)]
                self._strokes += [name for name in names if name.isprintable()]
                letters = _ESCAPE.sub("", text).lower()
                now_s = time.monotonic()
                word, typed_s = (word if now_s - typed_s < _WORD_S else ""), now_s
                alone = not word and len(set(letters)) == 1
                found = [_KEYS[letter] for letter in dict.fromkeys(letters) if letter in _KEYS and letter not in word]
                found = [key for key in found if alone or key in _ALWAYS]
                held_down = word and len(set(word + letters)) == 1
                self._keys += found or ([] if held_down else [Key.OTHER])
                word += letters or "\x1b"
        except OSError:
            # no message, because the supervisor reports a closed terminal
            return
        finally:
            os.close(wake)
