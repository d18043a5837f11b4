"""Two consoles: `answer` prints what a command was asked for on stdout, `messages` all else on stderr."""

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from io import StringIO
from threading import Timer
from typing import Any, Final

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.style import Style
from rich.text import Text

from ftdrive.terminal.text import NARROWEST, glued, unglued
from ftdrive.words.text import as_typed, is_command, visible

# A command that takes longer says at what it works, also in a pipe.
_PATIENCE_S: Final = 2.0


class CommandConsole(Console):
    """A console that knows whether details are wanted (`-v`); `quiet` is the console's own."""

    verbose = False

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render with control characters made visible, whatever file, device or network they come from."""
        for one in super().render(renderable, options):
            yield one if one.control else Segment(visible(one.text), one.style)

    def on_broken_pipe(self) -> None:
        """Leave a closed pipe to `ftdrive.cli.run`."""
        raise BrokenPipeError

    def print(self, *objects: Any, **options: Any) -> None:
        """Print; a command in a text stands there as the user can type it."""
        super().print(*(as_typed(one) if isinstance(one, str) else one for one in objects), **options)

    def print_next(self, *commands: str) -> None:
        """Print what the user can do next: commands, each with why behind it."""
        if commands:
            self.print("Next", style="bold cyan")
        for command in commands:
            self.print(self._next(command), soft_wrap=True)

    def _next(self, text: str) -> str:
        r"""Fold a command as a shell reads it, with \ before its last option, and what stands behind it."""
        command, _, why = as_typed(text).partition("   ")
        shown = f"   {command}"
        if not self.soft_wrap and len(shown) > self.width:
            shown = " \\\n      --".join(shown.rsplit(" --", 1))
        fits = self.soft_wrap or len(shown.split("\n")[-1]) + 3 + len(why) <= self.width
        return shown if not why else f"{shown}{'   ' if fits else chr(10) + ' ' * 6}{why}"


messages = CommandConsole(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=not sys.stderr.isatty())
"""Folds between words in a terminal, never in a file. Prints brackets and colons as they are: paths contain them."""

answer = CommandConsole(highlight=False, markup=False, emoji=False, soft_wrap=not sys.stdout.isatty())
"""On stdout: results, verdicts and where they were saved. `-q` does not silence it, `--json` replaces it."""


def has_screen() -> bool:
    """Whether a screen can cover the terminal: a person reads and types there, and its cursor can be placed."""
    are_terminals = all(one.isatty() for one in (sys.stdin, sys.stdout, sys.stderr))
    return are_terminals and os.name == "posix" and not messages.is_dumb_terminal


def beside(as_json: bool) -> CommandConsole:
    """Return where words about an answer go: to stdout, or to stderr if `--json` has its object there."""
    return messages if as_json else answer


def print_address(words: str, address: str) -> None:
    """Print an address behind words, or below if the line is too short; never broken, and as a link where it can."""
    if not messages.soft_wrap and len(words + address) > messages.width >= len(f"   {address}"):
        words = f"{words.rstrip()}\n   "
    messages.print(Text.assemble(words, (address, Style(link=address))), soft_wrap=True)


def print_page(url: str, *, shared: bool) -> None:
    """Print the address of a page, for other devices also as a QR code."""
    print_address("The page is shown until this command ends, at ", url)
    if shared:
        for row in qr_code(url):
            messages.print(row)
        messages.print("Who has this address sees the page and can press its buttons. There is no encryption.")


def qr_code(address: str) -> list[str]:
    """Return the rows of the QR code of an address, light on dark; needs the extra viz, as the page does."""
    import segno

    code = StringIO()
    segno.make(address, error="l").terminal(code, border=1, compact=True)
    return code.getvalue().splitlines()


def hanging(head: str | Text, words: str, console: Console = messages) -> Text:
    """Put words behind a head; on a terminal too narrow for them the next lines begin under the first word.

    Print it with `soft_wrap`: a line that is a command stays whole.
    """
    first = Text.assemble(head)
    words, width = as_typed(words), console.width - first.cell_len
    if console.soft_wrap or width < NARROWEST:
        return first + Text(words)
    parts = Text(glued(words, width)).split()
    lines = [line for part in parts for line in ([part] if is_command(part.plain) else part.wrap(console, width))]
    for line in lines:
        line.rstrip()
        line.plain = unglued(line.plain)
    return first + Text("\n" + " " * first.cell_len).join(lines)


@contextmanager
def working(words: str) -> Iterator[Callable[[str], None]]:
    """Show on a terminal that a command works, and at what; a pipe gets one line after 2 s.

    Yields a function for other words.
    """
    if not messages.is_terminal:
        line = Timer(_PATIENCE_S, messages.print, [f" {words} …"])
        line.daemon = True
        line.start()
        try:
            yield lambda _: None
        finally:
            line.cancel()
        return
    if messages.quiet:
        yield lambda _: None
        return
    with messages.status(f"{words} …") as status:
        yield lambda now: status.update(f"{now} …")
