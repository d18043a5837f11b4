"""Two consoles: `answer` prints results on stdout, `messages` prints everything else on stderr."""

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

from ftdrive.terminal.text import NARROWEST, glue, unglue
from ftdrive.words.text import as_typed, is_command, visible

# A command that takes longer than this, s, prints what it is doing, even if stderr is no terminal.
_PATIENCE_S: Final = 2.0


class CommandConsole(Console):
    """A rich console for commands, with the setting `verbose` for `-v`; the base class already has `quiet`."""

    verbose = False

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render with control characters made visible, because text may come from files, devices or the network."""
        for one in super().render(renderable, options):
            yield one if one.control else Segment(visible(one.text), one.style)

    def on_broken_pipe(self) -> None:
        """Raise `BrokenPipeError` instead of ending the program, because `ftdrive.cli` handles it."""
        raise BrokenPipeError

    def print(self, *objects: Any, **options: Any) -> None:
        """Print objects; in texts, commands are written as they must be typed (such as after `uv run`)."""
        super().print(*(as_typed(one) if isinstance(one, str) else one for one in objects), **options)

    def print_next(self, *commands: str) -> None:
        """Print the commands to type next; after three spaces, each may have its reason."""
        if commands:
            self.print("Next", style="bold cyan")
        for command in commands:
            self.print(self._next(command), soft_wrap=True)

    def _next(self, text: str) -> str:
        r"""Lay out a command and the text after it; a command that is too long is broken with \ at its last option."""
        command, _, why = as_typed(text).partition("   ")
        shown = f"   {command}"
        if not self.soft_wrap and len(shown) > self.width:
            shown = " \\\n      --".join(shown.rsplit(" --", 1))
        fits = self.soft_wrap or len(shown.split("\n")[-1]) + 3 + len(why) <= self.width
        return shown if not why else f"{shown}{'   ' if fits else chr(10) + ' ' * 6}{why}"


messages = CommandConsole(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=not sys.stderr.isatty())
"""Console on stderr: folds lines between words on a terminal, but not in a file. Brackets and colons are printed as
they are, because paths contain them."""

answer = CommandConsole(highlight=False, markup=False, emoji=False, soft_wrap=not sys.stdout.isatty())
"""Console on stdout for results, verdicts and saved file names. `-q` does not silence it; `--json` replaces it."""


def has_screen() -> bool:
    """Whether a screen can cover the terminal: input and output are a terminal with cursor control."""
    are_terminals = all(one.isatty() for one in (sys.stdin, sys.stdout, sys.stderr))
    return are_terminals and os.name == "posix" and not messages.is_dumb_terminal


def message_console(as_json: bool) -> CommandConsole:
    """Return the console for messages about a result: that of stdout, or, as `--json` uses stdout, that of stderr."""
    return messages if as_json else answer


def print_address(words: str, address: str) -> None:
    """Print a URL after a text, or on a line of its own if it would not fit. It is never broken, and may be a link."""
    if not messages.soft_wrap and len(words + address) > messages.width >= len(f"   {address}"):
        words = f"{words.rstrip()}\n   "
    messages.print(Text.assemble(words, (address, Style(link=address))), soft_wrap=True)


def print_page(url: str, *, shared: bool) -> None:
    """Print the address of a browser page; if it is `shared` with other devices, also as a QR code."""
    print_address("The page is shown until this command ends, at ", url)
    if shared:
        for row in qr_code(url):
            messages.print(row)
        messages.print("Anyone with this address can see the page and press its buttons. There is no encryption.")


def qr_code(address: str) -> list[str]:
    """Return the rows of characters of an address's QR code, light on dark. Needs the extra `viz`, as the page does."""
    import segno

    code = StringIO()
    segno.make(address, error="l").terminal(code, border=1, compact=True)
    return code.getvalue().splitlines()


def indented(head: str | Text, words: str, console: Console = messages) -> Text:
    """Return `head` followed by `words`; if the text needs several lines, later ones start below the first word.

    Print the text with `soft_wrap`, so that a line with a command stays whole.
    """
    first = Text.assemble(head)
    words, width = as_typed(words), console.width - first.cell_len
    if console.soft_wrap or width < NARROWEST:
        return first + Text(words)
    parts = Text(glue(words, width)).split()
    lines = [line for part in parts for line in ([part] if is_command(part.plain) else part.wrap(console, width))]
    for line in lines:
        line.rstrip()
        line.plain = unglue(line.plain)
    return first + Text("\n" + " " * first.cell_len).join(lines)


@contextmanager
def working(words: str) -> Iterator[Callable[[str], None]]:
    """Show what a command is doing while the block runs; if stderr is no terminal, print it once after 2 s.

    Yields a function that changes the shown text.
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
